"""``vssm-gym slam SEQUENCE --out DIR``: a trajectory and a dense map from an RGB-D recording (DESIGN)."""

import contextlib
import re
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from vssm_gym.slam.run import TrackedFrame

INTRINSICS = "fx,fy,cx,cy[,k1,k2,p1,p2,k3]"
WARNINGS = 5  # printed; stats.json has all
RECENT = 20  # frames that the frame rate is told from


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
    method: Literal["prism", "tracker"] = "prism",
    map: Path | None = None,
    start: str | None = None,
    seed: int = 0,
    viewer: bool = False,
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
        extent: edge of the cube that is mapped around the camera, metres.
        intrinsics: fx,fy,cx,cy[,k1,k2,p1,p2,k3] of the recorded images, in place of those that the folder states.
        solver: of the pose: gauss_newton, or adam as PRISM was published (slower).
        samples: poses drawn for the map update, an odd number; from 3 on, pose and map hear of each other's doubts.
        max_depth: metres; farther readings are left out.
        depth: good (structured light, or stereo near by), or stereo: noisy and far away, as in flight.
        method: prism maps and tracks; tracker locates the camera in a map that is known and stays as it is.
        map: of the tracker: a map file, as of another run of slam, or of map build.
        start: of the tracker: x,y,z,qx,qy,qz,qw, about where the first camera is in the map; the map's origin else.
        imu: let imu.txt drive the prior, in place of constant velocity; the camera is at rest in the first half second.
        seed: of what is drawn: the samples, and the pixels of adam.
        viewer: show the run as it happens in rerun (the extra vssm-gym[viz]).
    """
    from vssm_gym.data.sequences import load_sequence
    from vssm_gym.slam import output as slam_output
    from vssm_gym.slam.run import SlamOptions
    from vssm_gym.viz.stream import open_viewer

    options = SlamOptions(
        _size(size),
        rate,
        voxel,
        extent,
        solver,
        samples,
        seed,
        max_depth=max_depth,
        depth=depth,
        imu=imu,
        method=method,
        map=map,
        start=None if start is None else _numbers("start", start, "x,y,z,qx,qy,qz,qw"),
    )
    slam_output.check_free(out)
    recording = load_sequence(sequence, None if intrinsics is None else _numbers("intrinsics", intrinsics, INTRINSICS))
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
    lost, again = len(stats["lost"]), len(stats["found_again"])
    print(f"{stats['frames']} frames, {lost} lost, {again} found again elsewhere{speed}")
    errors = stats["errors"] or {}
    if "impossible" in errors:
        print(f"errors against the ground truth cannot be computed: {errors['impossible']}")
    elif errors:
        held = ", lost frames held where they were last" if lost else ""
        print(f"ATE {100.0 * errors['ate_translation_se3']['rmse']:.2f} cm after SE(3) alignment{held}")
    print(out / slam_output.REPORT)


def print_warnings(notices: Sequence[str]) -> None:
    """What was wrong with the input, one line each on stderr: the first ones, and how many more there are."""
    for notice in notices[:WARNINGS]:
        print(f"warning: {notice}", file=sys.stderr)
    if len(notices) > WARNINGS:
        print(f"warning: and {len(notices) - WARNINGS} more like these", file=sys.stderr)


@contextlib.contextmanager
def _live() -> Iterator[tuple[Callable[[str, int, int], None], Callable[["TrackedFrame"], None]]]:
    """Bars on stderr, that of the frames with frames a second and how many were lost: what to tell, and of frames."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description:>24}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )
    bars: dict[str, TaskID] = {}
    ends, lost = deque([time.perf_counter()], maxlen=RECENT + 1), 0
    with Progress(*columns, console=Console(stderr=True)) as bar:

        def tell(stage: str, done: int, total: int) -> None:
            if stage not in bars:
                bars[stage] = bar.add_task(stage, total=total, note="")
            bar.update(bars[stage], completed=done)

        def tell_frame(frame: "TrackedFrame") -> None:
            nonlocal lost
            lost += frame.lost
            ends.append(time.perf_counter())
            speed = (len(ends) - 1) / (ends[-1] - ends[0])
            for task in bars.values():  # before the first frame is told of there is none
                bar.update(task, note=f"{speed:.1f} frames/s, {lost} lost")

        yield tell, tell_frame


def _size(text: str) -> tuple[int, int]:
    from vssm_gym.errors import InputError

    match = re.fullmatch(r"(\d{1,5})[xX](\d{1,5})", text.strip())
    if not match:
        raise InputError("slam", "size", f"WIDTHxHEIGHT in pixels, as 160x120, not {text!r}")
    return int(match[1]), int(match[2])


def _numbers(field: str, text: str, form: str) -> tuple[float, ...]:
    from vssm_gym.errors import InputError

    try:
        return tuple(float(word) for word in text.split(","))
    except ValueError:
        raise InputError("slam", field, f"numbers {form}, not {text!r}") from None
