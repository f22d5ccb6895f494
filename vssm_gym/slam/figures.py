"""Draw the figures of a SLAM report: trajectory, slices through the map, rendered and observed images, fit, latency."""

from collections.abc import Mapping
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse

from vssm_gym.data.sequences import Sequence
from vssm_gym.geometry.transforms import R_BODY_CAM, inverse, transform
from vssm_gym.inference.alignment.residuals import FULL_COVERAGE
from vssm_gym.inference.status import Status
from vssm_gym.inference.tracking.config import TrackingConfig
from vssm_gym.maps.cell_centres import cell_centres
from vssm_gym.maps.voxel_map import OBSERVATION_STD, OBSERVED_PRECISION, VoxelMap
from vssm_gym.model import emission
from vssm_gym.slam.calibration import Calibration, fit_scale
from vssm_gym.slam.run import SlamRun, TrackedFrame
from vssm_gym.slam.states import Truth, tidy
from vssm_gym.slam.verdict import CALIBRATED
from vssm_gym.viz import pictures, surface_view
from vssm_gym.viz.html import Data, Image, webp_image
from vssm_gym.viz.mesh import Mesh

OBSERVED_COLOUR = "#0072b2"
SLICE_MARGIN = 0.4  # m around the content of a slice
SHOWN_FRAMES = 5  # frames whose images are shown beside the map's, spread over the run
SLICE_PIXELS = 420  # of a slice along its longer edge, at most
STAGES = {"track": "#0072b2", "map": "#0b6e4f", "reference": "#e69f00", "recover": "#56b4e9", "smooth": "#cc79a7"}
ELLIPSES = 25  # drawn along a path
CALIBRATION_COLOURS = ("#0072b2", "#d55e00")  # of pose and velocity


@dataclass(frozen=True)
class Display:
    """Define a frame with z up, in which a run is drawn; the map's own frame is that of a camera at any attitude."""

    T_display_world: Float[np.ndarray, "4 4"]
    note: str  # where the vertical comes from
    truth: Float[np.ndarray, "n 3"] | None  # true positions, m
    errors: Float[np.ndarray, "k 2"] | None  # time (s) and position error (m) of the frames with a true pose

    @classmethod
    def of(cls, run: SlamRun, sequence: Sequence, truth: Truth | None) -> "Display":
        """Choose the truth's frame where the run can be aligned to it, else the frame of the body with the camera."""
        if truth is not None:
            off = np.linalg.norm(run.poses[truth.rows, :3, 3] - truth.T_world_cam[:, :3, 3], axis=-1)
            errors = np.stack([run.times[truth.rows], off], axis=-1)
            return cls(truth.T_truth_world, "the ground truth's frame, after SE(3) alignment", truth.positions, errors)
        if run.T_level_world is not None:
            return cls(run.T_level_world, "the map's frame", None, None)
        if sequence.T_body_cam is not None:
            return cls(sequence.T_body_cam, "the first frame's body frame", None, None)
        T = np.eye(4)
        T[:3, :3] = R_BODY_CAM
        return cls(T, "up is the first camera's up: true only if it was held level", None, None)


def path(run: SlamRun, display: Display) -> tuple[bytes, float]:
    """Draw top view, side view and, where the truth is known, the position error over time, as SVG.

    Returns:
        The picture, and the magnification of the ellipses that hold 95 % of the position.
    """
    panels = 2 if display.errors is None else 3
    figure = Figure(figsize=(11.5, 3.6), layout="constrained")
    all_axes = np.atleast_1d(figure.subplots(1, panels))
    p = transform(display.T_display_world, run.poses[:, :3, 3])
    spread = _position_spread(run, display)
    largest = max((pictures.REGION_95 * np.sqrt(np.trace(covariance)) for _, covariance in spread), default=1.0)
    room = 0.05 * float(np.ptp(p, axis=0).max())
    magnified = max(1.0, 10.0 ** np.floor(np.log10(max(room / largest, 1.0))))
    for axes, (a, b), title in zip(all_axes, ((0, 1), (0, 2)), ("from above", "from the side"), strict=False):
        if display.truth is not None:
            axes.plot(display.truth[:, a], display.truth[:, b], color=pictures.TRUE_COLOUR, linewidth=1.6)
        axes.plot(p[:, a], p[:, b], color=pictures.ESTIMATE_COLOUR, linewidth=1.2, linestyle=pictures.DASHES)
        axes.plot(*p[0, [a, b]], "o", color=pictures.ESTIMATE_COLOUR, markersize=5)
        axes.plot(p[run.lost, a], p[run.lost, b], "x", color="black", markersize=5)
        for centre, covariance in spread:
            axes.add_patch(_ellipse(centre[[a, b]], covariance[np.ix_([a, b], [a, b])], magnified))
        axes.set(title=title, xlabel="x, m", ylabel=f"{'xyz'[b]}, m", aspect="equal", adjustable="datalim")
        tidy(axes)
    if display.errors is not None:
        axes = all_axes[2]
        axes.plot(display.errors[:, 0] - run.times[0], 100.0 * display.errors[:, 1], color=pictures.ESTIMATE_COLOUR)
        axes.set(title="distance to the truth", xlabel="time, s", ylabel="position error, cm")
        axes.set_ylim(bottom=0.0)
        tidy(axes)
    handles = [
        Line2D([], [], color=pictures.ESTIMATE_COLOUR, linestyle=pictures.DASHES, label="estimate"),
        Line2D(
            [],
            [],
            color=pictures.ESTIMATE_COLOUR,
            alpha=0.5,
            marker="o",
            fillstyle="none",
            linestyle="",
            markersize=9,
            label=f"95 % of the position, {magnified:g}x",
        ),
        Line2D([], [], color=pictures.ESTIMATE_COLOUR, marker="o", linestyle="", markersize=5, label="first frame"),
    ]
    if display.truth is not None:
        handles.insert(0, Line2D([], [], color=pictures.TRUE_COLOUR, linewidth=1.6, label="ground truth"))
    if run.lost.any():
        handles.append(Line2D([], [], color="black", marker="x", linestyle="", markersize=5, label="lost frame"))
    figure.legend(handles=handles, loc="outside lower center", ncols=5, frameon=False, fontsize=9)
    return pictures.svg(figure), magnified


def _position_spread(run: SlamRun, display: Display) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return position (m) and its covariance (m^2) in the display's frame, for frames spread over the run."""
    known = [(f.T_world_cam, f.covariance) for f in run.frames if f.covariance is not None and not f.lost]
    result = []
    for T_world_cam, covariance in known[:: max(1, len(known) // ELLIPSES)]:
        T = display.T_display_world @ T_world_cam
        result.append((T[:3, 3], T[:3, :3] @ covariance[:3, :3] @ T[:3, :3].T))
    return result


def _ellipse(centre: np.ndarray, covariance: np.ndarray, magnified: float) -> Ellipse:
    variance, axes = np.linalg.eigh(covariance)
    width, height = 2.0 * pictures.REGION_95 * magnified * np.sqrt(np.maximum(variance, 0.0))
    angle = np.degrees(np.arctan2(axes[1, 0], axes[0, 0]))
    colour = pictures.ESTIMATE_COLOUR
    return Ellipse(
        (centre[0], centre[1]), width, height, angle=angle, fill=False, color=colour, alpha=0.5, linewidth=0.8
    )


@dataclass(frozen=True)
class Surface:
    """Hold the view of a surface with the camera's paths: the data of its script, and a still picture."""

    data: Data
    still: Image
    has_truth: bool
    faces: int  # that are shown


def surface(run: SlamRun, mesh: Mesh, display: Display) -> Surface | None:
    """Prepare the surface of the map with the estimated and the true path; None where the map has no surface."""
    if len(mesh.faces) == 0:
        return None
    shown = surface_view.moved(surface_view.decimated(mesh), display.T_display_world)
    poses = display.T_display_world @ run.poses
    estimate = surface_view.path_segments(poses[:, :3, 3])
    size = surface_view.CAMERA_SIZE * surface_view.extent(shown, estimate)[1]
    truth = np.zeros((0, 2, 3)) if display.truth is None else surface_view.path_segments(display.truth)
    drawn = np.concatenate([estimate, surface_view.camera_segments(poses, size)])
    block, still = surface_view.prepared(shown, drawn, truth, surface_view.facing(poses))
    return Surface(Data(block), webp_image(still), display.truth is not None, len(shown.faces))


def calibration_curves(states: Mapping[str, Calibration]) -> bytes:
    """Draw the calibration curves of the states, as the filter gives them and rescaled, as SVG.

    Left, the proportion of frames up to each predicted probability; right, the NEES of each frame over the dimension.
    """
    figure = Figure(figsize=(11.5, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.0, 1.6])
    left.plot([0, 1], [0, 1], color="0.7", linewidth=1.0, label="calibrated")
    right.axhline(1.0, color="0.7", linewidth=1.0)
    right.axhspan(*CALIBRATED, color="0.93", linewidth=0)
    for colour, (name, found) in zip(CALIBRATION_COLOURS, states.items(), strict=False):
        rescaled = found.scaled(fit_scale({name: found}))
        left.plot(*found.curve(), color=colour, linewidth=1.5, label=name)
        left.plot(*rescaled.curve(), color=colour, linewidth=1.0, linestyle="--", label=f"{name}, rescaled")
        right.plot(np.maximum(found.nees / found.dimension, 1e-3), color=colour, linewidth=1.0, label=name)
    left.set(xlabel="predicted probability", ylabel="observed proportion", xlim=(0, 1), ylim=(0, 1), aspect="equal")
    left.set_title("above the diagonal: pessimistic", fontsize=10)
    right.set(xlabel="frame with a true state", ylabel="NEES / dimension", yscale="log")
    right.set_title("1 on average if calibrated; grey: within a factor of two", fontsize=10)
    left.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    for axes in (left, right):
        tidy(axes)
    return pictures.svg(figure)


def slices(run: SlamRun, display: Display, counted: float) -> bytes:
    """Draw mean and std of occupancy on the horizontal and the vertical plane that cut most free space, as WebP.

    ``counted`` is the std that the update gave each observation (``MapUpdateConfig.std``). A real reading has
    ``OBSERVATION_STD``, to which the displayed std is scaled.
    """
    cameras = transform(display.T_display_world, run.poses[:, :3, 3])
    voxel = float(run.map.voxel_size)
    free = transform(display.T_display_world, observed_cells(run.map, below=-voxel))
    seen = transform(display.T_display_world, observed_cells(run.map))
    figure = Figure(figsize=(11.5, 8.4), layout="constrained")
    for row, (a, b) in zip(figure.subplots(2, 2), ((0, 1), (0, 2)), strict=True):
        fixed = 3 - a - b
        most = next(places for places in (free, seen, cameras) if len(places))
        layers, counts = np.unique(np.round(most[:, fixed] / voxel), return_counts=True)
        height = voxel * float(layers[np.argmax(counts)])
        shown = np.concatenate([seen[np.abs(seen[:, fixed] - height) <= voxel], cameras])
        low, high = shown.min(axis=0) - SLICE_MARGIN, shown.max(axis=0) + SLICE_MARGIN
        resolution = max((high - low)[[a, b]].max() / SLICE_PIXELS, 0.25 * voxel)
        u, v = (np.arange(low[c], high[c], resolution) for c in (a, b))
        p = np.empty((len(v), len(u), 3))
        p[..., a], p[..., b], p[..., fixed] = u, v[:, None], height
        mean, std = belief_at(run.map, transform(inverse(display.T_display_world), p))
        std *= 1e3 * OBSERVATION_STD / counted
        extent = (u[0], u[-1], v[0], v[-1])
        once = 1e3 * OBSERVATION_STD
        surest = min(0.5 * once, float(np.nanmin(std, initial=once)))
        panels = (
            (mean, "RdBu_r", Normalize(-2.0 * voxel, 2.0 * voxel), "mean occupancy, m"),
            (std, "viridis", LogNorm(surest, once), "std of occupancy, mm"),
        )
        for axes, (values, colours, norm, label) in zip(row, panels, strict=True):
            axes.set_facecolor(pictures.UNKNOWN_COLOUR)
            image = axes.imshow(values, origin="lower", extent=extent, interpolation="nearest", cmap=colours, norm=norm)
            bar = figure.colorbar(image, ax=axes, label=label, shrink=0.85)
            if values is std:
                bar.set_ticks([tick for tick in (0.5, 1, 2, 5, 10, 20, 30) if surest <= tick <= once])
                bar.ax.yaxis.set_major_formatter("{x:g}")
                bar.ax.minorticks_off()
            axes.plot(cameras[:, a], cameras[:, b], color="black", linewidth=0.7)
            axes.set(xlabel="x, m", ylabel=f"{'xyz'[b]}, m", title=f"{'xyz'[fixed]} = {height:.2f} m")
    return pictures.webp(figure)


def observed_cells(m: VoxelMap, below: float = np.inf) -> np.ndarray:
    """Return centres ``(n, 3)`` of the observed cells whose mean occupancy is below a limit (m), map frame."""
    chosen = (np.asarray(m.occupancy_precision) > OBSERVED_PRECISION) & (np.asarray(m.occupancy) < below)
    return cell_centres(m, chosen)


def belief_at(m: VoxelMap, p_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean of occupancy (m) and precision^-1/2 at points; NaN where one of the eight cells around is unobserved.

    The mean crosses zero at the border of observed space, but that crossing is no surface.
    """
    p = jnp.asarray(p_world, jnp.float32)
    corners, _, inside = m.corners(p)
    observed = np.asarray(m.occupancy_precision).reshape(-1) > OBSERVED_PRECISION
    known = np.asarray(inside) & np.all([observed[np.asarray(corner)] for corner in corners], axis=0)
    mean, precision = np.asarray(m.occupancy_at(p)), np.asarray(m.precision(p))[..., 0]
    return np.where(known, mean, np.nan), np.where(known, precision**-0.5, np.nan)


def views(run: SlamRun) -> tuple[bytes, list[tuple[int, float, float]]]:
    """Draw frames spread over the run beside the final map rendered at their estimated poses, as WebP.

    Returns:
        The picture, and per frame its index in the sequence, the median depth difference (m) where both images have a
        depth, and the share of the observed depths that the map has a known surface for.
    """
    held = [frame for frame in run.frames if not frame.lost]
    chosen = [held[i] for i in sorted({round(x) for x in np.linspace(0, len(held) - 1, SHOWN_FRAMES)})]
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


def fit(run: SlamRun, config: TrackingConfig) -> bytes:
    """Draw score and photometric residual of the loss test over time, with their limits, as SVG."""
    figure = Figure(figsize=(11.5, 2.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    aligned = [frame for frame in run.frames if frame.inlier_share is not None]
    t = np.array([frame.time for frame in aligned]) - run.times[0]
    status = np.array([frame.status for frame in aligned], int)
    marks = (
        (np.isin(status, (Status.LOST, Status.NO_READING, Status.REPEATED)), "x", "lost"),
        (status == Status.RECOVERED, "^", "relocalised"),
    )
    score = np.array([_score(frame) for frame in aligned])
    photometric = np.array([np.nan if frame.photometric is None else frame.photometric for frame in aligned])
    for axes, values, limit in ((left, score, config.min_score), (right, photometric, config.max_photometric)):
        axes.plot(t, values, color=OBSERVED_COLOUR, linewidth=1.0)
        for chosen, marker, label in marks:
            if chosen.any():
                axes.plot(t[chosen], values[chosen], marker, color="black", markersize=5, label=label)
        axes.axhline(limit, color="#a3203a", linewidth=1.0, linestyle="--")
        axes.set_xlabel("time, s")
        tidy(axes)
    if any(chosen.any() for chosen, _, _ in marks):
        left.legend(frameon=False, fontsize=8)
    left.set(ylabel="score", title="geometry: must be above the limit", ylim=(0.0, 1.02))
    right.set(ylabel="mean |r| / sigma", title="photometry: must be below the limit")
    right.set_ylim(bottom=0.0)
    return pictures.svg(figure)


def _score(frame: TrackedFrame) -> float:
    """``inlier_share min(1, coverage / 0.4)``, as :func:`vssm_gym.inference.alignment.residuals.score`."""
    return (frame.inlier_share or 0.0) * min(1.0, (frame.coverage or 0.0) / FULL_COVERAGE)


def latency(run: SlamRun) -> bytes:
    """Draw milliseconds of each stage, frame by frame and as a cumulative distribution over frames, as SVG."""
    figure = Figure(figsize=(11.5, 3.2), layout="constrained")
    series, below = figure.subplots(1, 2)
    warm = [frame for frame in run.frames if frame.warm]
    stages = [
        ("whole step", [(frame.time, frame.step_s) for frame in warm], pictures.ESTIMATE_COLOUR),
        ("read (in a thread beside)", [(frame.time, frame.read_s) for frame in run.frames], "0.6"),
        ("wait for image", [(frame.time, frame.wait_s) for frame in run.frames[1:]], "0.3"),
    ]
    for stage, colour in STAGES.items():
        stages.append((stage, [(f.time, f.stages[stage]) for f in warm if stage in f.stages], colour))
    for label, points, colour in stages:
        if points:
            t, ms = np.array(points).T * [[1.0], [1e3]]
            few = len(ms) < 0.9 * len(run.frames)  # draw points, not a line, for a stage that only some frames need
            drawn = {"linestyle": "", "marker": ".", "markersize": 3} if few else {"linewidth": 0.8}
            series.plot(t - run.times[0], ms, color=colour, label=label, **drawn)
            below.step(np.sort(ms), np.arange(1, len(ms) + 1) / len(ms), where="post", color=colour)
    series.set(xlabel="time in the recording, s", ylabel="ms", yscale="log")
    below.set(xlabel="ms", ylabel="share of the frames with this stage", xscale="log", ylim=(0.0, 1.02))
    for axes in (series, below):
        tidy(axes)
    figure.legend(*series.get_legend_handles_labels(), loc="outside lower center", ncols=7, frameon=False, fontsize=9)
    return pictures.svg(figure)
