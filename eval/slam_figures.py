"""The figures of a SLAM report: trajectory, slices through the map, rendered against observed images, fit, latency."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from vssm_gym import emission
from vssm_gym.data.sequences import Sequence
from vssm_gym.errors import InputError
from vssm_gym.eval import trajectory
from vssm_gym.eval.slam_run import SlamRun, TrackedFrame
from vssm_gym.geometry import R_BODY_CAM, inverse, transform
from vssm_gym.inference.slam import SlamConfig
from vssm_gym.viz import pictures
from vssm_gym.voxel_map import OBSERVED_PRECISION, VoxelMap

OBSERVED_COLOUR = "#0072b2"
MARGIN = 0.4  # m around what a slice shows
PIXELS = 420  # of a slice along its longer edge, at most


@dataclass(frozen=True)
class Display:
    """A frame with z up, in which a run is drawn; the map's own frame is a camera that may look anywhere."""

    T_display_world: Float[np.ndarray, "4 4"]
    note: str  # how up is known
    truth: Float[np.ndarray, "n 3"] | None  # true positions, m
    errors: Float[np.ndarray, "k 2"] | None  # time (s) and position error (m) of the associated frames

    @classmethod
    def of(cls, run: SlamRun, sequence: Sequence) -> "Display":
        """The truth's frame where the run can be aligned to it, else the frame of the body that carries the camera."""
        if sequence.truth is not None:
            times, T_true = sequence.truth
            i, j = trajectory.associate(run.times, times)
            try:
                alignment = trajectory.align(run.poses[i, :3, 3], T_true[j, :3, 3])
            except InputError:
                pass  # too few or too straight: the page says so beside the errors
            else:
                T = np.eye(4)
                T[:3, :3], T[:3, 3] = alignment.rotation, alignment.translation
                off = np.linalg.norm(transform(T, run.poses[i, :3, 3]) - T_true[j, :3, 3], axis=-1)
                inside = (times >= run.times[0]) & (times <= run.times[-1])
                errors = np.stack([run.times[i], off], axis=-1)
                return cls(T, "the ground truth's frame, after SE(3) alignment", T_true[inside, :3, 3], errors)
        if sequence.T_body_cam is not None:
            return cls(sequence.T_body_cam, "the first frame's body frame", None, None)
        T = np.eye(4)
        T[:3, :3] = R_BODY_CAM
        return cls(T, "up is the first camera's up: true only if it was held level", None, None)


def _tidy(axes: Axes) -> None:
    axes.grid(alpha=0.3, linewidth=0.5)
    axes.spines[["top", "right"]].set_visible(False)


def path(run: SlamRun, display: Display) -> bytes:
    """Top view, side view and, where the truth is known, the position error over time, as SVG."""
    panels = 2 if display.errors is None else 3
    figure = Figure(figsize=(11.5, 3.6), layout="constrained")
    all_axes = np.atleast_1d(figure.subplots(1, panels))
    p = transform(display.T_display_world, run.poses[:, :3, 3])
    for axes, (a, b), title in zip(all_axes, ((0, 1), (0, 2)), ("from above", "from the side"), strict=False):
        if display.truth is not None:
            axes.plot(display.truth[:, a], display.truth[:, b], color=pictures.TRUE_COLOUR, linewidth=1.6)
        axes.plot(p[:, a], p[:, b], color=pictures.ESTIMATE_COLOUR, linewidth=1.2, linestyle=pictures.DASHES)
        axes.plot(*p[0, [a, b]], "o", color=pictures.ESTIMATE_COLOUR, markersize=5)
        axes.plot(p[run.lost, a], p[run.lost, b], "x", color="black", markersize=5)
        axes.set(title=title, xlabel="x, m", ylabel=f"{'xyz'[b]}, m", aspect="equal", adjustable="datalim")
        _tidy(axes)
    if display.errors is not None:
        axes = all_axes[2]
        axes.plot(display.errors[:, 0] - run.times[0], 100.0 * display.errors[:, 1], color=pictures.ESTIMATE_COLOUR)
        axes.set(title="distance to the truth", xlabel="time, s", ylabel="position error, cm")
        axes.set_ylim(bottom=0.0)
        _tidy(axes)
    handles = [
        Line2D([], [], color=pictures.ESTIMATE_COLOUR, linestyle=pictures.DASHES, label="estimate"),
        Line2D([], [], color=pictures.ESTIMATE_COLOUR, marker="o", linestyle="", markersize=5, label="first frame"),
    ]
    if display.truth is not None:
        handles.insert(0, Line2D([], [], color=pictures.TRUE_COLOUR, linewidth=1.6, label="ground truth"))
    if run.lost.any():
        handles.append(Line2D([], [], color="black", marker="x", linestyle="", markersize=5, label="lost frame"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return pictures.svg(figure)


def slices(run: SlamRun, display: Display) -> bytes:
    """Mean and std of occupancy on the horizontal and the vertical plane that cut most free space, as WebP."""
    cameras = transform(display.T_display_world, run.poses[:, :3, 3])
    voxel = float(run.map.voxel_size)
    free = transform(display.T_display_world, _cells(run.map, np.asarray(run.map.occupancy) < -voxel))
    seen = transform(display.T_display_world, _cells(run.map, True))
    figure = Figure(figsize=(11.5, 8.4), layout="constrained")
    for row, (a, b) in zip(figure.subplots(2, 2), ((0, 1), (0, 2)), strict=True):
        fixed = 3 - a - b
        layers, counts = np.unique(np.round((free if len(free) else seen)[:, fixed] / voxel), return_counts=True)
        height = voxel * float(layers[np.argmax(counts)])
        shown = np.concatenate([seen[np.abs(seen[:, fixed] - height) <= voxel], cameras])
        low, high = shown.min(axis=0) - MARGIN, shown.max(axis=0) + MARGIN
        resolution = max((high - low)[[a, b]].max() / PIXELS, 0.25 * voxel)
        u, v = (np.arange(low[c], high[c], resolution) for c in (a, b))
        p = np.empty((len(v), len(u), 3))
        p[..., a], p[..., b], p[..., fixed] = u, v[:, None], height
        mean, std = _belief(run.map, transform(inverse(display.T_display_world), p))
        extent = (u[0], u[-1], v[0], v[-1])
        surest = min(0.5, float(np.nanmin(std, initial=0.5)))
        panels = (
            (mean, "RdBu_r", Normalize(-2.0 * voxel, 2.0 * voxel), "mean occupancy, m"),
            (std, "viridis", LogNorm(surest, 1.0), "std of occupancy, m"),
        )
        for axes, (values, colours, norm, label) in zip(row, panels, strict=True):
            axes.set_facecolor(pictures.UNKNOWN_COLOUR)
            image = axes.imshow(values, origin="lower", extent=extent, interpolation="nearest", cmap=colours, norm=norm)
            bar = figure.colorbar(image, ax=axes, label=label, shrink=0.85)
            if values is std:
                bar.set_ticks([tick for tick in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0) if tick >= surest])
                bar.ax.yaxis.set_major_formatter("{x:g}")
                bar.ax.minorticks_off()
            axes.plot(cameras[:, a], cameras[:, b], color="black", linewidth=0.7)
            axes.set(xlabel="x, m", ylabel=f"{'xyz'[b]}, m", title=f"{'xyz'[fixed]} = {height:.2f} m")
    return pictures.webp(figure)


def _cells(m: VoxelMap, chosen: np.ndarray | bool) -> np.ndarray:
    """Centres ``(n, 3)`` of the ``chosen`` (blocks, cells) among those whose occupancy was observed, m, map frame."""
    observed = chosen & (np.asarray(m.occupancy_precision) > OBSERVED_PRECISION)
    return np.asarray(m.origin, float) + np.argwhere(np.asarray(m.dense(jnp.asarray(observed)))) * float(m.voxel_size)


def _belief(m: VoxelMap, p_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and std of occupancy (m) at points, NaN where one of the eight cells around was not observed.

    Across that border the mean passes through a zero that is no surface.
    """
    observed = np.asarray(m.dense(m.occupancy_precision)) > OBSERVED_PRECISION
    low = np.floor((p_world - m.bounds[0]) / float(m.voxel_size)).astype(int)
    inside = ((low >= 0) & (low < np.array(m.shape) - 1)).all(axis=-1)
    low = np.where(inside[..., None], low, 0)
    for corner in np.ndindex(2, 2, 2):
        i, j, k = np.moveaxis(low + corner, -1, 0)
        inside &= observed[i, j, k]
    p = jnp.asarray(p_world, jnp.float32)
    mean, precision = np.asarray(m.field(p))[..., 0], np.asarray(m.precision(p))[..., 0]
    return np.where(inside, mean, np.nan), np.where(inside, precision**-0.5, np.nan)


def views(run: SlamRun, count: int = 5) -> tuple[bytes, list[tuple[int, float, float]]]:
    """Frames spread over the run beside the final map rendered at their estimated poses, as WebP.

    Returns:
        The picture, and per frame its index in the sequence, the median depth difference (m) where both images have a
        depth, and the share of the observed depths that the map has a known surface for.
    """
    held = [frame for frame in run.frames if not frame.lost]
    chosen = [held[i] for i in sorted({round(x) for x in np.linspace(0, len(held) - 1, count)})]
    columns = ("observed", "rendered", "observed depth", "rendered depth", "depth difference")
    camera = run.reader.camera
    height = 1.9 * camera.height / camera.width + 0.1
    figure = Figure(figsize=(11.5, height * len(chosen) + 0.6), layout="constrained")
    grid = figure.subplots(len(chosen), len(columns), squeeze=False)
    numbers = []
    for row, frame in zip(grid, chosen, strict=True):
        rgb, depth = run.reader[frame.index]
        rendered = emission.render(run.map, jnp.asarray(frame.T_world_cam, jnp.float32), camera)
        known, colour, surface = (np.asarray(a) for a in (rendered.known, rendered.rgb, rendered.depth))
        read, modelled = np.where(depth > 0.0, depth, np.nan), np.where(known, surface, np.nan)
        far = float(np.nanpercentile(read, 98)) if (depth > 0.0).any() else 1.0
        painted = np.where(known[..., None], np.clip(colour, 0.0, 1.0), pictures.UNKNOWN_COLOUR)
        difference = read - modelled
        row[0].imshow(rgb)
        row[1].imshow(painted)
        row[2].imshow(read, cmap="turbo", vmin=0.0, vmax=far)
        depths = row[3].imshow(modelled, cmap="turbo", vmin=0.0, vmax=far)
        off = row[4].imshow(difference, cmap="RdBu_r", vmin=-0.1, vmax=0.1)
        figure.colorbar(depths, ax=row[2:4].tolist(), label="m", shrink=0.8, aspect=30)
        figure.colorbar(off, ax=row[4], label="m", shrink=0.8)
        row[0].set_ylabel(f"frame {frame.index}", fontsize=8)
        both = np.isfinite(difference)
        share = both.sum() / max(int((depth > 0.0).sum()), 1)
        numbers.append(
            (frame.index, float(np.median(np.abs(difference[both]))) if both.any() else np.nan, float(share))
        )
    for axes in grid.ravel():
        axes.set(xticks=[], yticks=[])
        axes.set_facecolor(pictures.UNKNOWN_COLOUR)
    for axes, title in zip(grid[0], columns, strict=True):
        axes.set_title(title, fontsize=9)
    return pictures.webp(figure), numbers


def fit(run: SlamRun, config: SlamConfig) -> bytes:
    """What the loss test sees, over time, with its limits: score and photometric residual, as SVG."""
    figure = Figure(figsize=(11.5, 2.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    aligned = [frame for frame in run.frames if frame.inlier_share is not None]
    t = np.array([frame.time for frame in aligned]) - run.times[0]
    lost = np.array([frame.lost for frame in aligned], bool)
    score = np.array([_score(frame) for frame in aligned])
    photometric = np.array([frame.photometric for frame in aligned])
    for axes, values, limit in ((left, score, config.min_score), (right, photometric, config.max_photometric)):
        axes.plot(t, values, color=OBSERVED_COLOUR, linewidth=1.0)
        axes.plot(t[lost], values[lost], "x", color="black", markersize=5)
        axes.axhline(limit, color="#a3203a", linewidth=1.0, linestyle="--")
        axes.set_xlabel("time, s")
        _tidy(axes)
    left.set(ylabel="score", title="geometry: lost below the limit", ylim=(0.0, 1.02))
    right.set(ylabel="mean |r| / sigma", title="photometry: lost above the limit")
    right.set_ylim(bottom=0.0)
    return pictures.svg(figure)


def _score(frame: TrackedFrame) -> float:
    """Inlier share times ``min(1, coverage / 0.4)``, as the loss test of :mod:`vssm_gym.inference.slam`."""
    return (frame.inlier_share or 0.0) * min(1.0, (frame.coverage or 0.0) / 0.4)


def latency(run: SlamRun) -> bytes:
    """Milliseconds of each stage, frame by frame and as the share of frames below, as SVG."""
    figure = Figure(figsize=(11.5, 2.8), layout="constrained")
    series, below = figure.subplots(1, 2)
    stages = (
        ("track and update", [frame for frame in run.frames if frame.warm], "step_s", pictures.ESTIMATE_COLOUR),
        ("read (beside the filter)", run.frames, "read_s", OBSERVED_COLOUR),
        ("wait for image", run.frames[1:], "wait_s", "#e69f00"),
    )
    for label, frames, name, colour in stages:
        ms = 1e3 * np.array([getattr(frame, name) for frame in frames])
        if len(ms):
            series.plot([frame.time - run.times[0] for frame in frames], ms, color=colour, linewidth=0.8, label=label)
            below.step(np.sort(ms), np.arange(1, len(ms) + 1) / len(ms), where="post", color=colour)
    series.set(xlabel="time in the recording, s", ylabel="ms", yscale="log")
    below.set(xlabel="ms", ylabel="share of frames", xscale="log", ylim=(0.0, 1.02))
    for axes in (series, below):
        _tidy(axes)
    figure.legend(*series.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return pictures.svg(figure)
