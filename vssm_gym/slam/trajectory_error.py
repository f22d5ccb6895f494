"""Compute absolute and relative trajectory errors of estimated SE(3) poses (Sturm et al., IROS 2012).

The estimate's frame is arbitrary, so that it is aligned first, and every result names the alignment: the rigid
(``se3``) or similarity (``sim3``) motion of least squared error (Umeyama, PAMI 1991), the first pose alone (``first``:
the drift of an estimate with a known start), or none (``none``). All arrays are float64: ``times (N,)`` in seconds,
``T (N, 4, 4)`` poses in metres.
"""

from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import inverse

AlignmentName = Literal["se3", "sim3", "first", "none"]


def associate(
    times_est: Float[np.ndarray, "n"], times_true: Float[np.ndarray, "m"], tolerance: float = 0.01
) -> tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"]]:
    """Pair each stamp of the *shorter* trajectory with the nearest one of the other, within ``tolerance`` s.

    No pose of the shorter trajectory is lost; neither has to be sorted. Of two equally near stamps the earlier one
    counts, and one pose of the longer trajectory may be paired with two of the shorter.

    Returns:
        Indices into the estimate and into the truth, of equal length, possibly empty.
    """
    times_est, times_true = np.asarray(times_est, dtype=np.float64), np.asarray(times_true, dtype=np.float64)
    if len(times_est) < len(times_true):
        return _nearest(times_est, times_true, tolerance)
    of_true, of_est = _nearest(times_true, times_est, tolerance)
    return of_est, of_true


def _nearest(short: np.ndarray, long: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Index pairs (short, long) of each short stamp and its nearest long one, where near enough."""
    if len(short) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    order = np.argsort(long, kind="stable")
    after = np.clip(np.searchsorted(long[order], short, side="right"), 1, max(len(long) - 1, 1))
    before, after = order[after - 1], order[np.minimum(after, len(long) - 1)]
    best = np.where(np.abs(long[after] - short) < np.abs(short - long[before]), after, before)
    kept = np.flatnonzero(np.abs(long[best] - short) <= tolerance)
    return kept, best[kept]


@dataclass(frozen=True)
class Alignment:
    """``p_true ~ scale R p_est + t``."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]  # metres
    scale: float  # 1 for a rigid alignment

    def apply(self, T_est: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4 4"]:
        """Transform poses to the true frame: positions are scaled, rotated and moved, orientations rotated."""
        T = np.array(T_est, dtype=np.float64)
        T[:, :3, 3] = self.scale * T[:, :3, 3] @ self.rotation.T + self.translation
        T[:, :3, :3] = self.rotation @ T[:, :3, :3]
        return T


def align(p_est: Float[np.ndarray, "n 3"], p_true: Float[np.ndarray, "n 3"], with_scale: bool = False) -> Alignment:
    """``argmin_{s, R, t} sum_i |p_true_i - (s R p_est_i + t)|^2`` in closed form, ``s = 1`` unless ``with_scale``.

    Raises:
        InputError: fewer than three positions, or all on one line, where the rotation is not determined.
    """
    p_est, p_true = np.asarray(p_est, dtype=np.float64), np.asarray(p_true, dtype=np.float64)
    if len(p_est) < 3:
        raise InputError("trajectory alignment", "positions", f"at least three; found {len(p_est)}")
    mean_est, mean_true = p_est.mean(axis=0), p_true.mean(axis=0)
    x, y = p_est - mean_est, p_true - mean_true
    U, d, Vt = np.linalg.svd(y.T @ x / len(x))
    if d[1] <= 1e-12 * d[0] or d[0] == 0.0:
        raise InputError("trajectory alignment", "positions", "at least three that do not lie on one line")
    # Umeyama eq. 39: flip the least certain axis where the best orthogonal matrix would be a reflection.
    flip = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = (U * flip) @ Vt
    scale = float(d @ flip / np.mean(np.sum(x**2, axis=1))) if with_scale else 1.0
    return Alignment(R, mean_true - scale * R @ mean_est, scale)


@dataclass(frozen=True)
class Statistics:
    """Summarise non-negative errors, in their own unit (``sse`` in its square)."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float
    sse: float

    @classmethod
    def of(cls, errors: Float[np.ndarray, "n"]) -> "Statistics":
        """Summarise ``(n,)`` errors, n >= 1; ``std`` is the population's."""
        sse = float(np.sum(errors**2))
        return cls(
            rmse=float(np.sqrt(sse / len(errors))),
            mean=float(np.mean(errors)),
            median=float(np.median(errors)),
            std=float(np.std(errors)),
            min=float(np.min(errors)),
            max=float(np.max(errors)),
            sse=sse,
        )


@dataclass(frozen=True)
class PoseErrors:
    """Hold the error of each pose (or pair of poses), in time order."""

    translation: Float[np.ndarray, "n"]  # metres
    rotation: Float[np.ndarray, "n"]  # degrees, in [0, 180]


def aligned(
    T_est: Float[np.ndarray, "n 4 4"], T_true: Float[np.ndarray, "n 4 4"], alignment: AlignmentName = "se3"
) -> Float[np.ndarray, "n 4 4"]:
    """``A T_est`` with the alignment A; for ``first``, ``A = T_true_0 T_est_0^-1``."""
    T_est, T_true = np.asarray(T_est, dtype=np.float64), np.asarray(T_true, dtype=np.float64)
    if alignment == "none":
        return T_est
    if alignment == "first":
        return T_true[0] @ inverse(T_est[0]) @ T_est
    return align(T_est[:, :3, 3], T_true[:, :3, 3], with_scale=alignment == "sim3").apply(T_est)


def ate(
    T_est: Float[np.ndarray, "n 4 4"], T_true: Float[np.ndarray, "n 4 4"], alignment: AlignmentName = "se3"
) -> PoseErrors:
    """``T_true_i^-1 A T_est_i``: the absolute error of associated poses after the alignment A."""
    return _errors(inverse(np.asarray(T_true, dtype=np.float64)) @ aligned(T_est, T_true, alignment))


def rpe(T_est: Float[np.ndarray, "n 4 4"], T_true: Float[np.ndarray, "n 4 4"], delta: int = 1) -> PoseErrors:
    """``(Q_i^-1 Q_i+delta)^-1 (P_i^-1 P_i+delta)``, P estimated, Q true: drift over ``delta`` frames, every i.

    It needs no alignment: a rigid motion of either trajectory cancels.

    Raises:
        InputError: ``delta`` < 1, or not more poses than ``delta``.
    """
    if not 1 <= delta < len(T_est):
        raise InputError("relative pose error", "delta", f"between 1 and {len(T_est) - 1} frames, not {delta}")
    P, Q = np.asarray(T_est, dtype=np.float64), np.asarray(T_true, dtype=np.float64)
    return _errors(inverse(inverse(Q[:-delta]) @ Q[delta:]) @ (inverse(P[:-delta]) @ P[delta:]))


def _errors(E: Float[np.ndarray, "n 4 4"]) -> PoseErrors:
    """Return translation length and rotation angle of error motions."""
    R = E[:, :3, :3]
    twice_sine = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=-1)
    # atan2 of sine and cosine keeps the digits near 0 that an arccos of the trace would lose.
    angle = np.arctan2(np.linalg.norm(twice_sine, axis=1), np.trace(R, axis1=1, axis2=2) - 1.0)
    return PoseErrors(np.linalg.norm(E[:, :3, 3], axis=1), np.degrees(angle))


def evaluate(
    times_est: Float[np.ndarray, "n"],
    T_est: Float[np.ndarray, "n 4 4"],
    times_true: Float[np.ndarray, "m"],
    T_true: Float[np.ndarray, "m 4 4"],
    tolerance: float = 0.01,
    deltas: tuple[int, ...] = (1, 30),
    alignments: tuple[AlignmentName, ...] = ("se3", "sim3", "first"),
) -> dict:
    """Associate, align and summarise, for ``vssm-gym evaluate-trajectory``.

    Returns:
        ``pairs``, ``tolerance_s``, and :class:`Statistics` as dicts: for each alignment ``ate_translation_{alignment}``
        (m) and ``ate_rotation_{alignment}`` (deg), and for each delta shorter than the trajectory
        ``rpe_translation_{delta}`` (m) and ``rpe_rotation_{delta}`` (deg). With ``sim3`` its ``scale`` too.

    Raises:
        InputError: no stamps within tolerance of each other, or too few poses to align.
    """
    of_est, of_true = associate(times_est, times_true, tolerance)
    if len(of_est) == 0:
        raise InputError("trajectory association", "times", f"stamps of both within {tolerance} s of each other")
    T_est, T_true = np.asarray(T_est)[of_est], np.asarray(T_true)[of_true]
    summaries = {}
    for alignment in alignments:
        absolute = ate(T_est, T_true, alignment)
        summaries[f"ate_translation_{alignment}"] = absolute.translation
        summaries[f"ate_rotation_{alignment}"] = absolute.rotation
    for delta in deltas:
        if delta < len(T_est):
            relative = rpe(T_est, T_true, delta)
            summaries[f"rpe_translation_{delta}"] = relative.translation
            summaries[f"rpe_rotation_{delta}"] = relative.rotation
    scale = {"scale": align(T_est[:, :3, 3], T_true[:, :3, 3], with_scale=True).scale} if "sim3" in alignments else {}
    statistics = {name: asdict(Statistics.of(errors)) for name, errors in summaries.items()}
    return {"pairs": len(of_est), "tolerance_s": tolerance, **scale, **statistics}
