"""Measure how accuracy and time depend on the resolution of the map and of tracking (PRISM, table 4).

Gauss-Newton is deterministic, so a seed alone would repeat a run exactly. Run k therefore also leaves out the first k
recorded frames: the thinned stream then has other images where the camera is faster than the filter, and the grid,
which is placed around the first camera, moves. The runs of all settings take turns.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from vssm_gym.data.sequences import Sequence
from vssm_gym.errors import InputError
from vssm_gym.eval.studies.page import Study, labelled
from vssm_gym.inference.tracking.localise import tracking_factor
from vssm_gym.progress import OnProgress
from vssm_gym.slam import trajectory_error
from vssm_gym.slam.options import SlamOptions
from vssm_gym.slam.run import SlamRun, run_slam
from vssm_gym.viz import pictures

MIN_FRAMES = 3  # fewer positions cannot be aligned


def run(
    sequence: Sequence,
    *,
    voxels: tuple[float, ...],
    render_widths: tuple[int, ...],
    size: tuple[int, int],
    rate: float,
    seeds: int,
    on_progress: OnProgress | None = None,
) -> Study:
    """Run every voxel size with every tracking width, ``seeds`` times each.

    Args:
        sequence: with ground truth.
        voxels: cell sizes, m.
        render_widths: widths at which images are tracked and rendered, pixels; the map takes them at ``size``.
        size: width and height that images are resized to.
        rate: frames a second at most.
        seeds: runs of each setting.
        on_progress: called after every frame.

    Raises:
        InputError: no ground truth, too few frames, or a setting that makes no sense.
    """
    if sequence.truth is None:
        raise InputError(sequence.root / "groundtruth.txt", "file", "ground-truth poses, which this study needs")
    if len(sequence.frames) < seeds + MIN_FRAMES:
        raise InputError(sequence.root, "frames", f"at least {seeds + MIN_FRAMES}, found {len(sequence.frames)}")
    options = {
        (voxel, width): SlamOptions(size=size, rate=rate, voxel=voxel, render_width=width)
        for voxel in voxels
        for width in render_widths
    }
    runs: dict[tuple[float, int], list[dict[str, Any]]] = {setting: [] for setting in options}
    tracked: dict[int, int] = {}  # requested render width -> the one that the image can be shrunk to
    notices: tuple[str, ...] = ()
    for seed in range(seeds):
        later = replace(sequence, frames=sequence.frames[seed:])
        for (voxel, width), chosen in options.items():
            label = f"{100 * voxel:g} cm, {width} px, run {seed + 1}"
            done = run_slam(later, replace(chosen, seed=seed), on_progress=labelled(on_progress, label))
            runs[voxel, width].append(_measured(done, sequence))
            tracked[width] = size[0] // tracking_factor(done.reader.camera, width)
            notices = done.notices
    arms = [
        {"voxel": voxel, "render_width": tracked[width], "cells": options[voxel, width].cells} | _summary(of)
        for (voxel, width), of in runs.items()
    ]
    return Study(
        name="resolution",
        question="Which resolutions do the map and the tracked image need?",
        answer=_answer(arms),
        header=("map", "tracked at", *LABELS.values()),
        lines=[
            [f"{100 * arm['voxel']:g} cm", f"{arm['render_width']} px", *(_text(n, arm) for n in LABELS)]
            for arm in arms
        ],
        picture=_picture(arms),
        setting={
            "sequence": sequence.root.resolve().name,
            "size": "x".join(map(str, size)),
            "rate": rate,
            "extent": SlamOptions.extent,
            "seeds": seeds,
        },
        figures={"arms": arms},
        notes=(
            "ATE is the RMSE of positions after SE(3) alignment, lost frames included; over the runs of a setting its "
            "mean and, in brackets, its range. Largest error and lost frames are those of the worst run. Run k leaves "
            "out the first k recorded frames.",
            "Milliseconds are those of a whole step once its image is read, over all runs, without the calls that "
            f"compile. Images enter the map at {'x'.join(map(str, size))} pixels, independent of the tracking size. "
            "Large cubes are stored block-sparse.",
            *notices,
        ),
    )


LABELS = {"ate_m": "ATE, cm", "max_m": "largest, cm", "lost": "lost frames", "step_ms": "ms a step", "p95": "95 %"}


def _measured(done: SlamRun, sequence: Sequence) -> dict[str, Any]:
    """Compute one run's errors (None where the estimate cannot be aligned), frames, lost frames and step times."""
    assert sequence.truth is not None
    try:
        errors = trajectory_error.evaluate(done.times, done.poses, *sequence.truth, deltas=(), alignments=("se3",))
        ate = errors["ate_translation_se3"]
    except InputError:
        ate = {"rmse": None, "max": None}
    return {
        "ate_m": ate["rmse"],
        "max_m": ate["max"],
        "frames": len(done.frames),
        "lost": int(done.lost.sum()),
        "steps_ms": [1e3 * frame.step_s for frame in done.frames if frame.warm],
    }


def _summary(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Summarise the runs of a setting; ``ate_m`` is None if one run has none, because other means would flatter."""
    ate = [run["ate_m"] for run in runs]
    whole = all(value is not None for value in ate)
    steps = np.concatenate([run["steps_ms"] for run in runs])
    median, p95 = np.percentile(steps, (50, 95)) if len(steps) else (None, None)
    return {
        "ate_m": float(np.mean(ate)) if whole else None,
        "ate_each_m": ate,
        "max_m": max(run["max_m"] for run in runs) if whole else None,
        "frames": max(run["frames"] for run in runs),
        "lost": max(run["lost"] for run in runs),
        "step_ms": None if median is None else float(median),
        "step_p95_ms": None if p95 is None else float(p95),
    }


def _text(name: str, arm: Mapping[str, Any]) -> str:
    match name:
        case "lost":
            return f"{arm['lost']} of {arm['frames']}"
        case "p95":
            return "-" if arm["step_p95_ms"] is None else f"{arm['step_p95_ms']:.1f}"
        case _ if arm[name] is None:
            return "-"
        case "step_ms":
            return f"{arm['step_ms']:.1f}"
        case "max_m":
            return f"{100 * arm['max_m']:.1f}"
    low, high = min(arm["ate_each_m"]), max(arm["ate_each_m"])
    spread = f" ({100 * low:.2f} to {100 * high:.2f})" if len(arm["ate_each_m"]) > 1 else ""
    return f"{100 * arm['ate_m']:.2f}{spread}"


def _answer(arms: list[dict[str, Any]]) -> str:
    """Name the most accurate setting among those that lost least, and the fastest within a tenth of its error."""
    followed = [arm for arm in arms if arm["ate_m"] is not None and arm["step_ms"] is not None]
    if not followed:
        return "No setting tracked the camera."
    best = min(followed, key=lambda arm: (arm["lost"], arm["ate_m"]))
    near = [arm for arm in followed if arm["lost"] <= best["lost"] and arm["ate_m"] <= 1.1 * best["ate_m"]]
    fast = min(near, key=lambda arm: arm["step_ms"])

    def said(arm: dict[str, Any]) -> str:
        return (
            f"cells of {100 * arm['voxel']:g} cm tracked at {arm['render_width']} pixels "
            f"(ATE {100 * arm['ate_m']:.2f} cm, {arm['step_ms']:.1f} ms a step, {arm['lost']} of {arm['frames']} lost)"
        )

    if fast is best:
        return f"Most accurate: {said(best)}; nothing faster comes within a tenth of its error."
    return f"Most accurate: {said(best)}. The fastest within a tenth of its error: {said(fast)}."


def _picture(arms: list[dict[str, Any]]) -> bytes:
    """Draw ATE with its range over the runs, and the step's median and 95th percentile, over cell size, as SVG."""
    figure = Figure(figsize=(9.6, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    for i, width in enumerate(dict.fromkeys(arm["render_width"] for arm in arms)):
        style = {"color": f"C{i}", "label": f"tracked at {width} px", "capsize": 3, "markersize": 5, "linewidth": 1.2}
        mine = sorted((arm for arm in arms if arm["render_width"] == width), key=lambda arm: arm["voxel"])
        aligned = [arm for arm in mine if arm["ate_m"] is not None]
        x, y = ([100 * arm[name] for arm in aligned] for name in ("voxel", "ate_m"))
        below = [100 * (arm["ate_m"] - min(arm["ate_each_m"])) for arm in aligned]
        above = [100 * (max(arm["ate_each_m"]) - arm["ate_m"]) for arm in aligned]
        left.errorbar(x, y, yerr=(below, above), fmt="o-", **style)
        timed = [arm for arm in mine if arm["step_ms"] is not None]
        x, y = [100 * arm["voxel"] for arm in timed], [arm["step_ms"] for arm in timed]
        above = [arm["step_p95_ms"] - arm["step_ms"] for arm in timed]
        right.errorbar(x, y, yerr=(np.zeros(len(y)), above), fmt="o-", **style)
    left.set(xlabel="cell size, cm", ylabel="ATE, cm", title="error: mean and range over the runs")
    right.set(xlabel="cell size, cm", ylabel="ms a step", title="time: median and 95th percentile")
    for axes in (left, right):
        axes.set_ylim(bottom=0.0)
        axes.set_xticks(sorted({100 * arm["voxel"] for arm in arms}))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    left.legend(fontsize=8, frameon=False)
    return pictures.svg(figure)
