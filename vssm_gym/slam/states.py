"""Compare the filter's states of a run with the true ones: velocity with its band, std of the pose, calibration.

The pose's covariance is of (translation, rotation) in the camera's tangent, ``T_true = T exp(delta)``, in the world,
which is the first camera's frame, including the drift of the map since then; that of the velocity is in world axes.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from vssm_gym.data.sequences import Sequence
from vssm_gym.data.trajectories import interpolate, velocities
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import inverse
from vssm_gym.slam import trajectory_error
from vssm_gym.slam.calibration import Calibration, pose_residuals
from vssm_gym.slam.run import SlamRun, TrackedFrame
from vssm_gym.viz import pictures

NORMAL_95 = 1.96  # stds: 95 % of a normal
POSE, VELOCITY = slice(0, 6), slice(6, 12)  # of the covariance
FEWEST = 10  # frames for a calibration
AXIS_COLOURS = ("#c2185b", "#0b6e4f", "#0072b2")


@dataclass(frozen=True)
class Truth:
    """Hold the ground truth of a run's frames in the map's frame, after rigid least-squares alignment of positions."""

    T_truth_world: Float[np.ndarray, "4 4"]
    positions: Float[np.ndarray, "n 3"]  # m, all true ones from the first frame to the last, truth's frame
    rows: Int[np.ndarray, "k"]  # of run.frames: those with an associated true pose
    T_world_cam: Float[np.ndarray, "k 4 4"]  # their true poses, at their own times

    @classmethod
    def of(cls, run: SlamRun, sequence: Sequence) -> "Truth | None":
        """Align the truth to a run.

        None without truth, or where alignment is impossible (see ``stats["errors"]``).
        """
        if sequence.truth is None:
            return None
        times, T_true = sequence.truth
        i, j = trajectory_error.associate(run.times, times)
        try:
            alignment = trajectory_error.align(run.poses[i, :3, 3], T_true[j, :3, 3])
        except InputError:
            return None
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = alignment.rotation, alignment.translation
        rows = np.unique(i)
        at_frames = interpolate(times, T_true, run.times[rows])
        inside = (times >= run.times[0]) & (times <= run.times[-1])
        return cls(T, T_true[inside, :3, 3], rows, inverse(T) @ at_frames)

    def velocities(self, run: SlamRun) -> tuple[Int[np.ndarray, "m"], Float[np.ndarray, "m 6"]]:
        """Return frames whose predecessor has a true pose too, and the true mean velocity since the predecessor, world.

        The filter estimates this mean: its new velocity moves the last pose to the new one.
        """
        after = np.flatnonzero(np.diff(self.rows) == 1) + 1
        return self.rows[after], velocities(run.times[self.rows], self.T_world_cam)[after - 1]


def calibrations(run: SlamRun, truth: Truth | None) -> dict[str, Calibration]:
    """Calibrate the filter's covariances of ``pose`` and ``velocity`` over the frames that were not lost.

    The result is empty without truth, and for fewer than ``FEWEST`` frames. The world is the first camera's frame:
    poses are aligned by the first one alone, as in the calibration study, so that later drift counts as error.
    """
    if truth is None:
        return {}
    T_true = dict(zip(truth.rows.tolist(), truth.T_world_cam, strict=True))
    v_true = dict(zip(*(a.tolist() for a in truth.velocities(run)), strict=True))
    of_pose = [(f.covariance, f.T_world_cam, T_true[i]) for i, f in _known(run) if i in T_true]
    of_velocity = [(f.covariance, f.velocity, v_true[i]) for i, f in _known(run) if i in v_true]
    result = {}
    if len(of_pose) >= FEWEST:
        covariance, estimate, true = (np.stack(values) for values in zip(*of_pose, strict=True))
        first = next(i for i in truth.rows.tolist() if not run.frames[i].lost)
        T_world_truth = run.frames[first].T_world_cam @ inverse(T_true[first])
        result["pose"] = Calibration.of(pose_residuals(estimate, T_world_truth @ true), covariance[:, POSE, POSE])
    if len(of_velocity) >= FEWEST:
        covariance, estimate, true = (np.stack(values) for values in zip(*of_velocity, strict=True))
        result["velocity"] = Calibration.of(true - estimate, covariance[:, VELOCITY, VELOCITY])
    return result


def calibration_summary(run: SlamRun, truth: Truth | None) -> dict[str, Any] | None:
    """Summarise calibration as JSON values: NEES, frames within regions, velocity components within their band."""
    found = calibrations(run, truth)
    if truth is None or not found:
        return None
    result: dict[str, Any] = {
        name: {"frames": len(c.nees), "dimension": c.dimension} | c.summary() for name, c in found.items()
    }
    if "velocity" in result:
        rows, true = truth.velocities(run)
        mean, std = velocity_bands(run)
        inside = np.abs(true - mean[rows]) <= NORMAL_95 * std[rows]
        known = np.isfinite(std[rows, 0])
        result["velocity"]["share_in_band"] = inside[known].mean(axis=0).tolist()
    return result


def _known(run: SlamRun) -> list[tuple[int, TrackedFrame]]:
    """Return frames with a belief that an image confirmed, and their row."""
    return [(i, f) for i, f in enumerate(run.frames) if f.covariance is not None and not f.lost]


def velocity_bands(run: SlamRun) -> tuple[Float[np.ndarray, "frames 6"], Float[np.ndarray, "frames 6"]]:
    """Return mean and std of the velocity, linear (m/s) and angular (rad/s) in the world; NaN where there is none."""
    return _rows(run, lambda f: f.velocity), _rows(run, lambda f: np.sqrt(np.diag(f.covariance)[VELOCITY]))


def _rows(run: SlamRun, values: Any) -> np.ndarray:
    result = np.full((len(run.frames), 6), np.nan)
    for i, frame in _known(run):
        result[i] = values(frame)
    return result


def tidy(axes: Axes) -> None:
    """Draw a thin grid without a box."""
    axes.grid(alpha=0.3, linewidth=0.5)
    axes.spines[["top", "right"]].set_visible(False)


def velocity(run: SlamRun, truth: Truth | None) -> bytes:
    """Draw the six velocity components over time, each with the band that should hold 95 % of the truth, as WebP."""
    t = run.times - run.times[0]
    mean, std = velocity_bands(run)
    figure = Figure(figsize=(11.5, 5.0), layout="constrained")
    panels = figure.subplots(2, 3, sharex=True, sharey="row").ravel()
    rows, true = truth.velocities(run) if truth else (np.zeros(0, int), np.zeros((0, 6)))
    for c, axes in enumerate(panels):
        low, high = mean[:, c] - NORMAL_95 * std[:, c], mean[:, c] + NORMAL_95 * std[:, c]
        band = axes.fill_between(t, low, high, color=pictures.ESTIMATE_COLOUR, alpha=0.2, linewidth=0, label="95 %")
        (line,) = axes.plot(t, mean[:, c], color=pictures.ESTIMATE_COLOUR, linewidth=1.1, label="estimate")
        handles = [line, band]
        if len(rows):
            broken = np.insert(true[:, c], np.flatnonzero(np.diff(rows) > 1) + 1, np.nan)
            at = np.insert(t[rows], np.flatnonzero(np.diff(rows) > 1) + 1, np.nan)
            handles += axes.plot(at, broken, color=pictures.TRUE_COLOUR, linewidth=0.9, label="ground truth")
        axes.set_title(("linear", "angular")[c // 3] + f" {'xyz'[c % 3]}", fontsize=10)
        tidy(axes)
    # The band of an unknown velocity after a loss is metres a second wide: the axes follow the estimate.
    for first, unit in ((0, "m/s"), (3, "rad/s")):
        size = np.nanmax(
            np.abs(mean[:, first : first + 3]), initial=0.01, where=np.isfinite(mean[:, first : first + 3])
        )
        width = NORMAL_95 * np.nanmedian(std[:, first : first + 3]) if np.isfinite(std).any() else 0.0
        panels[first].set(ylabel=unit, ylim=(-1.1 * size - 1.3 * width, 1.1 * size + 1.3 * width))
    for axes in panels[3:]:
        axes.set_xlabel("time, s")
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return pictures.webp(figure)


def pose_std(run: SlamRun) -> bytes:
    """Draw the std of the pose in the camera's tangent over time, as WebP; crosses mark lost frames."""
    rows = [(frame.time, frame.covariance, frame.lost) for frame in run.frames if frame.covariance is not None]
    figure = Figure(figsize=(11.5, 2.8), layout="constrained")
    panels = figure.subplots(1, 2)
    if rows:
        t = np.array([time for time, _, _ in rows]) - run.times[0]
        std = 1e3 * np.sqrt(np.stack([np.diag(covariance)[POSE] for _, covariance, _ in rows]))
        lost = np.array([gone for _, _, gone in rows])
        for first, axes in ((0, panels[0]), (3, panels[1])):
            for c, colour in enumerate(AXIS_COLOURS):
                label = ("x (right)", "y (down)", "z (ahead)")[c]
                axes.plot(t, std[:, first + c], color=colour, linewidth=1.0, label=label)
                axes.plot(t[lost], std[lost, first + c], "x", color="black", markersize=4)
            axes.set_yscale("log")
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_formatter(NullFormatter())
    for axes, label in zip(panels, ("translation, mm", "rotation, mrad"), strict=True):
        axes.set(xlabel="time, s", ylabel=f"std of the {label}")
        tidy(axes)
    figure.legend(
        *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False, fontsize=9
    )
    return pictures.webp(figure)
