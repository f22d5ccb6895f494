"""Draw pictures of one exploration: a choice among candidates coloured by gain, and the whole run on its map.

The gain is that of :class:`vssm_gym.agents.exploration.mi_explorer.Tour`: the expected information, in nats, of images
around a viewpoint in addition to the viewpoints before it, minus the price of a viewpoint.
"""

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colorbar import Colorbar
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator

from vssm_gym.eval.report.explore_figures import plan_of
from vssm_gym.eval.video.explorer_recording import Moment, Recording
from vssm_gym.eval.video.pictures import (
    DRIVEN_COLOUR,
    HALO,
    KEY,
    PATH_COLOUR,
    bare,
    cell_handles,
    draw_plan,
    draw_robot,
    draw_scale,
    path_handles,
)
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.viz import pictures

GAIN_COLOURS = TIME_COLOURS = "viridis"
LEAST_GAIN = 1.0  # 10^3 nats, where the colours of gain begin
CANDIDATE: dict[str, Any] = {"s": 95.0, "edgecolors": "black", "linewidths": 0.8}
CHOSEN: dict[str, Any] = {"marker": "o", "fillstyle": "none", "markersize": 17, "markeredgewidth": 2.2}


def gain_norm(recording: Recording) -> LogNorm | None:
    """Return the colour scale of all gains of a run, 10^3 nats; None for an agent that shows none."""
    most = max((float(m.tour.nats.max()) for m in recording.moments if m.tour is not None), default=0.0)
    return LogNorm(LEAST_GAIN, max(1e-3 * most, 2.0 * LEAST_GAIN)) if most > 0.0 else None


def label_gain(bar: Colorbar) -> None:
    """Add a title and round numbers to the colour bar of :func:`gain_norm`."""
    bar.set_label("expected information minus a viewpoint's price, 10^3 nats")
    bar.locator, bar.formatter = LogLocator(subs=(1.0, 2.0, 5.0)), FuncFormatter(lambda value, _: f"{value:g}")
    bar.minorticks_off()
    bar.update_ticks()


def candidates(moment: Moment, recording: Recording) -> Figure:
    """Draw the moment's plan with the path so far and the candidates, coloured by gain; the chosen one is ringed."""
    tour, norm = moment.tour, gain_norm(recording)
    assert tour is not None
    assert norm is not None
    bounds = recording.bounds()
    figure, axes = _sheet(bounds)
    draw_plan(axes, moment.plan, bounds)
    axes.plot(*recording.track.until(moment.seconds).T, color=DRIVEN_COLOUR, linewidth=1.6, path_effects=HALO, zorder=3)
    if moment.path is not None:
        axes.plot(*moment.path.T, color=PATH_COLOUR, linewidth=2.0, path_effects=HALO, zorder=4)
    order = np.argsort(tour.nats)  # the best on top
    (x, y), gain = tour.xy[order].T, 1e-3 * tour.nats[order]
    dots = axes.scatter(x, y, c=gain, cmap=GAIN_COLOURS, norm=norm, zorder=5, **CANDIDATE)
    axes.plot(*tour.xy[tour.first], color=PATH_COLOUR, zorder=6, **CHOSEN)
    draw_robot(axes, moment.planar)
    label_gain(figure.colorbar(dots, ax=axes, shrink=0.8, pad=0.02))
    axes.set_title(
        f"{100.0 * moment.coverage:.0f} % covered after {moment.metres:.1f} m, {moment.seconds:.0f} s", fontsize=10
    )
    draw_scale(axes, bounds)
    figure.legend(handles=key_handles(with_gain=True), loc="outside lower center", **KEY)
    return figure


def run(recording: Recording, m: VoxelMap, row: dict[str, Any]) -> Figure:
    """Draw the whole path on the run's final map, dark at the start and bright at the end."""
    background = plan_of(m)
    left, right, bottom, top = background.extent
    bounds = np.array([[left, bottom], [right, top]])
    figure, axes = _sheet(bounds)
    pictures.draw_background(axes, background)
    bare(axes)
    path, seconds = np.array(recording.track.path)[:, :2], np.array(recording.track.seconds)
    axes.plot(*path.T, color="white", linewidth=4.2, zorder=2.9)
    pieces = LineCollection(
        list(np.stack([path[:-1], path[1:]], axis=1)), cmap=TIME_COLOURS, linewidths=2.2, zorder=3, capstyle="round"
    )
    pieces.set_array(seconds[1:])
    axes.add_collection(pieces)
    style: dict[str, Any] = {"color": "white", "markeredgecolor": "black", "linestyle": ""}
    axes.plot(*path[0], "o", markersize=10, zorder=6, label="start", **style)
    axes.plot(*path[-1], "s", markersize=9, zorder=6, label="end", **style)
    axes.set(xlim=(left, right), ylim=(bottom, top))
    figure.colorbar(pieces, ax=axes, shrink=0.8, pad=0.02, label="time, s")
    axes.set_title(
        f"{100.0 * row['coverage']:.0f} % covered after {row['path_length']:.1f} m, {row['seconds']:.0f} s", fontsize=10
    )
    draw_scale(axes, bounds)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", **KEY)
    return figure


def key_handles(with_gain: bool) -> list[Artist]:
    """Return the key to a plan with a robot on it, with candidates where there are any."""
    handles = [*cell_handles(), *path_handles()]
    if with_gain:
        dot: dict[str, Any] = {"marker": "o", "color": "#35b779", "markeredgecolor": "black", "markersize": 8}
        chosen = {**CHOSEN, "markersize": 10, "markeredgewidth": 1.6}
        handles += [
            Line2D([], [], linestyle="", label="candidate", **dot),
            Line2D([], [], color=PATH_COLOUR, linestyle="", label="chosen", **chosen),
        ]
    return handles


def _sheet(bounds: Float[np.ndarray, "2 2"]) -> tuple[Figure, Axes]:
    width, height = bounds[1] - bounds[0]
    figure = Figure(figsize=(8.2, float(np.clip(6.6 * height / width + 0.9, 3.0, 10.0))), layout="constrained")
    axes = figure.subplots()
    bare(axes)
    return figure, axes
