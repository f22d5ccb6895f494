"""Judge a SLAM run for the top of its report: tiles, and warnings about what the numbers below cannot say."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from vssm_gym.inference.status import Status
from vssm_gym.slam.run import SlamRun
from vssm_gym.slam.states import Truth
from vssm_gym.viz.html import Tile

CALIBRATED = (0.5, 2.0)  # NEES / dimension: a covariance within a factor of two is not warned about
LOOSE_ALIGNMENT = 0.2  # rad: of a rotation that is less certain the report warns


@dataclass(frozen=True)
class Alignment:
    """Hold how well the positions of a run determine the rotation that aligns them to the truth.

    A turn by a rad about an axis moves the positions by ``a spread``, where ``spread`` is their root mean square
    distance from the axis. With errors of the size ``error`` the rotation is therefore uncertain by about ``error /
    spread`` about the axis of least spread: where a camera has turned but hardly moved, it absorbs much of the error.
    """

    spread: float  # m, about the axis through the mean along which the positions lie
    error: float  # m, root mean square distance to the truth after alignment

    @classmethod
    def of(cls, run: SlamRun, truth: Truth) -> "Alignment":
        """Measure both on the frames that have a true pose."""
        true = truth.T_world_cam[:, :3, 3]
        variances = np.linalg.eigvalsh(np.cov(true.T, bias=True))  # ascending; the last is along the axis
        error = float(np.sqrt(np.mean(np.sum((run.poses[truth.rows, :3, 3] - true) ** 2, axis=-1))))
        return cls(float(np.sqrt(max(variances[:2].sum(), 0.0))), error)

    @property
    def angle(self) -> float:
        """Return the uncertainty of the rotation about that axis, rad, at most pi."""
        return math.pi if self.spread <= 0.0 else min(self.error / self.spread, math.pi)

    @property
    def is_loose(self) -> bool:
        """Return whether the alignment is ill-conditioned."""
        return self.angle > LOOSE_ALIGNMENT


def bias(nees_over_dimension: float) -> str:
    """Return ``overconfident``, ``pessimistic``, or an empty text where the covariances have about the right size."""
    low, high = CALIBRATED
    if nees_over_dimension > high:
        return "overconfident"
    return "pessimistic" if nees_over_dimension < low else ""


def factor(nees_over_dimension: float) -> str:
    """Return by how much a covariance is too small or too large."""
    return f"{max(nees_over_dimension, 1.0 / max(nees_over_dimension, 1e-9)):.3g}"


def warnings_of(calibration: dict[str, Any] | None) -> list[dict[str, str]]:
    """Name the covariances whose size is wrong, with their bias and the factor."""
    return [
        {"state": name, "bias": bias(of["nees_over_dimension"]), "factor": factor(of["nees_over_dimension"])}
        for name, of in (calibration or {}).items()
        if bias(of["nees_over_dimension"])
    ]


def tiles(run: SlamRun, stats: dict[str, Any], alignment: Alignment | None) -> list[Tile]:
    """Return the numbers of the summary; those that need ground truth only where it is known."""
    n, lost = len(run.frames), sum(frame.lost for frame in run.frames)
    again = sum(frame.status is Status.RECOVERED for frame in run.frames)
    found = f"of {n:,}" + (f"; relocalised {again} time{'s' * (again != 1)}" if again else "")
    shown = [Tile("frames tracked", f"{n - lost:,}", found, "bad" if lost else "good")]
    errors = stats["errors"]
    if errors and "pairs" in errors:
        ate = f"{100.0 * errors['ate_translation_se3']['rmse']:.2f} cm"
        loose = alignment is not None and alignment.is_loose
        before = (stats.get("refinement") or {}).get("ate_before")
        filtered = f"; before smoothing {100.0 * before['rmse']:.2f} cm" if before else ""
        shown.append(Tile("position error", ate, f"ATE after SE(3), RMSE{filtered}", "warn" if loose else "main"))
        if "rpe_translation_30" in errors:
            drift = f"{100.0 * errors['rpe_translation_30']['rmse']:.2f} cm"
            shown.append(Tile("drift over 30 frames", drift, f"and {errors['rpe_rotation_30']['rmse']:.2f}°, RMSE"))
    calibration = (stats["calibration"] or {}).get("pose")
    if calibration is not None:
        ratio = calibration["nees_over_dimension"]
        note = bias(ratio) or "covariance of about the right size"
        shown.append(Tile("pose NEES / dimension", f"{ratio:.3g}", note, "warn" if bias(ratio) else "good"))
    speed, step = stats["real_time"], stats["latency_ms"].get("whole step")
    if speed is not None and step is not None:
        note = f"step {step['p50']:.1f} ms, 95 %: {step['p95']:.0f}; an image every {1e3 * speed['period_s']:.0f} ms"
        late = "warn" if speed["factor"] < 1.0 else ""
        shown.append(Tile("real-time factor", f"{speed['factor']:.2f}", note, late))
    shape = " x ".join(f"{stats['map']['voxel'] * cells:.3g}" for cells in stats["map"]["shape"])
    shown.append(Tile("voxel", f"{100.0 * stats['map']['voxel']:.3g} cm", f"grid {shape} m"))
    return shown
