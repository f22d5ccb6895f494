"""Draw a learned map from above and runs on it, and encode figures for pages."""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from matplotlib.patheffects import Normal, Stroke
from matplotlib.text import Text

from vssm_gym.maps.voxel_map import PRIOR_OCCUPANCY_STD, VoxelMap
from vssm_gym.viz.text import shortened, visible

CUT_HEIGHT = 1.2  # m: above tables, below door lintels and wall cupboards
CUT_COLOUR = np.array([0.25, 0.27, 0.30])  # of objects at the cut: walls, tall furniture
UNKNOWN_COLOUR = np.array([0.82, 0.83, 0.85])  # of space that was not observed
TRUE_COLOUR, ESTIMATE_COLOUR, GOAL_COLOUR = "#0b6e4f", "#c2185b", "#e09f1f"
DASHES = (0, (3, 1.5))  # offset, then lengths of dash and gap in line widths
REGION_95 = 2.448  # root of the 95 % point of chi^2 with 2 degrees of freedom
LONGEST_IN_FIGURE = 60  # characters of a line of text


@dataclass(frozen=True)
class Background:
    """Hold a map seen from above, as a background for runs."""

    image: Float[np.ndarray, "height width 3"]  # RGB [0, 1], row 0 at the lowest y
    extent: tuple[float, float, float, float]  # world x low, x high, y low, y high of the image's edges, m


@jax.jit
def _slice(map: VoxelMap, xy: jax.Array, z: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the field, and whether a cell was observed, at height ``z`` over every ``xy``."""
    p_world = jnp.concatenate([xy, jnp.broadcast_to(z, (*xy.shape[:-1], 1))], axis=-1)
    return map.field(p_world), map.precision(p_world)[..., 0] > 1.5 * PRIOR_OCCUPANCY_STD**-2


def topdown(map: VoxelMap, cut_height: float = CUT_HEIGHT, resolution: float = 0.04) -> Background:
    """Draw the colours of the map's surfaces from above, without everything over ``cut_height`` (m).

    Surfaces at the cut itself are dark, as in an architect's plan; unobserved places are grey. The picture shows the
    belief that agents plan on, not the scene.
    """
    low, high = map.bounds
    n = np.maximum(np.ceil((high - low)[:2] / resolution).astype(int), 1)
    x, y = (low[a] + (np.arange(n[a]) + 0.5) * resolution for a in (0, 1))
    xy = jnp.asarray(np.stack(np.meshgrid(x, y), axis=-1), jnp.float32)
    image = np.broadcast_to(UNKNOWN_COLOUR, (*xy.shape[:-1], 3)).copy()
    open_ray = np.ones(xy.shape[:-1], bool)
    heights = np.arange(cut_height, max(low[2], -0.1), -0.5 * float(map.voxel_size))
    for z in heights:
        field, observed = (np.asarray(a) for a in _slice(map, xy, jnp.float32(z)))
        hit = open_ray & observed & (field[..., 0] > 0.0)
        image[hit] = CUT_COLOUR if z == heights[0] else 0.35 + 0.65 * np.clip(field[hit][:, 1:], 0.0, 1.0)
        open_ray &= ~hit
    extent = (float(low[0]), float(low[0] + n[0] * resolution), float(low[1]), float(low[1] + n[1] * resolution))
    return Background(image, extent)


def draw_background(axes: Axes, background: Background | None) -> None:
    """Show the map in world coordinates; without one an empty plane of equal scales."""
    axes.set_aspect("equal")
    axes.tick_params(labelsize=6, length=2)
    if background is not None:
        axes.imshow(pale(background.image), origin="lower", extent=background.extent, interpolation="nearest")


def pale(colour: np.ndarray) -> np.ndarray:
    """Return colours (RGB, [0, 1]) of a background, so light that paths stand out."""
    return np.asarray(1.0 - 0.6 * (1.0 - colour))


def draw_run(axes: Axes, row: Mapping[str, Any], success_radius: float) -> None:
    """Draw one episode: true path, estimated path, start, goal with its success circle, and collisions.

    A goal that is None is left out.
    """
    true = np.asarray(row["trace"]["true"], dtype=float).reshape(-1, 2)
    estimate = np.asarray(row["trace"]["estimate"] or [], dtype=float).reshape(-1, 2)
    goal = row["goal"]
    halo = [Stroke(linewidth=3.2, foreground="white", alpha=0.8), Normal()]
    axes.plot(*true.T, color=TRUE_COLOUR, linewidth=1.6, path_effects=halo, zorder=3)
    if len(estimate):
        axes.plot(*estimate.T, color=ESTIMATE_COLOUR, linewidth=1.2, linestyle=DASHES, path_effects=halo, zorder=4)
    contacts = np.asarray(row["trace"]["contacts"] or [], dtype=float).reshape(-1, 2)
    if len(contacts):
        axes.plot(*contacts.T, "x", color="black", markersize=4, markeredgewidth=1.0, zorder=5)
    axes.plot(*true[0], "o", color=TRUE_COLOUR, markersize=5, zorder=6)
    axes.plot(*true[-1], "s", color=TRUE_COLOUR, markersize=4, zorder=6)
    if goal is not None:
        circle = Circle(goal, success_radius, facecolor=GOAL_COLOUR, edgecolor="black", alpha=0.55, lw=0.6, zorder=2)
        axes.add_patch(circle)


def draw_outlines(axes: Axes, outlines: Float[np.ndarray, "n 4 2"], colour: str, filled: bool = False) -> None:
    """Draw footprints of a body in world coordinates, corners counter-clockwise from the rear right.

    The front is bold.
    """
    face = (colour, 0.35) if filled else (colour, 0.10)
    axes.add_collection(PolyCollection(list(outlines), facecolors=face, edgecolors=colour, linewidths=0.6, zorder=3.5))
    axes.add_collection(LineCollection(list(outlines[:, 1:3]), colors=colour, linewidths=1.6, zorder=3.6))


def webp(figure: Figure, dpi: int = 90) -> bytes:
    """Encode the figure as WebP: a textured map takes a fifth of its size as PNG."""
    return _encoded(figure, "webp", dpi=dpi, pil_kwargs={"quality": 80})


def png(figure: Figure, dpi: int) -> bytes:
    """Encode the figure as PNG."""
    return _encoded(figure, "png", dpi=dpi)


def svg(figure: Figure) -> bytes:
    """Encode the figure as SVG, reproducibly: no date, and ids from a fixed salt."""
    with matplotlib.rc_context({"svg.hashsalt": "vssm_gym"}):
        return _encoded(figure, "svg", metadata={"Date": None})


def _encoded(figure: Figure, kind: str, **options: Any) -> bytes:
    take_literally(figure)
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, **options)
    return buffer.getvalue()


def take_literally(figure: Figure) -> None:
    """Show the texts of a figure as they are: ``$`` begins no formula, and what has no glyph is escaped.

    Titles and legends name agents, scenes and sequences. The numbers at an axis' ticks, which matplotlib may write as
    formulas, are left alone; names at ticks pass through :func:`tick_name`.
    """
    axes = [axis for one in figure.findobj(Axes) for axis in (one.xaxis, one.yaxis)]
    at_ticks = {text for axis in axes for text in axis.findobj(Text)} - {axis.label for axis in axes}
    for text in figure.findobj(Text):
        if text not in at_ticks:
            text.set_parse_math(False)
            text.set_text(
                "\n".join(shortened(visible(line), LONGEST_IN_FIGURE) for line in text.get_text().split("\n"))
            )


def tick_name(name: str) -> str:
    """Return a name that matplotlib shows as it is at a tick."""
    return shortened(visible(name), LONGEST_IN_FIGURE).replace("$", r"\$")


def legend_handles() -> list:
    """Return the legend of :func:`draw_run`."""
    return [
        Line2D([], [], color=TRUE_COLOUR, linewidth=1.6, label="true path"),
        Line2D([], [], color=ESTIMATE_COLOUR, linewidth=1.2, linestyle=DASHES, label="estimate"),
        Line2D([], [], color=TRUE_COLOUR, marker="o", linestyle="", markersize=5, label="start"),
        Line2D([], [], color=TRUE_COLOUR, marker="s", linestyle="", markersize=4, label="end"),
        Line2D([], [], color=GOAL_COLOUR, marker="o", linestyle="", markersize=9, alpha=0.6, label="goal region"),
        Line2D([], [], color="black", marker="x", linestyle="", markersize=4, label="contact"),
    ]


def footprint_handles() -> list:
    """Return the legend of :func:`draw_outlines`."""
    return [
        Patch(facecolor=(TRUE_COLOUR, 0.1), edgecolor=TRUE_COLOUR, lw=0.6, label="footprint"),
        Patch(facecolor=(GOAL_COLOUR, 0.35), edgecolor=GOAL_COLOUR, lw=0.6, label="target pose"),
    ]
