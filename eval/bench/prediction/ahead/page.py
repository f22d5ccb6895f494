"""Arrange the rows as a table, an answer in words, and one self-contained page."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vssm_gym.eval.bench.prediction.ahead.measure import Measured
from vssm_gym.eval.bench.prediction.ahead.picture import picture
from vssm_gym.files.atomic import atomic_write
from vssm_gym.viz.html import Table, render, svg_image

QUESTION = "How well does a learned transition predict the next 100 steps?"
HEADER = (
    "model",
    "steps",
    "s",
    "position, m",
    "rotation, rad",
    "log p of the pose",
    "position in 95 %",
    "pose in 95 %",
    "nats a pixel",
    "depth",
    "colour",
    "CRPS depth, cm",
    "depth in 95 %",
)
PAGE_ONLY = ("s", "depth", "colour", "pose in 95 %")
WHOLE = ("model", "log p of the pose", "nats a pixel")  # columns that are not wrapped
NOTES = (
    "From each of many starts both models get the measured state and the recorded controls of the next 100 steps. "
    "euler integrates them as they are, with a Gaussian noise of each step; learned is the transition of the file. "
    "The noise of euler was fitted to other motion than is judged here: see the setting.",
    "Position and rotation: root mean square error of the path without noise, over all windows. Log p of the pose: "
    "density of the measured pose under a Gaussian in the tangent at the mean of sampled futures, metres and radians; "
    "its 95 % bootstrap interval is over stretches of the log as long as a window, since windows overlap.",
    "Nats a pixel: mean log density over the pixels of the image that was taken there, of the map rendered at sampled "
    "poses of the camera; the sum of depth and colour. Every fourth row and column is scored. Higher is better.",
    "Picture: paths from above, with ellipses that hold 95 % of the sampled places after 10, 30, 60 and 100 steps, and "
    "the measured places at these times as dots. Ellipses that are far wider than the paths are cut off.",
)


def line_of(row: Mapping[str, Any]) -> list[str]:
    """Return the cells of a row, in the order of :data:`HEADER`; those of images are empty where there are none."""
    image = row["image"]
    seen = [""] * 5
    if image is not None:
        percent = "" if image["depth_in_band"] is None else f"{image['depth_in_band']:.1%}"
        crps = "" if image["depth_crps"] is None else f"{100.0 * image['depth_crps']:.1f}"
        seen = [_with_bounds(image["nats"]), f"{image['depth_nats']:.2f}", f"{image['rgb_nats']:.2f}", crps, percent]
    return [
        row["model"],
        str(row["steps"]),
        f"{row['seconds']:g}",
        f"{row['position']:.3f}",
        f"{row['rotation']:.3f}",
        _with_bounds(row["pose_nats"]),
        f"{row['position_held']:.0%}",
        f"{row['pose_held']:.0%}",
        *seen,
    ]


def _with_bounds(value: Mapping[str, float | None]) -> str:
    bounds = "" if value["low"] is None else f" [{value['low']:.2f}, {value['high']:.2f}]"
    return f"{value['mean']:.2f}{bounds}"


def answer(result: Mapping[str, Any]) -> str:
    """Say how much nearer the learned transition is, and what its densities gain."""
    rows, last = result["rows"], result["gains"][-1]
    of = {row["model"]: row for row in rows if row["steps"] == last["steps"]}
    said = (
        f"After {last['steps']} steps ({of['learned']['seconds']:g} s) the learned transition is off by "
        f"{of['learned']['position']:.3f} m and {of['learned']['rotation']:.3f} rad, integration by "
        f"{of['euler']['position']:.3f} m and {of['euler']['rotation']:.3f} rad. Learned minus euler: "
        f"{_with_bounds(last['pose_nats'])} nats of the pose"
    )
    if last["image_nats"] is not None:
        said += f", {_with_bounds(last['image_nats'])} nats a pixel of the image"
    held = {name: f"{row['position_held']:.0%}" for name, row in of.items()}
    return f"{said}. Envelopes of 95 % hold {held['learned']} of the positions then, those of euler {held['euler']}."


def shown(result: Mapping[str, Any]) -> Sequence[int]:
    """Return the columns that a terminal has room for: those of images only where there are some."""
    images = any(row["image"] is not None for row in result["rows"])
    last = len(HEADER) if images else HEADER.index("nats a pixel")
    return [index for index, name in enumerate(HEADER[:last]) if name not in PAGE_ONLY]


def write_ahead(measured: Measured, stem: Path, version: str) -> Path:
    """Write ``STEM.svg`` and ``STEM.html``; return the page."""
    result, drawn = measured.result, picture(measured.judged, measured.foreseen)
    about = {name: result[name] for name in ("setting", "fitted", "machine")} | {"version": version}
    page = render(
        "prediction.html.j2",
        question=QUESTION,
        answer=answer(result),
        picture=svg_image(drawn),
        table=Table(HEADER, [line_of(row) for row in result["rows"]], HEADER.index("steps") + 1),
        notes=(*NOTES, *(f"Note: {notice}." for notice in result["notices"])),
        measured=about,
    )
    for suffix, content in (("svg", drawn), ("html", page.encode())):
        with atomic_write(stem.with_suffix(f".{suffix}")) as temporary:
            temporary.write_bytes(content)
    return stem.with_suffix(".html")
