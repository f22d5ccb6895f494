"""Hold a filter's errors beside the covariances that it states, and summarise them over runs.

    e = log(T_est^-1 T_true),   NEES = e^T Sigma^-1 e ~ chi^2(d) where Sigma is right

Two statistics answer two questions. The mean of NEES / d over a run compares the errors with the covariances at every
frame; frames of one run are correlated, so its interval is a bootstrap over runs. The share of poses inside their 95 %
region is counted over short segments: the filter starts anew at the first frame of each, where it is given the true
pose, and one residual counts, that of the segment's last frame. No two segments share an image, a command, a state or a
map that was learned on the way, so that their residuals are independent given the scene, and the interval of a
proportion holds.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from vssm_gym.eval.metrics.aggregate import bootstrap_mean
from vssm_gym.eval.metrics.pose_calibration import inside_region
from vssm_gym.eval.metrics.proportions import clopper_pearson
from vssm_gym.slam.calibration import nees
from vssm_gym.slam.states import NORMAL_95


@dataclass(frozen=True)
class FilterErrors:
    """Hold the errors of one run at its tracked frames; the first frame, whose pose was given, is left out.

    Attributes:
        residuals: of the pose in the tangent of the estimate, translation (m) before rotation (rad).
        covariances: of the same, as stated.
        frames: that the filter received after the first one.
        lost: of these, not accepted.
        ended: True where the last frame was accepted.
        velocity: error over stated std of each component, linear before angular; None for a state without velocity.
    """

    residuals: Float[np.ndarray, "n d"]
    covariances: Float[np.ndarray, "n d d"]
    frames: int
    lost: int
    ended: bool
    velocity: Float[np.ndarray, "m 6"] | None = None

    @property
    def nees(self) -> Float[np.ndarray, "n"]:
        """Return the NEES of each tracked frame."""
        return nees(self.residuals, self.covariances)

    @property
    def last_nees(self) -> float | None:
        """Return the NEES of the last frame; None where it is lost."""
        return float(nees(self.residuals[-1:], self.covariances[-1:])[0]) if self.ended else None


@dataclass(frozen=True)
class RunErrors:
    """Hold a run's errors as a whole, and the NEES at the ends of its segments: None of one that ended lost."""

    whole: FilterErrors
    ends: tuple[float | None, ...]


def summarise(runs: Sequence[RunErrors]) -> dict[str, Any]:
    """Summarise the runs of one row as JSON values; None stands for what cannot be computed.

    Returns:
        ``runs``, ``frames``, ``lost``, ``dimension``; ``nees``: NEES / d, its ``mean`` over runs with the interval
        ``low``, ``high``, and the ``values`` of the runs; ``segments``: their ``count``, how many ``ended_lost``, the
        ``share`` inside the region with its interval, and NEES / d at their ends, ``mean`` and ``values``; ``error_m``
        (RMSE of the location) and ``std_m`` (root of the mean stated variance of the location); ``velocity``: shares of
        the components inside their 95 % band, ``linear`` and ``angular``, or None.
    """
    whole = [run.whole for run in runs]
    tracked = [one for one in whole if len(one.residuals)]
    d = whole[0].residuals.shape[1]
    translation = slice(0, d // 2 if d == 6 else d - 1)  # of a rigid body, and of a robot on the floor
    values = [float(one.nees.mean()) / d for one in tracked]
    interval = bootstrap_mean(values, range(len(values)))
    ends = [end for run in runs for end in run.ends]
    known = np.array([end for end in ends if end is not None])
    inside = int(np.count_nonzero(inside_region(known, d)))
    low, high = clopper_pearson(inside, len(known)) if len(known) else (None, None)
    squares = np.concatenate([np.sum(one.residuals[:, translation] ** 2, axis=1) for one in whole])
    variances = np.concatenate([np.einsum("nii->ni", one.covariances)[:, translation].sum(axis=1) for one in whole])
    return {
        "runs": len(runs),
        "frames": sum(one.frames for one in whole),
        "lost": sum(one.lost for one in whole),
        "dimension": d,
        "nees": {
            "mean": _finite(interval.mean),
            "low": _finite(interval.low),
            "high": _finite(interval.high),
            "values": values,
        },
        "segments": {
            "count": len(known),
            "ended_lost": len(ends) - len(known),
            "share": inside / len(known) if len(known) else None,
            "low": low,
            "high": high,
            "mean": float(known.mean()) / d if len(known) else None,
            "values": (known / d).tolist(),
        },
        "error_m": float(np.sqrt(squares.mean())) if len(squares) else None,
        "std_m": float(np.sqrt(variances.mean())) if len(variances) else None,
        "velocity": _of_velocity([one.velocity for one in whole if one.velocity is not None]),
    }


def _of_velocity(errors: list[np.ndarray]) -> dict[str, float] | None:
    """Return the shares of linear and angular components inside their 95 % band."""
    every = np.concatenate(errors) if errors else np.zeros((0, 6))
    if not len(every):
        return None
    inside = np.abs(every) <= NORMAL_95
    return {"linear": float(inside[:, :3].mean()), "angular": float(inside[:, 3:].mean())}


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
