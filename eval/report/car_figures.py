"""Draw the car's figures: its footprint along a run on the learned map, and curves over all runs."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vssm_gym.eval.metrics import aggregate
from vssm_gym.eval.metrics.metric import Row
from vssm_gym.eval.report import figures
from vssm_gym.geometry.car import Car
from vssm_gym.viz import pictures

CAR = Car()
FOOTPRINT_SPACING = 0.3  # m driven between two footprints
VISIBLE = 0.005  # m: smaller location errors are not drawn
ARROW = 0.3  # m, length of the arrow of a heading
# Panels of the curves: metric -> labels and limits of its axes.
PANELS: dict[str, dict[str, Any]] = {
    "seconds_driven": {"xlabel": "time, s", "ylabel": "proportion of targets reached", "xlim": (0, None)},
    "path_ratio": {
        "xlabel": "path / shortest Reeds-Shepp curve",
        "ylabel": "proportion of those reached",
        "xlim": (0.9, None),
    },
    "control_p95_ms": {
        "xlabel": "95 % point of an episode's controls, ms",
        "ylabel": "proportion of episodes",
        "xscale": "log",
    },
}
PERIOD = 1e3 * CAR.dt  # ms: the time between two commands


def run_picture(row: Row, background: pictures.Background | None) -> bytes:
    """Draw one episode on the learned map as WebP: footprints along the true path, start, target, collisions."""
    figure = Figure(figsize=(5.0, 4.2), layout="constrained")
    axes = figure.subplots()
    pictures.draw_background(axes, background)
    poses = np.asarray(row["trace"].get("poses") or [], dtype=float).reshape(-1, 3)
    if len(poses):
        shown = poses[apart(poses, FOOTPRINT_SPACING)]
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
    """Return the trace, without an estimate that equals the truth, as of agents that observe the pose."""
    trace = row["trace"]
    off = (row.get("location_error_max") or 0.0) > VISIBLE
    return {**trace, "estimate": trace.get("estimate") if off else None}


def draw_target(axes: Axes, goal: Sequence[float]) -> None:
    """Draw the footprint of a target pose and its heading from the rear axle; nothing for a point."""
    if len(goal) < 3:
        return
    x, y, heading = goal
    pictures.draw_outlines(axes, CAR.corners(np.array([[x, y, heading]])), pictures.GOAL_COLOUR, filled=True)
    tip = x + ARROW * math.cos(heading), y + ARROW * math.sin(heading)
    arrow = {"arrowstyle": "-|>", "color": "black", "lw": 0.9, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", xy=tip, xytext=(x, y), arrowprops=arrow, zorder=7)


def apart(poses: np.ndarray, spacing: float) -> np.ndarray:
    """Return indices of poses ``(n, 3)`` about every ``spacing`` m of the path, first and last among them."""
    driven = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1))])
    marks = np.arange(0.0, driven[-1], spacing)
    return np.unique([*(int(np.abs(driven - mark).argmin()) for mark in marks), len(poses) - 1])


def curves(rows: Sequence[Row], seed: int) -> bytes:
    """Draw panels as SVG: proportion of targets reached over time, path over its lower bound, latency of a control.

    A panel for which no row has a value is left out.
    """
    del seed  # nothing is resampled
    panels = {name: draw for name, draw in PANELS.items() if any(row[name] is not None for row in rows)}
    figure = Figure(figsize=(0.5 + 3.67 * max(1, len(panels)), 3.3), layout="constrained")
    key: dict[str, Any] = {}
    for axes, (name, style) in zip(
        np.atleast_1d(figure.subplots(1, max(1, len(panels)))), panels.items(), strict=False
    ):
        for (agent,), members in aggregate.group_rows(rows, ["agent"]).items():
            x = np.sort([row[name] for row in members if row[name] is not None])
            if len(x):
                of = len(members) if name == "seconds_driven" else len(x)  # runs that did not arrive count there
                colour = figures.colours(rows)[agent]
                (key[agent],) = axes.step([x[0], *x], np.arange(len(x) + 1) / of, color=colour, where="post")
        axes.set(**style)
        if name == "control_p95_ms":
            axes.axvline(PERIOD, color="black", linewidth=0.7, linestyle=pictures.DASHES)
        axes.set_ylim(-0.02, 1.04)
        axes.grid(alpha=0.3, linewidth=0.5)
        axes.spines[["top", "right"]].set_visible(False)
    order = [agent for agent in figures.colours(rows) if agent in key]
    figure.legend([key[a] for a in order], order, **figures.key_of(order))
    return pictures.svg(figure)


def legend() -> bytes:
    """Draw the key to the pictures of runs."""
    return figures.legend(pictures.footprint_handles())
