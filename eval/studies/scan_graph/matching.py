"""Match a scan to a surface: point-to-line ICP, and the information of its outcome.

    T = argmin sum_k rho((T p_k - m_k) . n_k / s_k) + the prior's |T' - T|^2,     m_k, n_k the surface nearest to T p_k

by Gauss-Newton in the tangent of T on its right, ``T exp(d)``, d = (forward, left, turn). ``rho`` is Cauchy's, and s_k
the surface's (:mod:`~vssm_gym.eval.studies.scan_graph.clouds`), with the noise found from the residuals. Surfaces that
face away are not met. The information is ``J^T W J`` at the optimum: of a corridor's scan it says nothing along the
corridor.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from vssm_gym.eval.studies.scan_graph.clouds import Cloud, Points, rotation
from vssm_gym.geometry.planar_poses import compose, relation

MATCH_STEPS = 20  # Gauss-Newton steps at most
MATCH_SETTLED = 1e-2  # cells, and hundredths of a rad, of the last step
LEAST_FACING = 0.1  # least cosine between a normal and the direction to the scanner
LEAST_NOISE = 0.1  # cells, standard deviation of a point about the surface
INLIER = 1.5  # cells from the surface
FEWEST_MATCHED = 8  # of a match
LAST_REACH = 2.5  # cells of the last association


@dataclass(frozen=True)
class Match:
    """Hold the outcome.

    Attributes:
        pose: of the scan's frame, in that of the surface.
        information: inverse covariance of its error (forward, left, turn), of the readings alone.
        share: of the points that lie on the surface.
        noise: robust standard deviation of those, m.
    """

    pose: Float[np.ndarray, "3"]
    information: Float[np.ndarray, "3 3"]
    share: float
    noise: float


def match(
    cloud: Cloud,
    points: Points,
    start: Float[np.ndarray, "3"],
    cell: float,
    prior: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]] | None = None,
    reach: float = 5.0,
) -> Match:
    """Match points to a surface from a start nearby.

    Args:
        cloud: the surface.
        points: of the scan, in its frame.
        start: pose of that frame.
        cell: length that all lengths of the method are in, m.
        prior: mean and information of the pose, that the outcome balances; None: none.
        reach: cells from a point to the surface, at first; it halves down to ``LAST_REACH``.
    """
    pose = np.array(start, float)
    none = Match(pose if prior is None else np.array(prior[0]), np.zeros((3, 3)), 0.0, np.inf)
    if len(points) < FEWEST_MATCHED or len(cloud.places) < FEWEST_MATCHED:
        return none
    scale = np.array([cell, cell, 0.01])
    data, noise, share = np.zeros((3, 3)), LEAST_NOISE * cell, 0.0
    for _ in range(MATCH_STEPS):
        turn = rotation(pose[2])
        at = points.places @ turn.T + pose[:2]
        apart, nearest = cloud.tree.query(at, distance_upper_bound=reach * cell)
        met = np.isfinite(apart)
        met[met] &= (cloud.normals[nearest[met]] * (points.views[met] @ turn.T)).sum(axis=1) > LEAST_FACING
        if met.sum() < FEWEST_MATCHED:
            return none
        k, p = nearest[met], points.places[met]
        n, away = cloud.normals[k], at[met] - cloud.places[k]
        residual = (away * n).sum(axis=1)
        along = (away**2).sum(axis=1) - residual**2
        widened = 1.0 + (1.0 + along / cloud.spread[k]) / cloud.mass[k]
        across = n @ turn
        J = np.column_stack([across, across[:, 1] * p[:, 0] - across[:, 0] * p[:, 1]])
        noise = max(LEAST_NOISE * cell, 1.4826 * _median(np.abs(residual) / np.sqrt(widened)))
        variance = widened * noise**2
        weight = 1.0 / (1.0 + 0.25 * residual**2 / variance) / variance
        share = float((np.abs(residual) < INLIER * cell).sum()) / len(points)
        data = (J * weight[:, None]).T @ J
        gradient, total = -(J * weight[:, None]).T @ residual, data.copy()
        if prior is not None:
            mean, information = prior
            gradient += information @ relation(pose, mean)
            total += information
        total += np.diag(1e-6 / scale**2)  # a direction that nothing tells stays as it is
        step = np.linalg.solve(total, gradient)
        pose = compose(pose, np.clip(step, -3.0 * reach * scale, 3.0 * reach * scale))
        if np.all(np.abs(step) < MATCH_SETTLED * scale) and reach <= LAST_REACH:
            break
        reach = max(0.7 * reach, LAST_REACH)
    return Match(pose, data, share, noise)


def _median(values: np.ndarray) -> float:
    """Return the upper median, which costs a tenth of NumPy's."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])
