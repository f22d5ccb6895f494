"""Run ``vssm-gym map build SEQUENCE --out FILE`` and ``vssm-gym map export MAP --out DIR``: learn and export maps."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from vssm_gym.cli.shared.console import say
from vssm_gym.cli.shared.interruption import interruptible


@interruptible()
def build(
    sequence: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SEQUENCE")],
    out: Path,
    voxel: float = 0.05,
    poses: Literal["recorded", "estimated"] = "recorded",
    compact: bool = False,
) -> None:
    """Build a map in closed form from a recorded sequence.

    Args:
        sequence: TUM folder with groundtruth.txt; `vssm-gym record` makes one.
        out: the map file to write (.npz), a new one.
        voxel: edge of a cell, metres.
        poses: camera poses: recorded (ground truth), or estimated by PRISM from the images and commands of a survey.
        compact: round the numbers to what they are worth (1 mm, a 128th of the colours' range): a third of the file.
    """
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.cli.slam import print_warnings
    from vssm_gym.data.sequences import load_sequence
    from vssm_gym.errors import InputError
    from vssm_gym.files.output_folders import check_new_file
    from vssm_gym.slam.map_building import build_map

    if not 0.0 < voxel <= 0.5:
        raise InputError("map build", "voxel", f"a cell size in (0, 0.5] m, found {voxel}")
    check_new_file(out, (".npz",))
    recording = load_sequence(sequence)
    print_warnings(recording.notices)
    damaged: list[str] = []
    with progress_bars() as progress:
        voxel_map = build_map(recording, voxel, progress, damaged.extend, poses)
    print_warnings(damaged)
    (voxel_map.rounded() if compact else voxel_map).save(out)
    size = " x ".join(f"{n * voxel:.1f}" for n in voxel_map.shape)
    say(f"{size} m in cells of {voxel} m: {out}")


def export(
    map_file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MAP")],
    out: Path,
    resolution: float = 0.05,
    height: float = 0.5,
) -> None:
    """Write a learned map as a ROS map and as a mesh.

    OUT gets map.yaml and map.pgm (free, occupied, unknown; for ROS's map_server), mesh.ply (with colour and variance of
    each vertex) and mesh.glb (for browsers and Blender).

    Args:
        map_file: a map of `vssm-gym map build` (.npz).
        out: new or empty folder.
        resolution: edge of a cell of the ROS map, metres.
        height: height of the robot, metres; obstacles above it are left out of the ROS map.
    """
    from vssm_gym.errors import InputError
    from vssm_gym.files.output_folders import check_new_folder, whole_folder
    from vssm_gym.maps.voxel_map import VoxelMap, read_metadata
    from vssm_gym.planning.occupancy_grid import FREE, OCCUPIED, OccupancyGrid, write_ros_map
    from vssm_gym.viz.glb import write_glb
    from vssm_gym.viz.mesh import surface_mesh, write_ply

    check_new_folder(out)
    if "sequence" in read_metadata(map_file):
        expected = "a map whose z axis points up, of `vssm-gym map build`; this one is in its first camera's frame"
        raise InputError(map_file, "frame", f"{expected} (its mesh.ply lies beside it)")
    voxel_map = VoxelMap.load(map_file)
    grid = OccupancyGrid.from_voxel_map(voxel_map, resolution, height)
    mesh = surface_mesh(voxel_map)
    with whole_folder(out) as unfinished:
        write_ros_map(unfinished / "map.yaml", grid)
        write_ply(unfinished / "mesh.ply", mesh)
        write_glb(unfinished / "mesh.glb", mesh)
    share = {name: (grid.cells == value).mean() for name, value in (("free", FREE), ("occupied", OCCUPIED))}
    size = " x ".join(str(n) for n in grid.cells.shape)
    say(f"{size} cells of {resolution} m, {share['free']:.0%} free, {share['occupied']:.0%} occupied")
    say(f"{len(mesh.vertices):,} vertices, {len(mesh.faces):,} triangles", out)
