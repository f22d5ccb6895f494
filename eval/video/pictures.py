"""Draw pictures of one exploration: a choice among candidates coloured by gain, and the whole run on its map.

The gain is that of :class:`vssm_gym.agents.exploration.mi_explorer.Tour`: the expected information, in nats, of images
around a viewpoint in addition to the viewpoints before it, minus the price of a viewpoint.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colorbar import Colorbar
from matplotlib.colors import LogNorm, to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import Normal, Stroke
from matplotlib.ticker import FuncFormatter, LogLocator

from vssm_gym.eval.report.explore_figures import plan_of
from vssm_gym.eval.video.recording import CroppedPlan, Moment, Recording
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.occupancy_grid import FREE, OCCUPIED
from vssm_gym.viz import pictures

GAIN_COLOURS = TIME_COLOURS = "viridis"
DRIVEN_COLOUR, PATH_COLOUR, ROBOT_COLOUR = "#1f5fa8", "#d95f02", "#1f5fa8"
FREE_COLOUR = np.ones(3)  # white
ROBOT_SIZE = 0.28  # m from the robot's centre to its drawn tip, more than its radius for visibility
HALO = (Stroke(linewidth=3.6, foreground="white"), Normal())
LEAST_GAIN = 1.0  # 10^3 nats, where the colours of gain begin
CANDIDATE: dict[str, Any] = {"s": 95.0, "edgecolors": "black", "linewidths": 0.8}
CHOSEN: dict[str, Any] = {"marker": "o", "fillstyle": "none", "markersize": 17, "markeredgewidth": 2.2}


def plan_image(plan: CroppedPlan, bounds: Float[np.ndarray, "2 2"]) -> UInt8[np.ndarray, "height width 3"]:
    """Draw the plan within ``bounds`` (m): free white, occupied dark, unknown grey; row 0 at the lowest y."""
    n = np.ceil((bounds[1] - bounds[0]) / plan.resolution - 1e-6).astype(int)
    tints = {FREE: FREE_COLOUR, OCCUPIED: pictures.CUT_COLOUR}
    image = np.full((*n, 3), np.rint(255 * pictures.UNKNOWN_COLOUR), np.uint8)
    first = np.rint((plan.bounds[0] - bounds[0]) / plan.resolution).astype(int)
    inside = image[first[0] : first[0] + plan.cells.shape[0], first[1] : first[1] + plan.cells.shape[1]]
    for value, tint in tints.items():
        inside[plan.cells == value] = np.rint(255 * tint)
    return image.transpose(1, 0, 2)


def extent(bounds: Float[np.ndarray, "2 2"]) -> tuple[float, float, float, float]:
    """Return left, right, bottom, top in matplotlib's order, m."""
    (left, bottom), (right, top) = bounds.tolist()
    return left, right, bottom, top


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
    axes.imshow(plan_image(moment.plan, bounds), origin="lower", extent=extent(bounds), interpolation="nearest")
    axes.plot(*recording.driven(moment).T, color=DRIVEN_COLOUR, linewidth=1.6, path_effects=HALO, zorder=3)
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
    figure.legend(handles=plan_handles(with_gain=True), loc="outside lower center", **KEY)
    return figure


def run(recording: Recording, m: VoxelMap, row: dict[str, Any]) -> Figure:
    """Draw the whole path on the run's final map, dark at the start and bright at the end."""
    background = plan_of(m)
    left, right, bottom, top = background.extent
    bounds = np.array([[left, bottom], [right, top]])
    figure, axes = _sheet(bounds)
    pictures.draw_background(axes, background)
    bare(axes)
    path, seconds = np.array(recording.path)[:, :2], np.array(recording.seconds)
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


KEY: dict[str, Any] = {"ncols": 7, "frameon": False, "fontsize": 9, "handlelength": 1.4, "columnspacing": 1.4}


def plan_handles(with_gain: bool) -> list:
    """Return the key to a plan with a robot on it."""
    chosen = {**CHOSEN, "markersize": 10, "markeredgewidth": 1.6}
    handles: list = [
        Patch(facecolor=_hex(FREE_COLOUR), edgecolor="0.6", label="free"),
        Patch(facecolor=_hex(pictures.CUT_COLOUR), label="occupied"),
        Patch(facecolor=_hex(pictures.UNKNOWN_COLOUR), label="unknown"),
        Line2D([], [], color=DRIVEN_COLOUR, linewidth=1.6, label="driven"),
        Line2D([], [], color=PATH_COLOUR, linewidth=2.0, label="planned"),
    ]
    if with_gain:
        dot: dict[str, Any] = {"marker": "o", "color": "#35b779", "markeredgecolor": "black", "markersize": 8}
        handles += [
            Line2D([], [], linestyle="", label="candidate", **dot),
            Line2D([], [], color=PATH_COLOUR, linestyle="", label="chosen", **chosen),
        ]
    return handles


def robot_outline(planar: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 2"]:
    """Return a dart at the robot's pose, larger than the robot for visibility."""
    angle = planar[2] + np.array([0.0, 2.5, math.pi, -2.5])
    radius = ROBOT_SIZE * np.array([1.0, 0.8, 0.35, 0.8])
    return planar[:2] + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def draw_robot(axes: Axes, planar: Float[np.ndarray, "3"]) -> Any:
    """Draw the robot, pointing ahead; return its patch."""
    (patch,) = axes.fill(*robot_outline(planar).T, facecolor=ROBOT_COLOUR, edgecolor="white", linewidth=1.0, zorder=7)
    return patch


def draw_scale(axes: Axes, bounds: Float[np.ndarray, "2 2"]) -> list:
    """Draw a bar of two metres in the lower left corner in place of axes; return its parts."""
    x, y = bounds[0] + 0.02 * (bounds[1] - bounds[0])
    bar = axes.plot([x, x + 2.0], [y, y], color="black", linewidth=2.4, solid_capstyle="butt", zorder=8)
    text = axes.annotate("2 m", (x + 2.0, y), (4, 0), textcoords="offset points", va="center", fontsize=9, zorder=8)
    return [*bar, text]


def _hex(colour: np.ndarray) -> str:
    r, g, b = colour.tolist()
    return to_hex((r, g, b))


def _sheet(bounds: Float[np.ndarray, "2 2"]) -> tuple[Figure, Axes]:
    width, height = bounds[1] - bounds[0]
    figure = Figure(figsize=(8.2, float(np.clip(6.6 * height / width + 0.9, 3.0, 10.0))), layout="constrained")
    axes = figure.subplots()
    bare(axes)
    return figure, axes


def bare(axes: Axes) -> None:
    """Set equal scales and remove numbers and frame."""
    axes.set_aspect("equal")
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
