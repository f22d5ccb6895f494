"""Compute SPL, SoftSPL and location errors of navigation episodes. Arrays broadcast; metres.

``geodesic`` is always the shortest path of the robot's footprint from the start to the *success region* (the disc of
radius 2b around the goal), from ``vssm_gym.envs.tasks.geodesic``, never from an agent's planner.
"""

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from vssm_gym.errors import InputError


def spl(success: ArrayLike, geodesic: ArrayLike, path_length: ArrayLike) -> Float[np.ndarray, "*batch"]:
    """``s l / max(p, l)``: success weighted by path length, in [0, s] (Anderson et al., 2018); its mean is the SPL.

    Args:
        success: 0 or 1, or booleans.
        geodesic: l > 0, shortest path from start to success region.
        path_length: p >= 0, path that the robot took, measured on its true positions.

    Raises:
        InputError: a geodesic that is not positive and finite, or a path length that is negative or not finite.
    """
    return np.asarray(success, dtype=np.float64) * _efficiency(geodesic, path_length)


def soft_spl(remaining: ArrayLike, geodesic: ArrayLike, path_length: ArrayLike) -> Float[np.ndarray, "*batch"]:
    """``max(0, 1 - r / l) l / max(p, l)``: SPL with the covered fraction of the distance in place of success.

    ``remaining`` r is the geodesic from the robot's last position to the success region (0 inside it, inf where it is
    out of reach), so that a successful episode has equal SoftSPL and SPL. Raises like :func:`spl`, and on r < 0.
    """
    remaining = np.asarray(remaining, dtype=np.float64)
    if np.any(~(remaining >= 0.0)):
        raise InputError("episode", "remaining", "a distance >= 0 m")
    efficiency = _efficiency(geodesic, path_length)
    return np.maximum(0.0, 1.0 - remaining / np.asarray(geodesic, dtype=np.float64)) * efficiency


def _efficiency(geodesic: ArrayLike, path_length: ArrayLike) -> Float[np.ndarray, "*batch"]:
    """``l / max(p, l)``, in (0, 1]."""
    shortest, taken = np.asarray(geodesic, dtype=np.float64), np.asarray(path_length, dtype=np.float64)
    if np.any(~(np.isfinite(shortest) & (shortest > 0.0))):
        raise InputError("episode", "geodesic", "a finite length > 0 m from start to success region")
    if np.any(~(np.isfinite(taken) & (taken >= 0.0))):
        raise InputError("episode", "path_length", "a finite length >= 0 m")
    return shortest / np.maximum(taken, shortest)


def path_length(positions: Float[np.ndarray, "time 2"]) -> float:
    """``sum_t |p_t+1 - p_t|``, metres."""
    return float(np.sum(np.linalg.norm(np.diff(positions, axis=0), axis=1)))


def episode_metrics(
    *,
    success: bool,
    geodesic: float,
    remaining: float,
    positions: Float[np.ndarray, "time 2"],
    goal: Float[np.ndarray, "2"],
    contacts: ArrayLike,
    estimates: Float[np.ndarray, "time 2"] | None = None,
) -> dict[str, float | int | bool | None]:
    """Compute the metrics of one episode under the names of a sweep's rows, as plain Python numbers.

    Args:
        success: the agent stopped within the success region.
        geodesic: shortest path from start to success region.
        remaining: shortest path from the last position to the success region.
        positions: true positions at reset and after every step.
        goal: the goal's xy.
        contacts: whether the robot was in collision, for each step.
        estimates: the agent's position estimates at the same times (NaN where it gave none), or None if it keeps none.

    Returns:
        ``success, spl, soft_spl, path_length, geodesic, steps, collisions`` (steps in contact), ``distance_to_goal``
        (straight line) and ``location_error_mean, _rmse, _max, _final`` (None without estimates).
    """
    taken = path_length(positions)
    row: dict[str, float | int | bool | None] = {
        "success": bool(success),
        "spl": float(spl(success, geodesic, taken)),
        "soft_spl": float(soft_spl(remaining, geodesic, taken)),
        "path_length": taken,
        "geodesic": float(geodesic),
        "steps": len(positions) - 1,
        "collisions": int(np.count_nonzero(contacts)),
        "distance_to_goal": float(np.linalg.norm(positions[-1] - goal)),
    }
    return row | location_errors(positions, estimates)


def location_errors(
    positions: Float[np.ndarray, "time 2"], estimates: Float[np.ndarray, "time 2"] | None
) -> dict[str, float | int | bool | None]:
    """Compute mean, RMSE, maximum and last of ``|p^_t - p_t|`` without alignment (the robot knows its start pose).

    Steps with a NaN estimate are left out; all are None where nothing is left.
    """
    names = ("location_error_mean", "location_error_rmse", "location_error_max", "location_error_final")
    if estimates is None:
        return dict.fromkeys(names)
    error = np.linalg.norm(np.asarray(estimates, dtype=np.float64) - positions, axis=1)
    error = error[np.isfinite(error)]
    if len(error) == 0:
        return dict.fromkeys(names)
    values = (np.mean(error), np.sqrt(np.mean(error**2)), np.max(error), error[-1])
    return {name: float(value) for name, value in zip(names, values, strict=True)}
