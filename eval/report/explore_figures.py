"""Draw the explorers' figures: curves over path length and time, runs that reached a coverage, runs on their maps."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from vssm_gym.eval.metrics.aggregate import group_rows
from vssm_gym.eval.metrics.exploration import COVERAGE_GOAL, COVERAGE_LEVELS, mean_curve
from vssm_gym.eval.metrics.metric import Row
from vssm_gym.eval.report.figures import colours, key_of
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.viz import pictures

PLAN_CELL = 0.07  # m, pixel of a plan; coarse, because an explorer's map is larger than the apartment
KNOWN_MARGIN = 0.3  # m of unknown space that a plan keeps around known space
MEAN_POINTS = 61  # points of a mean curve
CURVES = {"entropy": ("entropy of the map, Mnat", 1e-6), "coverage": ("coverage, %", 100.0)}
CURVES |= {"completeness": ("surface complete, %", 100.0)}
SCENE_COLUMNS = 4  # panels in a row of the figure of scenes
PATH_COLOURS = "viridis"
MARKS = {"50": "v", "90": "D", "95": "s", "99": "*"}  # where a run had reached a level of coverage, %


def curves(rows: Sequence[Row], seed: int) -> bytes:
    """Draw six panels as SVG: entropy, coverage and completeness over path length and time, with 95 % bands."""
    figure = Figure(figsize=(11.5, 6.4), layout="constrained")
    panels = figure.subplots(2, 3)
    for line, (axis, unit) in zip(panels, (("metres", "path length, m"), ("seconds", "time, s")), strict=True):
        grid = np.linspace(0.0, _end(rows, axis), MEAN_POINTS)
        for axes, (name, (label, factor)) in zip(line, CURVES.items(), strict=True):
            for agent, members in _agents(rows):
                mean, low, high = factor * mean_curve(members, name, axis, grid, seed)
                axes.plot(grid, mean, color=colours(rows)[agent], label=agent, linewidth=1.4)
                axes.fill_between(grid, low, high, color=colours(rows)[agent], alpha=0.15, linewidth=0)
            axes.set(xlabel=unit, ylabel=label, xlim=(0, grid[-1]))
            _plain(axes)
    _key(figure, panels[0, 1])
    return pictures.svg(figure)


def reached(rows: Sequence[Row]) -> bytes:
    """Draw the proportion of all runs that had reached each level of coverage by a path length, as SVG."""
    figure = Figure(figsize=(11.5, 3.2), layout="constrained")
    panels = figure.subplots(1, len(COVERAGE_LEVELS), sharey=True)
    for axes, level in zip(panels, COVERAGE_LEVELS, strict=True):
        name = f"metres_{level}"
        longest = max((row[name] for row in rows if row[name] is not None), default=1.0)
        for agent, members in _agents(rows):
            x = np.sort([row[name] for row in members if row[name] is not None])
            y = np.arange(len(x) + 1) / len(members)
            axes.step([0.0, *x, longest], [*y, y[-1]], where="post", color=colours(rows)[agent], label=agent)
        axes.set(xlabel=f"metres to {level} % coverage", xlim=(0, None), ylim=(-0.02, 1.04))
        _plain(axes)
    panels[0].set_ylabel("proportion of runs")
    _key(figure, panels[0])
    return pictures.svg(figure)


def scenes(rows: Sequence[Row], seed: int) -> bytes:
    """Draw mean coverage over path length in each scene, as SVG, with intervals over starts."""
    groups = group_rows(rows, ["scene"])
    columns, lines = SCENE_COLUMNS, math.ceil(len(groups) / SCENE_COLUMNS)
    figure = Figure(figsize=(2.9 * columns, 2.3 * lines + 0.4), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes, ((scene,), members) in zip(panels, groups.items(), strict=False):
        grid = np.linspace(0.0, _end(members, "metres"), MEAN_POINTS)
        for agent, runs in _agents(members):
            mean, low, high = 100.0 * mean_curve(runs, "coverage", "metres", grid, seed)
            axes.plot(grid, mean, color=colours(rows)[agent], label=agent, linewidth=1.2)
            axes.fill_between(grid, low, high, color=colours(rows)[agent], alpha=0.15, linewidth=0)
        axes.axhline(COVERAGE_GOAL, color="black", linewidth=0.6, linestyle=pictures.DASHES)
        axes.set(title=scene, xlim=(0, grid[-1]), ylim=(0, 102))
        axes.title.set_fontsize(9)
        _plain(axes)
    for axes in panels[len(groups) :]:
        axes.set_axis_off()
    for axes in panels[max(0, len(groups) - columns) : len(groups)]:
        axes.set_xlabel("path length, m")
    for axes in panels[: len(groups) : columns]:
        axes.set_ylabel("coverage, %")
    _key(figure, panels[0])
    return pictures.svg(figure)


def _agents(rows: Sequence[Row]) -> list[tuple[str, list[Row]]]:
    return [(agent, members) for (agent,), members in group_rows(rows, ["agent"]).items()]


def _end(rows: Sequence[Row], axis: str) -> float:
    """Return the end of curves: the time limit, or the median path length of the agent that drives farthest."""
    if axis == "seconds":
        return max(float(row["budget"]["seconds"]) for row in rows)
    return max(float(np.median([row["path_length"] for row in members])) for _, members in _agents(rows))


def _plain(axes: Axes) -> None:
    axes.grid(alpha=0.3, linewidth=0.5)
    axes.spines[["top", "right"]].set_visible(False)


def _key(figure: Figure, axes: Axes) -> None:
    figure.legend(*axes.get_legend_handles_labels(), **key_of(axes.get_legend_handles_labels()[1]))


def plan_of(m: VoxelMap) -> pictures.Background:
    """Draw a map from above, cropped to its known part."""
    full = pictures.topdown(m, pictures.CUT_HEIGHT, PLAN_CELL)
    known = (full.image != pictures.UNKNOWN_COLOUR).any(axis=2)
    if not known.any():
        return full
    keep = round(KNOWN_MARGIN / PLAN_CELL)
    rows, columns = (np.flatnonzero(known.any(axis=a)) for a in (1, 0))
    low = np.maximum([columns[0] - keep, rows[0] - keep], 0)
    high = np.minimum([columns[-1] + keep + 1, rows[-1] + keep + 1], known.shape[::-1])
    (x, right), (y, top) = (full.extent[2 * a] + PLAN_CELL * np.array([low[a], high[a]]) for a in (0, 1))
    image = full.image[low[1] : high[1], low[0] : high[0]]
    return pictures.Background(image, (float(x), float(right), float(y), float(top)))


def run_picture(row: Row, background: pictures.Background | None) -> bytes:
    """Draw one run as WebP: its path, dark at the start and bright at the end, and where it reached which coverage."""
    figure = Figure(figsize=(4.6, 4.0), layout="constrained")
    axes = figure.subplots()
    pictures.draw_background(axes, background)
    path = np.asarray(row["trace"]["true"], dtype=float).reshape(-1, 2)
    pieces = LineCollection(list(np.stack([path[:-1], path[1:]], axis=1)), cmap=PATH_COLOURS, linewidths=1.5, zorder=3)
    pieces.set_array(np.arange(len(path) - 1))
    axes.add_collection(pieces)
    axes.plot(*path[0], "o", color="white", markeredgecolor="black", markersize=6, zorder=6)
    axes.plot(*path[-1], "s", color="white", markeredgecolor="black", markersize=5, zorder=6)
    for level, place in row["trace"]["reached"].items():
        if level not in MARKS:  # of another version, which marked other levels
            continue
        axes.plot(*place, MARKS[level], color=pictures.GOAL_COLOUR, markeredgecolor="black", markersize=7, zorder=7)
    contacts = np.asarray(row["trace"]["contacts"] or [], dtype=float).reshape(-1, 2)
    axes.plot(*contacts.T, "x", color="red", markersize=5, markeredgewidth=1.2, zorder=8)
    if background is None:
        axes.margins(0.2)
        axes.autoscale_view()
    else:
        axes.set(xlim=background.extent[:2], ylim=background.extent[2:])
    return pictures.webp(figure)


def legend() -> bytes:
    """Draw the key to the pictures of runs."""
    style: dict[str, Any] = {"linestyle": "", "markeredgecolor": "black"}
    handles = [
        Line2D([], [], color="#3b528b", linewidth=1.6, label="path, first dark, last bright"),
        Line2D([], [], marker="o", color="white", markersize=6, label="start", **style),
        Line2D([], [], marker="s", color="white", markersize=5, label="end", **style),
        *(
            Line2D([], [], marker=mark, color=pictures.GOAL_COLOUR, markersize=7, label=f"{level} % covered", **style)
            for level, mark in MARKS.items()
        ),
        Line2D([], [], marker="x", color="red", linestyle="", markersize=5, label="contact"),
    ]
    figure = Figure(figsize=(9.5, 0.6))
    figure.legend(handles=handles, loc="center", ncols=-(-len(handles) // 2), frameon=False, fontsize=9)
    return pictures.svg(figure)
