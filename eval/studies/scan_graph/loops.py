"""Find loops: keyframes that see an older submap, and the checks that a match must pass.

    near      submaps within ``LOOP_CELLS`` cells and three standard deviations of the distance estimated
    matched   from the pose estimated where it is known well, otherwise by a search through three standard deviations
    checked   enough of the scan lies on the surface, no other pose fits as well, and the pose found is likely under the
              estimate's covariance
    agreed    what was found by a search counts only with another loop beside it: both must say the same of the motion
              between their keyframes

Standard deviations are those of the graph, ``DOUBT`` times as large: the factors are no independent measurements.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from vssm_gym.eval.studies.scan_graph.correlative import search
from vssm_gym.eval.studies.scan_graph.graph import Factor, PoseGraph
from vssm_gym.eval.studies.scan_graph.matching import Match, match
from vssm_gym.eval.studies.scan_graph.submaps import SUBMAP, TRACKED, Submaps
from vssm_gym.geometry.planar_poses import compose, relation

LOOP_CELLS = 15.0  # cells from a submap's nearest keyframe
DRIFT = 0.1  # of the way between two keyframes, the most that their distance may be off by
DOUBT = 2.0  # factor on standard deviations
MOST_LOOPS = 3  # submaps that a keyframe is matched to
SURELY = (4.0, 0.1)  # cells, rad: windows up to which a match begins at the pose estimated
WIDEST_SEARCH = (40.0, 0.6)  # cells, rad, of a search
LEAST_SCORE = 0.5  # of a search
LEAST_MATCHED = 0.65  # of the points on the surface
LIKELY = 16.0  # squared error in the covariance, three degrees of freedom: 0.1 % are larger
LOOP_FLOOR = (0.1, 0.002)  # cells, rad: what is added to a match's covariance
BLIND = (100.0, 1.0)  # cells, rad: covariance of a direction that the scan says nothing of
AGREES = (3.0, 0.05)  # cells, rad, between two loops' motions
BESIDE = 10  # keyframes between two loops that may agree


def match_covariance(
    found: Match, cell: float, prior: Float[np.ndarray, "3 3"] | None = None
) -> Float[np.ndarray, "3 3"]:
    """Return the covariance of a match's pose: of its readings, of the surface, and of what neither tells.

    Args:
        found: the match.
        cell: m.
        prior: information of what it was balanced with; None: it was not.
    """
    x, turn = BLIND
    total = found.information / DOUBT**2 + np.diag([(x * cell) ** -2, (x * cell) ** -2, turn**-2])
    if prior is not None:
        total += prior
    x, turn = LOOP_FLOOR
    return np.asarray(np.linalg.inv(total) + np.diag([(x * cell) ** 2, (x * cell) ** 2, turn**2]))


@dataclass
class LoopSearch:
    """Hold the loops and those that wait for another one to agree with.

    Attributes:
        submaps: what is matched to.
        graph: the nodes' poses and their covariance.
        found: number of loops accepted.
        refused: number of matches that failed a check.
    """

    submaps: Submaps
    graph: PoseGraph
    found: int = 0
    refused: int = 0
    _waiting: list[tuple[int, Factor]] = field(default_factory=list)

    def close(self, nodes: range) -> list[Factor]:
        """Return the loops of several consecutive keyframes."""
        near = [(node, number) for node in nodes for number in self._near(node)]
        covariances = self.graph.covariances([(self.submaps.anchor(number), node) for node, number in near])
        accepted: list[Factor] = []
        for (node, number), covariance in zip(near, covariances, strict=True):
            accepted += self._verified(node, number, DOUBT**2 * covariance)
        self.found += len(accepted)
        return accepted

    def _near(self, node: int) -> list[int]:
        """Return the nearest submaps that a keyframe may see, without those that it was tracked in."""
        poses, cell = self.graph.poses, self.submaps.cell
        known = min(len(self.submaps), (node - TRACKED) // SUBMAP)
        if known < 1:
            return []
        apart = self.submaps.distances(poses, poses[node, :2])[:known]
        steps = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
        way = steps[node] - steps[[self.submaps.anchor(number) for number in range(known)]]
        nearest = np.argsort(apart)[:MOST_LOOPS]
        return [int(number) for number in nearest if apart[number] < LOOP_CELLS * cell + DRIFT * way[number]]

    def _verified(self, node: int, number: int, covariance: np.ndarray) -> list[Factor]:
        """Return the loops that a match makes certain: none, its own, or also one that waited for it."""
        cell, poses = self.submaps.cell, self.graph.poses
        anchor = self.submaps.anchor(number)
        expected = relation(poses[anchor], poses[node])
        window = 3.0 * float(np.sqrt(max(covariance[0, 0], covariance[1, 1]))), 3.0 * float(np.sqrt(covariance[2, 2]))
        apart = float(self.submaps.distances(poses, poses[node, :2])[number])
        cloud = self.submaps.cloud(number, poses)
        if apart > LOOP_CELLS * cell + window[0] or not len(cloud.places):
            return []
        points = self.submaps.points[node]
        sure = window[0] <= SURELY[0] * cell and window[1] <= SURELY[1]
        if sure:
            found = match(cloud, points, expected, cell, (expected, np.linalg.inv(covariance)))
        else:
            limits = min(window[0], WIDEST_SEARCH[0] * cell), min(window[1], WIDEST_SEARCH[1])
            peak = search(self.submaps.likelihood(number, poses), points, expected, cell, *limits)
            if peak.score < LEAST_SCORE or peak.rival > 0.95 * peak.score:
                self.refused += 1
                return []
            found = match(cloud, points, peak.pose, cell, reach=3.0)
        error = relation(expected, found.pose)
        own = match_covariance(found, cell)
        if found.share < LEAST_MATCHED or error @ np.linalg.solve(covariance + own, error) > LIKELY:
            self.refused += 1
            return []
        loop = Factor(anchor, node, found.pose, own, robust=True)
        return [loop] if sure else self._agreed(number, loop)

    def _agreed(self, number: int, loop: Factor) -> list[Factor]:
        """Return a loop with those beside it that say the same; it waits where there is none."""
        self._waiting = [(at, other) for at, other in self._waiting if loop.b - other.b <= BESIDE]
        poses, limit = self.graph.poses, np.array(AGREES) * [self.submaps.cell, 1.0]
        agreeing = []
        for at, other in self._waiting:
            if at != number or other.b == loop.b:
                continue
            moved = relation(poses[other.b], poses[loop.b])
            error = relation(compose(other.motion, moved), loop.motion)
            if np.hypot(error[0], error[1]) < limit[0] and abs(error[2]) < limit[1]:
                agreeing.append((at, other))
        if not agreeing:
            self._waiting.append((number, loop))
            return []
        self._waiting = [row for row in self._waiting if row not in agreeing]
        return [loop, *(other for _, other in agreeing)]
