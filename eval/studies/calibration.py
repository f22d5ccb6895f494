"""Compare errors of the filter's poses and velocities with their covariances (PRISM, figs. 7 and 8).

    A = T_est_0 T_true_0^-1 puts the truth into the world of the estimate: first-pose alignment, so drift counts
    e_i = log(T_est_i^-1 A T_true_i) ~ N(0, s Sigma_i)?;   v_i ~ N(v_true(i-1, i), S_i)?

The scalar s on all covariances of poses is fitted to the *other* sequences (leave-one-out). Velocities are evaluated
with the covariances as stated. Lost frames have no estimate; they are left out, but counted.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy.stats import norm

from vssm_gym.data import sequences
from vssm_gym.data.trajectories import interpolate, velocities
from vssm_gym.errors import InputError
from vssm_gym.eval.studies.page import Study, labelled
from vssm_gym.geometry.transforms import inverse
from vssm_gym.progress import OnProgress
from vssm_gym.slam import trajectory_error
from vssm_gym.slam.calibration import Calibration, cross_fitted, fit_scale, pose_residuals
from vssm_gym.slam.run import SlamOptions, SlamRun, run_slam
from vssm_gym.slam.states import NORMAL_95, tidy
from vssm_gym.viz import pictures

COLUMNS = 5  # of the small pictures


@dataclass(frozen=True)
class SequenceCalibration:
    """Hold the filter's errors and covariances over one sequence."""

    poses: Calibration  # covariances as stated
    velocity: Float[np.ndarray, "n 6"]  # error of each component (linear, angular) over its own std
    speed: float  # m/s, true, mean
    frames: int
    lost: int
    error_m: float  # RMSE of position after first-pose alignment, m


def run(
    recordings: Sequence[sequences.Sequence], *, options: SlamOptions, on_progress: OnProgress | None = None
) -> Study:
    """Run the filter over every recording and evaluate its covariances.

    Args:
        recordings: at least two, with ground truth.
        options: of the filter, the same for all.
        on_progress: called after every frame.

    Raises:
        InputError: fewer than two recordings, two of one name, one without ground truth or that was never tracked.
    """
    names = [recording.root.resolve().name for recording in recordings]
    if len(names) < 2 or len(set(names)) < len(names):
        expected = "at least two, of different names: the scale for one is fitted on the others"
        raise InputError("study calibration", "sequences", f"{expected}; found {', '.join(names) or 'none'}")
    for recording in recordings:
        if recording.truth is None:
            raise InputError(recording.root / "groundtruth.txt", "file", "ground-truth poses, which this study needs")
    evaluated: dict[str, SequenceCalibration] = {}
    notices: list[str] = []
    for name, recording in zip(names, recordings, strict=True):
        done = run_slam(recording, options, on_progress=labelled(on_progress, name))
        evaluated[name] = evaluate(done, recording)
        notices += done.notices
    raw = {name: one.poses for name, one in evaluated.items()}
    scaled = cross_fitted(raw)
    rows = {
        name: {
            "frames": one.frames,
            "lost": one.lost,
            "speed": one.speed,
            "error_m": one.error_m,
            "raw": raw[name].summary(),
            "scale": fit_scale({other: c for other, c in raw.items() if other != name}),
            "scaled": scaled[name].summary(),
            "velocity": {"linear": _of_band(one.velocity[:, :3]), "angular": _of_band(one.velocity[:, 3:])},
        }
        for name, one in evaluated.items()
    }
    scale = fit_scale(raw)
    return Study(
        name="calibration",
        question="Are the covariances of the filter calibrated?",
        answer=_answer(rows, scale),
        header=("sequence", *LABELS),
        lines=[[name, *(show(row) for show in LABELS.values())] for name, row in rows.items()],
        picture=_picture(raw, scaled, rows),
        setting={
            "sequences": names,
            "size": "x".join(map(str, options.size)),
            "rate": options.rate,
            "voxel": options.voxel,
            "extent": options.extent,
        },
        figures={"scale_of_all": scale, "sequences": rows},
        notes=(
            "Poses after first-pose alignment: drift counts as error, and on real data so does the error of the first "
            "recorded pose. NEES / 6 is 1 where calibrated. The scale multiplies all covariances of a sequence and is "
            "the mean NEES / 6 of the other sequences' frames.",
            "Bias: mean signed distance of the calibration curve from the diagonal, -0.5 to 0.5, positive where the "
            "filter is pessimistic. Velocity: proportion of components inside their own 95 % band as stated, and "
            "in brackets the RMS of error over std, 1 where calibrated.",
            "Lost frames are left out; the table states their number.",
            *notices,
        ),
    )


LABELS = {
    "frames": lambda row: str(row["frames"]),
    "lost": lambda row: str(row["lost"]),
    "speed, m/s": lambda row: f"{row['speed']:.2f}",
    "error, cm": lambda row: f"{100 * row['error_m']:.2f}",
    "NEES / 6, raw": lambda row: _short(row["raw"]["nees_over_dimension"]),
    "scale": lambda row: _short(row["scale"]),
    "NEES / 6, scaled": lambda row: _short(row["scaled"]["nees_over_dimension"]),
    "in 95 %, raw": lambda row: f"{row['raw']['share_within_95']:.1%}",
    "in 95 %, scaled": lambda row: f"{row['scaled']['share_within_95']:.1%}",
    "bias, scaled": lambda row: f"{row['scaled']['bias']:+.3f}",
    "v in 95 %": lambda row: _band_text(row["velocity"]["linear"]),
    "ω in 95 %": lambda row: _band_text(row["velocity"]["angular"]),
}


def _short(value: float) -> str:
    """Format with two decimals below 100, and with none above: a NEES can be a thousand."""
    return f"{value:.2f}" if value < 100.0 else f"{value:,.0f}"


def _of_band(errors: Float[np.ndarray, "n d"]) -> dict[str, float]:
    """Return ``share``, of components inside their 95 % band, and ``rms`` of error over std, 1 where calibrated."""
    return {"share": float(np.mean(np.abs(errors) <= NORMAL_95)), "rms": float(np.sqrt(np.mean(errors**2)))}


def _band_text(band: Mapping[str, float]) -> str:
    return f"{band['share']:.1%} ({band['rms']:.2f})"


def evaluate(done: SlamRun, recording: sequences.Sequence) -> SequenceCalibration:
    """Compute the residuals of tracked frames with a ground-truth pose.

    Args:
        done: a run over it.
        recording: with ground truth.

    Raises:
        InputError: no two such frames in a row.
    """
    assert recording.truth is not None
    known, _ = trajectory_error.associate(done.times, recording.truth[0])
    known, lost, poses = np.unique(known), done.lost, done.poses
    kept = np.array([i for i in known if done.frames[i].covariance is not None and not lost[i]], int)
    # The filter's velocity at a frame is that since the frame before, whose pose must be known too.
    moved = np.flatnonzero(np.isin(kept - 1, known))
    if len(moved) == 0:
        raise InputError(recording.root, "frames", "some that are tracked, with a ground-truth pose and one before it")
    start = next(i for i in known if not lost[i])
    T_true = interpolate(*recording.truth, done.times)
    T_true = poses[start] @ inverse(T_true[start]) @ T_true
    covariances = np.stack([done.frames[i].covariance for i in kept])
    e = pose_residuals(poses[kept], T_true[kept])
    true_velocity = velocities(done.times, T_true)[kept[moved] - 1]
    off = np.stack([done.frames[i].velocity for i in kept[moved]]) - true_velocity
    std = np.sqrt(np.einsum("nii->ni", covariances[moved])[:, 6:])
    position = np.linalg.norm(poses[kept, :3, 3] - T_true[kept, :3, 3], axis=1)
    return SequenceCalibration(
        poses=Calibration.of(e, covariances[:, :6, :6]),
        velocity=off / std,
        speed=float(np.linalg.norm(true_velocity[:, :3], axis=1).mean()),
        frames=len(done.frames),
        lost=int(lost.sum()),
        error_m=float(np.sqrt(np.mean(position**2))),
    )


def _answer(rows: Mapping[str, Any], scale: float) -> str:
    def over(*path: str) -> tuple[float, float]:
        values = []
        for row in rows.values():
            for name in path:
                row = row[name]
            values.append(row)
        return min(values), max(values)

    (raw0, raw1), (a0, a1) = over("raw", "nees_over_dimension"), over("scaled", "nees_over_dimension")
    (w0, w1), (v0, v1) = over("scaled", "share_within_95"), over("velocity", "linear", "share")
    (o0, o1), (b0, b1) = over("velocity", "angular", "share"), over("scaled", "bias")
    mood = "pessimistic" if b0 > 0 else "overconfident" if b1 < 0 else "pessimistic on some, overconfident on others"
    return (
        f"NEES / 6 of the poses is {_short(raw0)} to {_short(raw1)} over {len(rows)} sequences (1 is calibrated); one "
        f"scale fitted on all is {_short(scale)}, that is {np.sqrt(scale):.1f} times the stds. With the scale of the "
        f"other sequences it is {_short(a0)} to {_short(a1)}, and {w0:.0%} to {w1:.0%} of the poses lie in their 95 % "
        f"region: {mood}. Velocity: {v0:.0%} to {v1:.0%} (linear) and {o0:.0%} to {o1:.0%} (angular) of the components "
        f"lie in their 95 % band as stated."
    )


def _picture(raw: Mapping[str, Calibration], scaled: Mapping[str, Calibration], rows: Mapping[str, Any]) -> bytes:
    """Draw calibration curves raw and scaled, velocity bands, and whitened residuals of each sequence, as SVG."""
    lines = -(-len(raw) // COLUMNS)
    figure = Figure(figsize=(11.5, 3.7 + 2.1 * lines), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=[3.7, 2.1 * lines], squeeze=False)[:, 0]
    left, middle, right = above.subplots(1, 3)
    for axes, chosen, title in ((left, raw, "poses, as stated"), (middle, scaled, "poses, scaled by the others")):
        axes.plot([0, 1], [0, 1], color="0.7", linewidth=1.0)
        for i, (name, calibration) in enumerate(chosen.items()):
            axes.plot(*calibration.curve(), label=name, linewidth=1.3, color=f"C{i % 10}", clip_on=False)
        axes.set(xlabel="predicted cumulative probability", title=title, xlim=(0, 1), ylim=(0, 1), aspect="equal")
    left.set_ylabel("observed proportion (above: pessimistic)")
    places = np.arange(len(rows))
    for offset, kind, colour in ((-0.2, "linear", pictures.TRUE_COLOUR), (0.2, "angular", pictures.GOAL_COLOUR)):
        shares = [100 * row["velocity"][kind]["share"] for row in rows.values()]
        right.barh(places + offset, shares, 0.36, color=colour, label=kind)
    right.axvline(95.0, color="0.3", linestyle="--", linewidth=1.0)
    right.set(xlabel="% in the 95 % band", title="velocity, as stated", xlim=(0, 100))
    right.set_yticks(places, [pictures.tick_name(name) for name in rows], fontsize=8)
    right.invert_yaxis()
    right.legend(fontsize=8, frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
    for axes in (left, middle, right):
        tidy(axes)
    middle.legend(fontsize=7, frameon=False, loc="lower right")
    _histograms(below, scaled)
    return pictures.svg(figure)


def _histograms(figure: Any, scaled: Mapping[str, Calibration]) -> None:
    """Draw whitened residuals of translation and rotation over a standard normal; beyond 5 in the last bin."""
    grid = figure.subplots(
        -(-len(scaled) // COLUMNS), min(COLUMNS, len(scaled)), sharex=True, sharey=True, squeeze=False
    ).ravel()
    w, edges = np.linspace(-5.0, 5.0, 201), np.linspace(-5.0, 5.0, 41)
    for axes, (name, calibration) in zip(grid, scaled.items(), strict=False):
        axes.fill_between(w, norm.pdf(w), color="0.85", label="calibrated")
        for kind, part, colour in (("translation", slice(0, 3), "C0"), ("rotation", slice(3, 6), "C3")):
            values = np.clip(calibration.whitened[:, part].ravel(), -4.999, 4.999)
            axes.stairs(np.histogram(values, edges, density=True)[0], edges, label=kind, linewidth=1.1, color=colour)
        axes.set_title(name, fontsize=9)
        tidy(axes)
    for axes in grid[len(scaled) :]:
        axes.set_axis_off()
    figure.suptitle("whitened residuals, scaled by the others", fontsize=10)
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False, fontsize=8)
