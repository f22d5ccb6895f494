"""The car's figures: its footprint along a run on the learned map, and curves over all runs."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vssm_gym.car import Car
from vssm_gym.eval import aggregate, report_figures
from vssm_gym.eval.aggregate import Row
from vssm_gym.viz import pictures

CAR = Car()
SPACING = 0.3  # m driven between two footprints
VISIBLE = 0.005  # m, of an error of location
ARROW = 0.3  # m, of a heading
PERIOD = 1e3 * CAR.dt  # ms: later commands come too late


def run_picture(row: Row, background: pictures.Background | None) -> bytes:
    """One episode on the learned map as WebP: footprints along the true path, start and target pose, touches."""
    figure = Figure(figsize=(5.0, 4.2), layout="constrained")
    axes = figure.subplots()
    pictures.draw_background(axes, background)
    poses = np.asarray(row["trace"].get("poses", []), dtype=float).reshape(-1, 3)
    if len(poses):
        shown = poses[apart(poses, SPACING)]
        pictures.draw_outlines(axes, CAR.corners(shown[1:-1]), pictures.TRUE_COLOUR)
        pictures.draw_outlines(axes, CAR.corners(shown[[0, -1]]), pictures.TRUE_COLOUR, filled=True)
    pictures.draw_run(axes, {**row, "goal": row["goal"][:2], "trace": _trace(row)}, float(row["success_radius"]))
    draw_target(axes, row["goal"])
    if background is None:
        axes.margins(0.2)
    else:
        axes.set(xlim=background.extent[:2], ylim=background.extent[2:])
    return pictures.webp(figure, dpi=100)


def _trace(row: Row) -> dict[str, Any]:
    """The trace without an estimate that is the truth, as of agents that observe the pose."""
    trace = row["trace"]
    off = (row["location_error_max"] or 0.0) > VISIBLE
    return {**trace, "estimate": trace["estimate"] if off else None}


def draw_target(axes: Axes, goal: Sequence[float]) -> None:
    """The footprint of a target pose and its heading from the rear axle; nothing for a point."""
    if len(goal) < 3:
        return
    x, y, heading = goal
    pictures.draw_outlines(axes, CAR.corners(np.array([[x, y, heading]])), pictures.GOAL_COLOUR, filled=True)
    tip = x + ARROW * math.cos(heading), y + ARROW * math.sin(heading)
    arrow = {"arrowstyle": "-|>", "color": "black", "lw": 0.9, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", xy=tip, xytext=(x, y), arrowprops=arrow, zorder=7)


def apart(poses: np.ndarray, spacing: float) -> np.ndarray:
    """Indices of the poses ``(n, 3)`` nearest to every ``spacing`` m of way, first and last among them."""
    driven = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1))])
    marks = np.arange(0.0, driven[-1], spacing)
    return np.unique([*(int(np.abs(driven - mark).argmin()) for mark in marks), len(poses) - 1])


def curves(rows: Sequence[Row], seed: int) -> bytes:
    """Three panels as SVG: share of targets reached by a time, path over its lower bound, latency of a control."""
    del seed  # nothing is resampled
    figure = Figure(figsize=(11.5, 3.3), layout="constrained")
    reached, ratio, latency = figure.subplots(1, 3)
    for (agent,), members in aggregate.group_rows(rows, ["agent"]).items():
        style = {"color": report_figures.colours(rows)[agent], "label": agent, "where": "post"}
        for axes, metric, n in (
            (reached, "seconds_driven", len(members)),
            (ratio, "path_ratio", None),
            (latency, "decision_p95", None),
        ):
            x = np.sort([row[metric] for row in members if row[metric] is not None])
            if len(x):
                axes.step([x[0], *x], np.arange(len(x) + 1) / (n or len(x)), **style)
    reached.set(xlabel="time, s", ylabel="share of targets reached", xlim=(0, None))
    ratio.set(xlabel="path / shortest Reeds-Shepp curve", ylabel="share of those reached", xlim=(0.9, None))
    latency.set(xlabel="95 % point of an episode's controls, ms", ylabel="share of episodes", xscale="log")
    latency.axvline(PERIOD, color="black", linewidth=0.7, linestyle=pictures.DASHES)
    for axes in (reached, ratio, latency):
        axes.set_ylim(-0.02, 1.04)
        axes.grid(alpha=0.3, linewidth=0.5)
        axes.spines[["top", "right"]].set_visible(False)
    figure.legend(*latency.get_legend_handles_labels(), loc="outside lower center", ncols=7, frameon=False, fontsize=9)
    return pictures.svg(figure)


def legend() -> bytes:
    """The key to every run's picture, once."""
    return report_figures.legend(pictures.footprint_handles())
