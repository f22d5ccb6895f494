"""Measure the time of each stage of a step, by image size, cell size and extent of the map (PRISM, fig. 5).

One of the three is varied at a time, around the default. Every setting is run twice and all of them take turns, so
that changes of the machine's speed affect all of them.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from vssm_gym.data.sequences import Sequence
from vssm_gym.errors import InputError
from vssm_gym.eval.studies.page import Study, labelled
from vssm_gym.progress import OnProgress
from vssm_gym.slam.options import MAX_DENSE_CELLS, SlamOptions
from vssm_gym.slam.run import TrackedFrame, run_slam
from vssm_gym.viz import pictures

IMAGE_SIZES = ((80, 60), (160, 120), (320, 240))  # pixels; those up to the recorded size are run
VOXELS = (0.04, 0.07, 0.10)  # m
EXTENTS = (7.0, 14.0, 28.0)  # m
ROUNDS = 2  # runs of every configuration, in turn, so that a busy spell meets all of them
STAGES = ("track", "map", "reference", "recover", "rest")  # in the order of the bars; rest: time in no stage
COLOURS = {"track": "#4477aa", "map": "#66aa77", "reference": "#ddaa33", "recover": "#bb5566", "rest": "#c4c9cf"}


def settings(recorded: tuple[int, int], rate: float) -> dict[tuple[str, str], SlamOptions]:
    """Return the options of each run by ``(what is varied, its value)``; the default is in every group.

    Args:
        recorded: width and height of the recorded images.
        rate: frames a second at most.
    """
    default = SlamOptions(rate=rate)
    sizes = [size for size in IMAGE_SIZES if size[0] <= recorded[0] and size[1] <= recorded[1]]
    chosen = {("image", "x".join(map(str, size))): replace(default, size=size) for size in sizes}
    chosen |= {("cell", f"{100 * voxel:g} cm"): replace(default, voxel=voxel) for voxel in VOXELS}
    return chosen | {("extent", f"{extent:g} m"): replace(default, extent=extent) for extent in EXTENTS}


def run(sequence: Sequence, *, rate: float, on_progress: OnProgress | None = None) -> Study:
    """Time every setting on the same frames.

    Args:
        sequence: the recording; ground truth is not needed.
        rate: frames a second at most.
        on_progress: called after every frame.

    Raises:
        InputError: images below the default size, or too few frames to compile everything.
    """
    camera = sequence.camera
    if camera.width < SlamOptions.size[0] or camera.height < SlamOptions.size[1]:
        least = "x".join(map(str, SlamOptions.size))
        raise InputError(sequence.root, "size", f"images of at least {least}, not {camera.width}x{camera.height}")
    chosen = settings((camera.width, camera.height), rate)
    frames: dict[SlamOptions, list[TrackedFrame]] = {options: [] for options in chosen.values()}
    notices: tuple[str, ...] = ()
    for turn in range(ROUNDS):
        for i, options in enumerate(frames):
            label = f"setting {i + 1} of {len(frames)}, round {turn + 1}"
            done = run_slam(sequence, options, on_progress=labelled(on_progress, label))
            frames[options] += done.frames
            notices = done.notices
    arms: list[dict[str, Any]] = [
        {"varied": varied, "value": value, "cells": options.cells, "sparse": options.cells > MAX_DENSE_CELLS}
        | _timed(frames[options], sequence)
        for (varied, value), options in chosen.items()
    ]
    default = SlamOptions(rate=rate)
    return Study(
        name="runtime",
        question="Where does the time of a step go?",
        answer=_answer(arms, default),
        header=("varied", "", "lost", *(f"{name}, ms (95 %)" for name in ("step", *STAGES, "read"))),
        lines=[
            [arm["varied"], arm["value"] + (", sparse" if arm["sparse"] else ""), f"{arm['lost']:.1%}",
             *(_text(arm["ms"].get(name)) for name in ("step", *STAGES, "read"))]
            for arm in arms
        ],
        picture=_picture(arms),
        setting={
            "sequence": sequence.root.resolve().name,
            "rate": rate,
            "rounds": ROUNDS,
            "default": {"size": "x".join(map(str, default.size)), "voxel": default.voxel, "extent": default.extent},
            "render_width": default.render_width,
        },
        figures={"arms": arms},
        notes=(
            "Table: median and 95th percentile over the frames in which a stage ran, without calls that compile. A "
            "reference view is rendered only where the camera has left the last one, so medians do not add up to the "
            "step.",
            "Picture: coloured, the mean of each stage over all steps, of which the slowest twentieth is left out; "
            "these add up to the mean step. The dot is the median step, the line ends at its 95th percentile. Reading, "
            "which runs in a thread of its own, is the hollow bar.",
            f"Images are tracked at about {default.render_width} pixels width at every size; the map is updated with "
            f"all of their pixels. Cubes of more than {MAX_DENSE_CELLS:,} cells are stored block-sparse.",
            *notices,
        ),
    )  # fmt: skip


def _timed(frames: list[TrackedFrame], sequence: Sequence) -> dict[str, Any]:
    """Return ``ms``, median and p95 of the step, each stage and reading, and ``mean_ms``, which adds up to a step."""
    warm = [frame for frame in frames if frame.warm]
    if not warm:
        raise InputError(sequence.root, "frames", "more frames: the steps of all of these compile")
    steps = [frame.stages | {"rest": frame.step_s - sum(frame.stages.values())} for frame in warm]
    seconds = {"step": [frame.step_s for frame in warm], "read": [frame.read_s for frame in warm]}
    seconds |= {name: ran for name in STAGES if (ran := [step[name] for step in steps if name in step])}
    usual = np.percentile(seconds["step"], 95)
    kept = [step for step, frame in zip(steps, warm, strict=True) if frame.step_s <= usual]
    return {
        "frames": len(frames),
        "lost": float(np.mean([frame.lost for frame in frames])),
        "ms": {name: _percentiles(values) for name, values in seconds.items()},
        "mean_ms": {name: 1e3 * float(np.mean([step.get(name, 0.0) for step in kept])) for name in STAGES},
    }


def _percentiles(seconds: list[float]) -> dict[str, float]:
    p50, p95 = 1e3 * np.percentile(seconds, (50, 95))
    return {"p50": float(p50), "p95": float(p95), "n": len(seconds)}


def _text(ms: Mapping[str, float] | None) -> str:
    return "-" if ms is None else f"{ms['p50']:.1f} ({ms['p95']:.1f})"


def _answer(arms: list[dict[str, Any]], default: SlamOptions) -> str:
    """State the default's step and its largest stages."""
    size = "x".join(map(str, default.size))
    arm = next(arm for arm in arms if (arm["varied"], arm["value"]) == ("image", size))
    step, whole = arm["ms"]["step"], sum(arm["mean_ms"].values())
    share = {name: ms / whole for name, ms in arm["mean_ms"].items()}
    order = sorted((name for name in STAGES if share[name] >= 0.005), key=lambda name: -share[name])
    return (
        f"At {size} pixels, cells of {100 * default.voxel:g} cm and a cube of {default.extent:g} m a step takes "
        f"{step['p50']:.1f} ms (median) and {step['p95']:.1f} ms at the 95th percentile, that is "
        f"{1e3 / step['p50']:.0f} images a second. Proportions: {', '.join(f'{n} {share[n]:.0%}' for n in order)}."
    )


def _picture(arms: list[dict[str, Any]]) -> bytes:
    """Draw the stacked stages of each setting, one panel for each varied quantity, as SVG."""
    groups = list(dict.fromkeys(arm["varied"] for arm in arms))
    figure = Figure(figsize=(10.4, 3.8), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(groups), sharey=True))
    shown = [name for name in STAGES if any(arm["mean_ms"][name] > 0.0 for arm in arms)]
    for axes, group in zip(panels, groups, strict=True):
        mine = [arm for arm in arms if arm["varied"] == group]
        x, floor = np.arange(len(mine)), np.zeros(len(mine))
        for name in shown:
            height = np.array([arm["mean_ms"][name] for arm in mine])
            axes.bar(x - 0.12, height, 0.5, bottom=floor, color=COLOURS[name], label=name)
            floor += height
        step = np.array([[arm["ms"]["step"][q] for q in ("p50", "p95")] for arm in mine])
        axes.errorbar(x - 0.12, step[:, 0], yerr=(np.zeros(len(mine)), step[:, 1] - step[:, 0]), fmt="o", color="black",
                      markersize=3.5, capsize=3, linewidth=1.0, label="step: median, 95 %")  # fmt: skip
        read = [arm["ms"]["read"]["p50"] for arm in mine]
        axes.bar(x + 0.27, read, 0.2, facecolor="none", edgecolor="0.45", label="read, in its own thread")
        axes.set_xticks(x, [arm["value"] + ("\nsparse" if arm["sparse"] else "") for arm in mine])
        axes.set_title({"image": "image size", "cell": "cell size", "extent": "extent of the map"}[group])
        axes.grid(axis="y", alpha=0.3)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("ms a step")
    figure.legend(
        *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=7, frameon=False, fontsize=8
    )
    return pictures.svg(figure)
