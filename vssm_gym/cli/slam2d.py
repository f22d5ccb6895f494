"""Run ``vssm-gym slam2d LOG --out DIR``: SLAM in the plane."""

import math
from pathlib import Path
from typing import Annotated, Literal

import tyro

from vssm_gym.cli.shared.console import say
from vssm_gym.cli.shared.interruption import interruptible


@interruptible()
def slam2d(
    log: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")],
    out: Path,
    cell: float = 0.1,
    max_range: float | None = None,
    steps: int = 3000,
    noise: str = "low",
    sensor_noise: str = "low",
    seed: int = 0,
    baseline: bool = False,
    latent: bool = False,
    passes: int = 0,
    scans: str | None = None,
    sensor: Literal["lidar", "camera"] = "lidar",
) -> None:
    """Find the path of a robot with a laser scanner, and the map of its plane.

    LOG is a file (CARMEN, or a graph with ROBOTLASER1 and EDGE2; text or gzip), or the name of a maze that is driven
    through first. OUT gets trajectory.txt (x, y, heading at each scan, from the first), map.yaml and map.pgm (free,
    occupied, unknown; for ROS's map_server), slam2d.json, slam2d.svg and slam2d.html: the map, and the errors beside
    those of path integration. Poses and loops of the log are read for these errors alone.

    Args:
        log: file, or rooms-v1, rings-v1 and the other mazes.
        out: new or empty folder.
        cell: size of the map's cells, m; a maze, which is one metre wide, has a tenth of it. A latent grid's are 6.25
            times as large, 10 times with a camera.
        max_range: m, beyond which readings are left out; by default what the log says.
        steps: of the drive through a maze.
        noise: of its execution: none, low, mid or high.
        sensor_noise: of its ranges: none, low, mid or high.
        seed: of the drive, and of the particles of the latent grid.
        baseline: compare with scan matching and a pose graph, which GTSAM optimises (pip install gtsam).
        latent: compare with a latent grid (DVBF-LM); OUT gets its poses as trajectory_latent.txt.
        passes: off-line passes of the latent grid after its on-line one.
        scans: FIRST:LAST, to run on a part of the log.
        sensor: of the robot in a maze: lidar, or camera, whose strips of pixels only the latent grid reads.
    """
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.data.laser_logs import LaserLog, read_laser_log
    from vssm_gym.data.strip_logs import StripLog
    from vssm_gym.data.traversals import traverse
    from vssm_gym.envs.tasks.mazes import MAZES, load_maze
    from vssm_gym.errors import InputError, one_of
    from vssm_gym.eval.studies import planar_slam, strip_slam
    from vssm_gym.eval.studies.page import study_folder, write_study
    from vssm_gym.files.atomic import atomic_write
    from vssm_gym.files.output_folders import check_at_least, check_folder
    from vssm_gym.planning.occupancy_grid import OccupancyGrid, write_ros_map

    check_at_least("slam2d", "seed", seed, 0)
    check_at_least("slam2d", "steps", steps, 1)
    check_at_least("slam2d", "passes", passes, 0)
    by_camera = sensor == "camera"
    if passes and not (latent or by_camera):
        raise InputError("slam2d", "passes", "0 without --latent: the occupancy map has one pass")
    if by_camera and log not in MAZES:
        raise InputError("slam2d", "sensor", f"lidar for a file; a camera drives through {', '.join(MAZES)}")
    if by_camera and (baseline or latent or max_range is not None):
        expected = "lidar with --baseline, --latent or --max-range: a camera has no ranges, and always the latent grid"
        raise InputError("slam2d", "sensor", expected)
    if not 0.0 < cell < math.inf:
        raise InputError("slam2d", "cell", f"above 0 m and finite, not {cell:g}")
    check_folder(out)
    if log not in MAZES and not Path(log).suffix and not Path(log).exists():
        raise InputError("slam2d", "log", f"a file, or {one_of(MAZES, log)}")
    drive: LaserLog | StripLog
    if log in MAZES:
        drive, size = traverse(load_maze(log), steps, seed, noise, sensor_noise, sensor=sensor), 0.1 * cell
    else:
        drive, size = read_laser_log(Path(log)), cell
    if scans is not None:
        drive = drive.part(*_part(scans, len(drive)))
    made = {"steps": steps, "noise": noise, "sensor_noise": sensor_noise} if log in MAZES else {}
    of = {"sensor": sensor, "part": scans, **made}
    with study_folder("slam2d", out):
        with progress_bars() as progress:
            if isinstance(drive, StripLog):
                study, charts = strip_slam.run(log, drive, size, passes, seed, of, progress)
                estimates = {"trajectory.txt": charts.poses}
            else:
                study, run, beside = planar_slam.run(
                    Path(log).name, drive, size, max_range, progress, baseline, passes if latent else None, seed, of
                )
                estimates = {"trajectory.txt": run.poses}
                estimates |= {"trajectory_latent.txt": beside.poses} if beside else {}
                write_ros_map(out / "map.yaml", OccupancyGrid.from_planar_map(run.m))
        for name, poses in estimates.items():
            with atomic_write(out / name) as temporary, temporary.open("w") as file:
                file.write("# x y heading\n")
                file.writelines(f"{x:.6f} {y:.6f} {heading:.6f}\n" for x, y, heading in poses)
        page = write_study(study, out)
    say(study.answer, page)


def _part(scans: str, length: int) -> tuple[int, int]:
    """Return first scan and end of FIRST:LAST."""
    from vssm_gym.errors import InputError

    first, colon, last = scans.partition(":")
    expected = f"FIRST:LAST with 0 <= FIRST < LAST <= {length}, not {scans!r}"
    if not (colon and first.isdecimal() and last.isdecimal() and int(first) + 1 < int(last) <= length):
        raise InputError("slam2d", "scans", expected)
    return int(first), int(last)
