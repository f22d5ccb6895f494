"""Draw what pictures of all runs share: the floor plan of a belief, the robot on it, a scale and a key."""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Float, Int8, UInt8
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import Normal, Stroke

from vssm_gym.eval.video.plans import CroppedPlan
from vssm_gym.planning.occupancy_grid import FREE, OCCUPIED, UNKNOWN
from vssm_gym.viz import pictures

DRIVEN_COLOUR, PATH_COLOUR, ROBOT_COLOUR = "#1f5fa8", "#d95f02", "#1f5fa8"
FREE_COLOUR = np.ones(3)  # white
ROBOT_SIZE = 0.28  # m from the robot's centre to its drawn tip, more than its radius for visibility
HALO = (Stroke(linewidth=3.6, foreground="white"), Normal())
KEY: dict[str, Any] = {"ncols": 7, "frameon": False, "fontsize": 9, "handlelength": 1.4, "columnspacing": 1.4}


def cell_image(cells: Int8[np.ndarray, "nx ny"]) -> UInt8[np.ndarray, "ny nx 3"]:
    """Draw cells: free white, occupied dark, unknown grey; row 0 at the lowest y."""
    image = np.empty((*cells.shape, 3), np.uint8)
    for value, tint in {UNKNOWN: pictures.UNKNOWN_COLOUR, FREE: FREE_COLOUR, OCCUPIED: pictures.CUT_COLOUR}.items():
        image[cells == value] = np.rint(255 * tint)
    return image.transpose(1, 0, 2)


def plan_image(plan: CroppedPlan, bounds: Float[np.ndarray, "2 2"]) -> UInt8[np.ndarray, "height width 3"]:
    """Draw the plan within ``bounds`` (m), as :func:`cell_image` does."""
    n = np.ceil((bounds[1] - bounds[0]) / plan.resolution - 1e-6).astype(int)
    cells = np.full(n, UNKNOWN, np.int8)
    first = np.rint((plan.bounds[0] - bounds[0]) / plan.resolution).astype(int)
    inside = cells[first[0] : first[0] + plan.cells.shape[0], first[1] : first[1] + plan.cells.shape[1]]
    inside[...] = plan.cells[: inside.shape[0], : inside.shape[1]]
    return cell_image(cells)


def draw_plan(axes: Axes, plan: CroppedPlan, bounds: Float[np.ndarray, "2 2"]) -> None:
    """Show the plan within ``bounds`` (m) on axes in world coordinates."""
    axes.imshow(plan_image(plan, bounds), origin="lower", extent=extent(bounds), interpolation="nearest")


def extent(bounds: Float[np.ndarray, "2 2"]) -> tuple[float, float, float, float]:
    """Return left, right, bottom, top in matplotlib's order, m."""
    (left, bottom), (right, top) = bounds.tolist()
    return left, right, bottom, top


def cell_handles() -> list[Artist]:
    """Return the key to the cells of a plan."""
    return [
        Patch(facecolor=_hex(FREE_COLOUR), edgecolor="0.6", label="free"),
        Patch(facecolor=_hex(pictures.CUT_COLOUR), label="occupied"),
        Patch(facecolor=_hex(pictures.UNKNOWN_COLOUR), label="unknown"),
    ]


def path_handles(driven: str = DRIVEN_COLOUR) -> list[Artist]:
    """Return the key to the path that was driven and the planned one."""
    return [
        Line2D([], [], color=driven, linewidth=1.6, label="driven"),
        Line2D([], [], color=PATH_COLOUR, linewidth=2.0, label="planned"),
    ]


def robot_outline(planar: Float[np.ndarray, "3"], size: float = ROBOT_SIZE) -> Float[np.ndarray, "4 2"]:
    """Return a dart at the robot's pose with its tip ``size`` m ahead, by default larger than the robot."""
    angle = planar[2] + np.array([0.0, 2.5, math.pi, -2.5])
    radius = size * np.array([1.0, 0.8, 0.35, 0.8])
    return planar[:2] + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def draw_robot(axes: Axes, planar: Float[np.ndarray, "3"], colour: str = ROBOT_COLOUR) -> Any:
    """Draw the robot, pointing ahead; return its patch."""
    (patch,) = axes.fill(*robot_outline(planar).T, facecolor=colour, edgecolor="white", linewidth=1.0, zorder=7)
    return patch


def draw_scale(axes: Axes, bounds: Float[np.ndarray, "2 2"]) -> list[Artist]:
    """Draw a bar of two metres in the lower left corner in place of axes; return its parts."""
    x, y = bounds[0] + 0.02 * (bounds[1] - bounds[0])
    bar = axes.plot([x, x + 2.0], [y, y], color="black", linewidth=2.4, solid_capstyle="butt", zorder=8)
    text = axes.annotate("2 m", (x + 2.0, y), (4, 0), textcoords="offset points", va="center", fontsize=9, zorder=8)
    return [*bar, text]


def xy_of(points: Iterable[Any] | None) -> np.ndarray:
    """Return ``(2, n)`` coordinates for a line of matplotlib; none without points."""
    return np.empty((2, 0)) if points is None else np.asarray(points).T


def _hex(colour: np.ndarray) -> str:
    r, g, b = colour.tolist()
    return to_hex((r, g, b))


def bare(axes: Axes) -> None:
    """Set equal scales and remove numbers and frame."""
    axes.set_aspect("equal")
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
