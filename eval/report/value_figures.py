"""Draw the cost-to-go of the car's targets on the learned map: slices of the agents' value iteration.

One panel shows ``min_heading V(x, y, heading)``, the others one heading each. Value iteration runs again for the
picture, on the map, floor plan and margins of the agents (thesis, section 5.6).
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from vssm_gym.agents.shared.car.critic import Critic
from vssm_gym.eval.metrics.metric import Row
from vssm_gym.eval.report.car_figures import CAR, draw_target
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.car.footprint import Arena, arena_from_map
from vssm_gym.planning.value_iteration import CostToGo
from vssm_gym.viz import pictures

SLICE_TURNS = np.radians([0.0, 90.0, 180.0, -90.0])  # headings of the slices, relative to the target's
WALL = "#33373d"
TRAPPED = "#b9bec5"  # free of obstacles, but without a path to the target


class ValuePainter:
    """Draw targets in one scene's map; the floor plan and its collision tests are made once."""

    def __init__(self, voxel_map: VoxelMap) -> None:
        self._arena = arena_from_map(voxel_map, "mean")
        self._critic = Critic(self._arena, CAR)

    def paint(self, row: Row) -> tuple[bytes, str]:
        """Draw the slices for a row's target as WebP; return them and a caption."""
        poses, goal = np.asarray(row["trace"]["poses"], dtype=float), np.asarray(row["goal"], dtype=float)
        result = self._critic.aim(poses[0], goal)
        cost = result.cost_to_go
        if cost is None:
            return b"", result.status.message
        caption = (
            f"{result.sweeps} sweeps to a Bellman residual of {result.residual:.1e}; {result.unreachable} of "
            f"{result.free} free poses have no path to the target"
        )
        return slices(self._arena, cost, poses, goal), caption


def slices(arena: Arena, cost: CostToGo, poses: np.ndarray, goal: np.ndarray) -> bytes:
    """Draw the minimum over headings and four headings as WebP, with one scale of colour.

    Dark: occupied. Grey: no pose of this panel's headings is free and has a path to the target.

    Args:
        arena: the floor plan.
        cost: its cost-to-go.
        poses: ``(n, 3)`` of a run to the target, drawn over the first panel: x, y (m), heading (rad).
        goal: ``(2,)`` or ``(3,)``, likewise.
    """
    values = np.asarray(cost.values)
    values = np.where(values < np.float32(cost.never), values, np.nan)
    nearest = goal[2] if len(goal) == 3 else 0.0
    index = np.round((nearest + SLICE_TURNS) * values.shape[2] / (2.0 * np.pi)).astype(int) % values.shape[2]
    top = float(np.nanquantile(values, 0.98))  # poses that take many turns to leave would use most of the scale
    figure = Figure(figsize=(14.5, 2.7), layout="constrained")
    panels = figure.subplots(1, 1 + len(SLICE_TURNS), sharex=True, sharey=True)
    planes = [np.where(np.isnan(values).all(axis=2), np.nan, np.nanmin(np.nan_to_num(values, nan=np.inf), axis=2))]
    planes += [values[:, :, k] for k in index]
    degrees = [float(np.degrees(wrap_angle(heading))) for heading in 2.0 * np.pi * index / values.shape[2]]
    titles = ["least over headings", *(f"heading {angle:.0f} deg" for angle in degrees)]
    for axes, plane, title in zip(panels, planes, titles, strict=True):
        image = _plane(axes, arena, plane, top)
        axes.set_title(title, fontsize=8)
        axes.plot(*goal[:2], "o", color="white", markeredgecolor="black", markersize=4, zorder=6)
    draw_target(panels[0], goal.tolist())
    panels[0].plot(*poses[:, :2].T, color="white", linewidth=1.2, zorder=4)
    pictures.draw_outlines(panels[0], CAR.corners(poses[:1]), "white", filled=True)
    for axes, k in zip(panels[1:], index, strict=True):  # the heading of this panel
        heading = 2.0 * np.pi * k / values.shape[2]
        pictures.draw_outlines(axes, CAR.corners(np.array([[*goal[:2], heading]])), "white")
    label = f"cost-to-go, motions of {cost.motion_length:.3f} m"
    figure.colorbar(image, ax=panels, shrink=0.9, pad=0.01, extend="max").set_label(label, fontsize=8)
    return pictures.webp(figure, dpi=110)


def _plane(axes: Axes, arena: Arena, plane: np.ndarray, top: float) -> AxesImage:
    """Draw one slice in world coordinates over the floor plan; return the image for the colour bar."""
    (nx, ny), half = plane.shape, 0.5 * arena.resolution
    low = arena.origin - half
    extent = (low[0], low[0] + nx * arena.resolution, low[1], low[1] + ny * arena.resolution)
    background = np.where(arena.occupied[..., None], to_rgb(WALL), to_rgb(TRAPPED))
    axes.imshow(background.transpose(1, 0, 2), origin="lower", extent=extent, interpolation="nearest")
    axes.tick_params(labelsize=6, length=2)
    return axes.imshow(
        plane.T, origin="lower", extent=extent, interpolation="nearest", cmap="viridis_r", vmin=0.0, vmax=top
    )
