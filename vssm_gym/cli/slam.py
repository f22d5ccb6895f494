"""Run ``vssm-gym slam SEQUENCE --out DIR``: a trajectory and a dense map from an RGB-D recording."""

import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from vssm_gym.cli.shared.console import say
from vssm_gym.cli.shared.interruption import interruptible

if TYPE_CHECKING:
    from vssm_gym.slam.run import TrackedFrame

INTRINSICS = "numbers fx,fy,cx,cy[,k1,k2,p1,p2,k3]"
WARNINGS = 5  # printed; stats.json has all
RECENT = 20  # frames that the displayed frame rate is the mean of


@interruptible("trajectory.partial.txt", "trajectory.txt")
def slam(
    sequence: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SEQUENCE")],
    out: Path,
    size: str = "160x120",
    rate: float = 10.0,
    voxel: float = 0.07,
    extent: float = 14.0,
    intrinsics: str | None = None,
    solver: str = "gauss_newton",
    samples: int = 1,
    max_depth: float = 8.0,
    depth: Literal["good", "stereo"] = "good",
    imu: bool = False,
    transition: Path | None = None,
    method: Literal["prism", "smoother", "tracker"] = "prism",
    map: Path | None = None,
    start: str | None = None,
    refine: bool = False,
    learn_camera: bool = False,
    seed: int = 0,
    viewer: bool = False,
) -> None:
    """Track a hand-held RGB-D camera and map what it saw, frame by frame.

    OUT gets trajectory.txt (TUM format: the pose of every frame in the first camera's frame), map.npz, mesh.ply,
    stats.json and report.html. Interrupt at any time: the finished frames' poses stay in trajectory.partial.txt.

    Args:
        sequence: TUM folder (rgb.txt and depth.txt, or associations.txt); groundtruth.txt is used for evaluation only.
        out: new or empty folder for the results.
        size: WIDTHxHEIGHT to which images are resized.
        rate: frames per second at most; the others are skipped.
        voxel: edge of a cell, metres.
        extent: edge of the cube that is mapped around the camera, metres.
        intrinsics: fx,fy,cx,cy[,k1,k2,p1,p2,k3] of the recorded images, in place of those in the folder.
        solver: method of the pose estimate: gauss_newton, or adam as published for PRISM (slower).
        samples: poses drawn for the map update, an odd number; with 3 or more, the map update accounts for the pose's
            uncertainty and the pose estimate for the map's.
        max_depth: metres; readings beyond it are ignored.
        depth: kind of depth sensor: good (structured light, or stereo at short range) or stereo (noisy, long range).
        transition: file of `vssm-gym train-dynamics`, learned from flights: predicts the motion from imu.txt instead
            of a constant velocity; the camera must rest for the first half second.
        method: prism filters pose and map; smoother finds the newest poses together, and in the end up to 300,
            without a filter; tracker estimates the pose in a given map, which stays fixed.
        map: map file for the tracker, from another run of slam or from map build.
        start: x,y,z,qx,qy,qz,qw for the tracker: approximate pose of the first camera in the map (default: its origin).
        refine: smooth all poses at once when the filter has ended, and make the map anew; for prism.
        learn_camera: learn the calibration of a colour camera that is not registered to depth (field colour of
            camera.json), and run again with it; OUT gets it as camera.json. For prism.
        imu: predict the motion from imu.txt instead of a constant velocity; the camera must rest for the first half
            second.
        seed: seed of the pose samples, and of the pixels that adam draws.
        viewer: show the run live in rerun (the extra vssm-gym[viz]).
    """
    from vssm_gym.cli.shared.arguments import parse_numbers, parse_size
    from vssm_gym.data.sequences import load_sequence
    from vssm_gym.files.output_folders import check_folder
    from vssm_gym.slam import output as slam_output
    from vssm_gym.slam.options import SlamOptions
    from vssm_gym.viz.stream import open_viewer

    options = SlamOptions(
        parse_size("slam", size),
        rate,
        voxel,
        extent,
        solver,
        samples,
        seed,
        max_depth=max_depth,
        depth=depth,
        imu=imu,
        transition=transition,
        method=method,
        map=map,
        refine=refine,
        learn_camera=learn_camera,
        start=None if start is None else parse_numbers("slam", "start", start, float, "numbers x,y,z,qx,qy,qz,qw"),
    )
    check_folder(out)
    calibration = None if intrinsics is None else parse_numbers("slam", "intrinsics", intrinsics, float, INTRINSICS)
    recording = load_sequence(sequence, calibration)
    print_warnings(recording.notices)
    with contextlib.ExitStack() as stack:
        shown = None
        if viewer:
            shown = open_viewer(recording.root.resolve().name, recording.camera.resized(*options.size))
            stack.callback(shown.close)
        progress, on_frame = stack.enter_context(_live())
        stats = slam_output.process(recording, out, options, progress, on_frame, shown)
    print_warnings(stats["notices"][len(recording.notices) :])
    step = stats["latency_ms"].get("whole step")
    speed = f", {step['p50']:.0f} ms a frame (median)" if step else ""
    lost, again = len(stats["lost"]), len(stats["relocalised"])
    say(f"{stats['frames']} frames, {lost} lost, {again} relocalised{speed}")
    if kept := stats["real_time"]:
        say(
            f"{kept['factor']:.2f} x real time, {kept['within_period']:.0%} of the frames within the camera's "
            f"{1e3 * kept['period_s']:.0f} ms; with compilation {kept['factor_with_compiling']:.2f} x"
        )
    errors = stats["errors"] or {}
    if "impossible" in errors:
        say(f"errors against the ground truth cannot be computed: {errors['impossible']}")
    elif errors:
        held = ", lost frames at their last pose" if lost else ""
        before = (stats.get("refinement") or {}).get("ate_before")
        filtered = f", {100.0 * before['rmse']:.2f} cm before it was refined" if before else ""
        say(f"ATE {100.0 * errors['ate_translation_se3']['rmse']:.2f} cm after SE(3) alignment{filtered}{held}")
    if learned := stats.get("colour_camera"):
        print_parameters(learned["parameters"])
    say(out / slam_output.REPORT)


def print_parameters(parameters: Sequence[dict[str, Any]]) -> None:
    """Print a learned calibration as a table, and what the recording does not tell."""
    say(f"{'colour camera':<16}{'stated':>10}{'learned':>10}{'std':>8}")
    for row in parameters:
        told = "" if row["told"] else "  not told by this recording"
        name = f"{row['name']}, {row['unit']}"
        say(f"{name:<16}{row['stated']:>10.3f}{row['learned']:>10.3f}{row['std']:>8.3f}{told}")


def print_warnings(notices: Sequence[str]) -> None:
    """Print the first warnings about the input on stderr, one line each, and the number of further ones."""
    for notice in notices[:WARNINGS]:
        say(f"warning: {notice}", error=True)
    if len(notices) > WARNINGS:
        say(f"warning: and {len(notices) - WARNINGS} more like these", error=True)


@contextlib.contextmanager
def _live() -> Iterator[tuple[Callable[[str, int, int], None], Callable[["TrackedFrame"], None]]]:
    """Yield the callbacks ``on_progress`` and ``on_frame``, which show frame rate and lost frames on stderr."""
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

    from vssm_gym.cli.shared.progress import progress_of

    columns = (
        TextColumn("{task.description:>24}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}", markup=False),
    )
    ends, lost, note = deque([time.perf_counter()], maxlen=RECENT + 1), 0, ""
    with progress_of(*columns) as show:

        def on_progress(stage: str, done: int, total: int) -> None:
            show(stage, done, total, "" if stage == "writing" else note)

        def on_frame(frame: "TrackedFrame") -> None:
            nonlocal lost, note
            lost += frame.lost
            ends.append(time.perf_counter())
            speed = (len(ends) - 1) / (ends[-1] - ends[0])
            note = f"{speed:.1f} frames/s, {lost} lost"

        yield on_progress, on_frame
