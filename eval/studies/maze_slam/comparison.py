"""Compare methods of SLAM in mazes: errors at the end, curves of errors with bands, and how right covariances are."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from vssm_gym.eval.studies.maze_slam.methods import ERRORS_EVERY, METHODS
from vssm_gym.eval.studies.page import Study
from vssm_gym.viz.pictures import svg

METHOD_NAMES = {
    "odometry": "path integration",
    "occupancy": "PRISM in the plane",
    "latent": "latent grid, on line",
    "latent_offline": "latent grid, off line",
    "strips_offline": "latent grid by a camera, off line",
    "graph": "scan matching, pose graph",
}
BANDS = {80: 0.15, 50: 0.3}  # % of the runs inside, and opacity


def study(rows: Sequence[dict[str, Any]], setting: dict[str, Any]) -> Study:
    """Return the outcome for a page."""
    methods = [method for method in METHODS if any(row["method"] == method for row in rows)]
    lines: list[list[str]] = []
    figures: dict[str, dict[str, Any]] = {}
    for method in methods:
        own = [row for row in rows if row["method"] == method]
        end, mean = (_of_traversals(own, what) for what in ("end", "mean"))
        stated = [row for row in own if row["nees"] is not None]
        speed = [row["steps"] / row["seconds"] for row in own if row["seconds"] > 0.0]
        figures[method] = {
            "end": float(end.mean()),
            "end_std": float(end.std()),
            "mean": float(mean.mean()),
            "nees": float(np.median([row["nees"] for row in stated])) if stated else None,
            "in_95": float(np.mean([row["in_95"] for row in stated])) if stated else None,
            "steps_per_second": float(np.median(speed)) if speed else None,
            "of_each_maze": {maze: float(_of_traversals(_of_maze(own, maze), "end").mean()) for maze in _mazes(own)},
            "runs": len(own),
            "traversals": len(end),
        }
        cell = lambda value, digits: "" if value is None else f"{value:.{digits}f}"
        of = figures[method]
        lines.append(
            [
                METHOD_NAMES[method],
                f"{of['end']:.4f} ± {of['end_std']:.4f}",
                cell(of["mean"], 4),
                cell(of["nees"], 1),
                cell(of["in_95"], 2),
                cell(of["steps_per_second"], 0),
                f"{of['runs']} of {of['traversals']}",
            ]
        )
    ends = [float(figures[method]["end"]) for method in methods]
    best = methods[int(np.argmin(ends))]
    return Study(
        name="maze-slam",
        question=f"How far off is SLAM after {setting['steps']:,} steps in a maze?",
        answer=f"{METHOD_NAMES[best]} is off by {min(ends):.4f} m at the end, the least.",
        header=("method", "error at the end, m", "mean error, m", "NEES / dim", "inside 95 %", "steps/s", "runs"),
        lines=lines,
        picture=picture(rows, methods),
        setting=setting,
        figures=figures,
        notes=(
            "Errors are distances from the true positions, both seen from the first pose. Seeds of the particles are "
            "averaged for each traversal, then mean and standard deviation are over traversals. NEES: the median over "
            "runs of the mean over steps. Steps a second include compilation; several passes count as one.",
        ),
    )


def picture(rows: Sequence[dict[str, Any]], methods: Sequence[str]) -> bytes:
    """Draw the errors of each method against steps: median, and bands of 50 and 80 % of the runs."""
    figure = Figure(figsize=(3.4 * len(methods), 3.2), layout="constrained")
    panels = figure.subplots(1, len(methods), sharey=True, squeeze=False)[0]
    for axes, method in zip(panels, methods, strict=True):
        errors = np.array([row["errors"] for row in rows if row["method"] == method])
        steps = ERRORS_EVERY * np.arange(errors.shape[1])
        for band, opacity in BANDS.items():
            low, high = np.percentile(errors, [50.0 - 0.5 * band, 50.0 + 0.5 * band], axis=0)
            axes.fill_between(steps, low, high, color="tab:blue", alpha=opacity, lw=0.0, label=f"{band} % of the runs")
        axes.plot(steps, np.median(errors, axis=0), color="tab:blue", label="median")
        axes.set(xlabel="steps", title=METHOD_NAMES[method], ylim=(0.0, None))
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("error of the position, m")
    panels[0].legend(loc="upper left", fontsize=8)
    return svg(figure)


def _of_traversals(rows: Sequence[dict[str, Any]], what: str) -> np.ndarray:
    """Return a figure of each traversal, the mean over the seeds that ran it."""
    keys = dict.fromkeys((row["maze"], row["traversal"]) for row in rows)
    return np.array([np.mean([row[what] for row in rows if (row["maze"], row["traversal"]) == key]) for key in keys])


def _mazes(rows: Sequence[dict[str, Any]]) -> list[str]:
    return list(dict.fromkeys(row["maze"] for row in rows))


def _of_maze(rows: Sequence[dict[str, Any]], maze: str) -> list[dict[str, Any]]:
    return [row for row in rows if row["maze"] == maze]
