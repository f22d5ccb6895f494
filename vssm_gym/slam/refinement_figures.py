"""Draw a run before and after it was smoothed: cost, corrections, errors, path, a slice of the map, images."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure, SubFigure

from vssm_gym.geometry.transforms import inverse, se3_log, transform
from vssm_gym.model import emission
from vssm_gym.slam.figures import SLICE_MARGIN, SLICE_PIXELS, Display, belief_at, observed_cells
from vssm_gym.slam.refinement import Refinement
from vssm_gym.slam.run import SlamRun, TrackedFrame
from vssm_gym.slam.states import NORMAL_95, POSE, Truth, tidy
from vssm_gym.viz import pictures

COMPARED_FRAMES = 3  # whose images are compared with both maps
BEFORE_COLOUR = "#d55e00"
LARGEST_DIFFERENCE = 0.1  # m, of the scale of depth differences


def before_and_after(refined: Refinement, display: Display, truth: Truth | None) -> bytes:
    """Draw both runs, as WebP.

    Args:
        refined: both runs.
        display: frame of the smoothed run, in which both are drawn.
        truth: of the smoothed run, where it is known.
    """
    figure = Figure(figsize=(11.5, 11.0), layout="constrained")
    rows: Any = figure.subfigures(3, 1, height_ratios=(3.0, 3.8, 4.2))
    top, middle, bottom = rows
    axes = top.subplots(1, 3)
    _cost(axes[0], refined.costs)
    _corrections(axes[1], refined)
    _errors(axes[2], refined, truth)
    maps, path = np.ravel(middle.subfigures(1, 2, width_ratios=(2.2, 1.0)))
    _slices(maps, refined, display)
    _path(path.subplots(), refined, display)
    _images(bottom, refined)
    return pictures.webp(figure)


def depth_differences(refined: Refinement) -> list[tuple[int, float, float]]:
    """Return the index of each compared frame, and its median depth difference (m) to the map before and after."""

    def median(run: SlamRun, frame: int) -> float:
        off = np.abs(_difference(run, frame))
        return float(np.nanmedian(off)) if np.isfinite(off).any() else np.nan

    return [
        (refined.run.frames[i].index, median(refined.filtered, i), median(refined.run, i)) for i in compared(refined)
    ]


def compared(refined: Refinement) -> list[int]:
    """Return the numbers of the frames whose images are compared, spread over those that were smoothed."""
    nodes = refined.nodes
    return [int(nodes[i]) for i in np.linspace(0, len(nodes) - 1, COMPARED_FRAMES).round().astype(int)]


def _cost(axes: Axes, costs: list[float]) -> None:
    axes.plot(np.arange(1, len(costs) + 1), costs, "o-", color=pictures.ESTIMATE_COLOUR, markersize=4)
    axes.set(title="cost", xlabel="iteration", ylabel="mean residual, stds")
    tidy(axes)


def _corrections(axes: Axes, refined: Refinement) -> None:
    """Draw how far each pose was moved, and the half-width of the 95 % interval that was stated before."""
    before, after = refined.filtered, refined.run
    moved = np.asarray(se3_log(jnp.asarray(inverse(before.poses) @ after.poses, jnp.float32)), float)
    t = before.times - before.times[0]
    axes.plot(t, 100.0 * np.linalg.norm(moved[:, :3], axis=1), color=pictures.ESTIMATE_COLOUR, label="position, cm")
    axes.plot(t, np.degrees(np.linalg.norm(moved[:, 3:], axis=1)), color=BEFORE_COLOUR, label="rotation, deg")
    stated = [np.nan if f.covariance is None else _largest_std(f) for f in before.frames]
    axes.plot(t, 100.0 * NORMAL_95 * np.array(stated), color="0.6", linewidth=1.0, label="95 % stated before, cm")
    axes.set(title="corrections", xlabel="time, s")
    axes.set_ylim(bottom=0.0)
    axes.legend(fontsize=8, frameon=False)
    tidy(axes)


def _largest_std(frame: TrackedFrame) -> float:
    assert frame.covariance is not None
    return float(np.sqrt(np.linalg.eigvalsh(frame.covariance[POSE, POSE][:3, :3])[-1]))


def _errors(axes: Axes, refined: Refinement, truth: Truth | None) -> None:
    """Draw the distance of both runs to the truth at tracked frames, each aligned by the first of them."""
    if truth is None or refined.filtered.lost[truth.rows].all():
        axes.axis("off")
        axes.text(0.5, 0.5, "no ground truth at tracked frames", ha="center", color="0.4")
        return
    rows = truth.rows[~refined.filtered.lost[truth.rows]]
    true = truth.T_world_cam[~refined.filtered.lost[truth.rows]]
    t = refined.run.times[rows] - refined.run.times[0]
    for run, colour, name in (
        (refined.filtered, BEFORE_COLOUR, "before"),
        (refined.run, pictures.ESTIMATE_COLOUR, "smoothed"),
    ):
        poses = run.poses[rows]
        own = poses[0] @ inverse(true[0]) @ true
        axes.plot(t, 100.0 * np.linalg.norm((poses - own)[:, :3, 3], axis=1), color=colour, label=name)
    axes.set(title="distance to the truth, first pose aligned", xlabel="time, s", ylabel="position error, cm")
    axes.set_ylim(bottom=0.0)
    axes.legend(fontsize=8, frameon=False)
    tidy(axes)


def _path(axes: Axes, refined: Refinement, display: Display) -> None:
    if display.truth is not None:
        axes.plot(*display.truth[:, :2].T, color=pictures.TRUE_COLOUR, linewidth=1.8, label="ground truth")
    for run, colour, name in (
        (refined.filtered, BEFORE_COLOUR, "before"),
        (refined.run, pictures.ESTIMATE_COLOUR, "smoothed"),
    ):
        p = transform(display.T_display_world, run.poses[:, :3, 3])
        axes.plot(p[:, 0], p[:, 1], color=colour, linewidth=1.0, label=name)
    axes.set(title="path from above", xlabel="x, m", ylabel="y, m", aspect="equal", adjustable="datalim")
    axes.legend(fontsize=8, frameon=False)
    tidy(axes)


def _images(figure: SubFigure, refined: Refinement) -> None:
    """Draw the depth differences of some images to both maps, one above the other."""
    norm = Normalize(-LARGEST_DIFFERENCE, LARGEST_DIFFERENCE)
    grid = figure.subplots(2, COMPARED_FRAMES)
    for row, run, name in zip(grid, (refined.filtered, refined.run), ("before", "smoothed"), strict=True):
        for axes, frame in zip(row, compared(refined), strict=True):
            image = axes.imshow(_difference(run, frame), cmap="RdBu_r", norm=norm)
            axes.set_facecolor(pictures.UNKNOWN_COLOUR)
            axes.set(xticks=[], yticks=[], title=f"frame {run.frames[frame].index}, {name}")
    figure.colorbar(image, ax=grid.ravel().tolist(), label="depth difference, m", shrink=0.8)


def _slices(figure: SubFigure, refined: Refinement, display: Display) -> None:
    """Draw the mean of both maps on the horizontal plane that cuts most free space of the smoothed one."""
    m = refined.run.map
    voxel = float(m.voxel_size)
    free = transform(display.T_display_world, observed_cells(m, below=-voxel))
    seen = transform(display.T_display_world, observed_cells(m))
    cameras = transform(display.T_display_world, refined.run.poses[:, :3, 3])
    most = next(places for places in (free, seen, cameras) if len(places))
    layers, counts = np.unique(np.round(most[:, 2] / voxel), return_counts=True)
    height = voxel * float(layers[np.argmax(counts)])
    shown = np.concatenate([seen[np.abs(seen[:, 2] - height) <= voxel], cameras])[:, :2]
    low, high = shown.min(axis=0) - SLICE_MARGIN, shown.max(axis=0) + SLICE_MARGIN
    resolution = max(float((high - low).max()) / SLICE_PIXELS, 0.25 * voxel)
    x, y = (np.arange(low[c], high[c], resolution) for c in (0, 1))
    p = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), height)], axis=-1)
    p_world = transform(inverse(display.T_display_world), p)
    both = figure.subplots(1, 2, sharey=True)
    for axes, run, name in zip(both, (refined.filtered, refined.run), ("before", "smoothed"), strict=True):
        mean, _ = belief_at(run.map, p_world)
        axes.set_facecolor(pictures.UNKNOWN_COLOUR)
        image = axes.imshow(
            mean,
            origin="lower",
            extent=(x[0], x[-1], y[0], y[-1]),
            interpolation="nearest",
            cmap="RdBu_r",
            norm=Normalize(-2.0 * voxel, 2.0 * voxel),
        )
        axes.set(title=f"occupancy, {name}, z = {height:.2f} m", xlabel="x, m")
    both[0].set_ylabel("y, m")
    figure.colorbar(image, ax=both.tolist(), label="mean occupancy, m", shrink=0.8)


def _difference(run: SlamRun, frame: int) -> np.ndarray:
    """Return the depth that was read minus that of the map at the frame's pose, m; NaN where either is missing."""
    _, depth = run.reader[run.frames[frame].index]
    T = jnp.asarray(run.frames[frame].T_world_cam, jnp.float32)
    rendered = emission.render(run.map, T, run.reader.camera)
    return np.where((depth > 0.0) & np.asarray(rendered.known), depth - np.asarray(rendered.depth), np.nan)
