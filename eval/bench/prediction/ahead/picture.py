"""Draw predicted paths with their envelopes against the truth, and errors and coverage against the steps ahead."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from vssm_gym.eval.bench.prediction.ahead.judged import Judged
from vssm_gym.eval.bench.prediction.ahead.states import Foreseen, Path
from vssm_gym.slam.states import AXIS_COLOURS, tidy
from vssm_gym.training.dynamics.evaluation import ENVELOPE
from vssm_gym.viz import pictures

COLOURS = {"euler": AXIS_COLOURS[2], "learned": pictures.ESTIMATE_COLOUR}
RINGS = (10, 30, 60, 100)  # steps after which an envelope is drawn
EXTENT_MARGIN = 0.15  # of the extent of the paths, around them


def picture(judged: Judged, foreseen: Mapping[str, Foreseen]) -> bytes:
    """Draw the figure as SVG.

    Args:
        judged: the windows.
        foreseen: by model.
    """
    figure = Figure(figsize=(10.0, 7.6), layout="constrained")
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.45, 1.0))[:, 0]
    shown = next(iter(foreseen.values())).paths
    for ax, place in zip(above.subplots(1, len(shown), squeeze=False)[0], range(len(shown)), strict=True):
        _paths(ax, {name: states.paths[place] for name, states in foreseen.items()})
        ax.set_title(f"from {judged.begins[shown[place].window] - judged.begins.min():.1f} s on", fontsize=9)
        if not place:
            ax.legend(fontsize=8, framealpha=0.9, edgecolor="none")  # envelopes lie behind it
    axes = below.subplots(1, 3)
    steps = np.arange(1, len(next(iter(foreseen.values())).position) + 1)
    for name, states in foreseen.items():
        for ax, values in zip(axes, (states.position, states.rotation), strict=False):
            ax.semilogy(steps, np.maximum(values, 1e-6), color=COLOURS[name], label=name)
        axes[2].plot(steps, 100.0 * states.held[:, 0].mean(axis=0), color=COLOURS[name], label=name)
    axes[2].axhline(100.0 * ENVELOPE, color="0.3", linestyle="--", linewidth=0.8)
    axes[2].set(ylim=(0.0, 103.0))
    for ax, title in zip(
        axes, ("RMSE of the position, m", "RMSE of the rotation, rad", "share of positions in 95 %, %"), strict=True
    ):
        ax.set_title(title, fontsize=9)
        ax.set_xlabel("steps ahead")
        tidy(ax)
    axes[0].legend(fontsize=8, frameon=False)
    return pictures.svg(figure)


def _paths(ax: Axes, models: Mapping[str, Path]) -> None:
    """Draw one window from above: truth, means, and what holds 95 % of the sampled places after some steps."""
    truth = next(iter(models.values())).truth[:, :2]
    ax.plot(*truth.T, color=pictures.TRUE_COLOUR, linewidth=2.2, label="measured", zorder=4)
    ax.plot(*truth[0], "o", color=pictures.TRUE_COLOUR, markersize=5, zorder=5)
    extent = [truth]
    for name, path in models.items():
        mean = np.concatenate([truth[:1], path.mean[:, :2]])
        ax.plot(*mean.T, color=COLOURS[name], linewidth=1.3, label=name, zorder=3)
        extent.append(mean)
        for steps in RINGS:
            if steps <= len(path.mean):
                ax.add_patch(ring(path.samples[:, steps - 1, :2], COLOURS[name]))
                ax.plot(*truth[steps], ".", color=pictures.TRUE_COLOUR, markersize=7, zorder=5)
    low, high = np.concatenate(extent).min(axis=0), np.concatenate(extent).max(axis=0)
    room = EXTENT_MARGIN * float((high - low).max()) + 0.05
    ax.set(xlim=(low[0] - room, high[0] + room), ylim=(low[1] - room, high[1] + room), xlabel="x, m", ylabel="y, m")
    ax.set_aspect("equal", adjustable="box")  # wide envelopes are cut off: the paths stay readable
    tidy(ax)


def ring(places: Float[np.ndarray, "paths 2"], colour: str) -> Ellipse:
    """Return the ellipse of the covariance of places that holds 95 % of them."""
    off = places - places.mean(axis=0)
    variances, axes = np.linalg.eigh(off.T @ off / (len(off) - 1))
    variances = np.maximum(variances, 1e-12)
    radius = np.sqrt(np.quantile(np.sum((off @ axes) ** 2 / variances, axis=1), ENVELOPE))
    width, height = 2.0 * radius * np.sqrt(variances)
    angle = float(np.degrees(np.arctan2(axes[1, 0], axes[0, 0])))
    return Ellipse(
        tuple(places.mean(axis=0)),
        width,
        height,
        angle=angle,
        facecolor=(colour, 0.06),
        edgecolor=colour,
        linewidth=0.9,
    )
