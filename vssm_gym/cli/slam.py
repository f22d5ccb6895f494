"""``vssm-gym slam SEQUENCE --out DIR``: a trajectory and a dense map from an RGB-D recording (DESIGN)."""

import re
from pathlib import Path
from typing import Annotated

import tyro


def slam(
    sequence: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SEQUENCE")],
    out: Path,
    size: str = "160x120",
    rate: float = 10.0,
    voxel: float = 0.07,
    extent: float = 14.0,
    intrinsics: str | None = None,
) -> None:
    """Track a hand-held RGB-D camera and map what it saw, frame by frame.

    OUT gets trajectory.txt (TUM format: the pose of every frame in the first camera's frame), map.npz, mesh.ply,
    stats.json and report.html. Interrupt at any time: the finished frames' poses stay in trajectory.partial.txt.

    Args:
        sequence: TUM folder (rgb.txt and depth.txt, or associations.txt); groundtruth.txt is only compared with.
        out: new or empty folder for the results.
        size: WIDTHxHEIGHT that images are resized to.
        rate: frames a second at most; others are left out.
        voxel: size of a cell, metres.
        extent: edge of the cube that is mapped around the first camera, metres.
        intrinsics: fx,fy,cx,cy[,k1,k2,p1,p2,k3] of the recorded images, in place of those that the folder states.
    """
    from vssm_gym.cli.console import progress_bars
    from vssm_gym.data.sequences import load_sequence
    from vssm_gym.eval import slam_output
    from vssm_gym.eval.slam_run import SlamOptions

    options = SlamOptions(_size(size), rate, voxel, extent)
    slam_output.check_free(out)
    recording = load_sequence(sequence, None if intrinsics is None else _intrinsics(intrinsics))
    with progress_bars() as progress:
        stats = slam_output.process(recording, out, options, progress)
    step = stats["latency_ms"].get("track and update")
    speed = f", {step['p50']:.0f} ms a frame (median)" if step else ""
    print(f"{stats['frames']} frames, {len(stats['lost'])} lost{speed}")
    errors = stats["errors"] or {}
    if "impossible" in errors:
        print(f"no errors against the ground truth: {errors['impossible']}")
    elif errors:
        print(f"ATE {100.0 * errors['ate_translation_se3']['rmse']:.2f} cm after SE(3) alignment")
    print(out / slam_output.REPORT)


def _size(text: str) -> tuple[int, int]:
    from vssm_gym.errors import InputError

    match = re.fullmatch(r"(\d{1,5})[xX](\d{1,5})", text.strip())
    if not match:
        raise InputError("slam", "size", f"WIDTHxHEIGHT in pixels, as 160x120, not {text!r}")
    return int(match[1]), int(match[2])


def _intrinsics(text: str) -> tuple[float, ...]:
    from vssm_gym.errors import InputError

    try:
        return tuple(float(word) for word in text.split(","))
    except ValueError:
        raise InputError("slam", "intrinsics", f"numbers fx,fy,cx,cy[,k1,k2,p1,p2,k3], not {text!r}") from None
