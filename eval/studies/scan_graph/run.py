"""Run scan matching with a pose graph on a log: track, close loops, and refine all poses in the end.

    tracking    each scan is matched to the newest keyframes, from the odometry and balanced with it, or searched for
                where it does not fit; one that has
                moved or turned enough becomes a keyframe, a node of the graph
    loops       every few keyframes those that see an older submap are matched to it, and the graph is optimised
    refinement  all keyframes are matched again to the submaps around them, made at the optimised poses, and optimised,
                twice; every other scan keeps its pose in the keyframe before it

The odometry's errors are taken to be those that our own filter takes (eq. M35).
"""

import time
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from vssm_gym.data.laser_logs import LaserLog
from vssm_gym.errors import InputError
from vssm_gym.eval.studies.scan_graph.clouds import Cloud, points_of
from vssm_gym.eval.studies.scan_graph.correlative import field, search
from vssm_gym.eval.studies.scan_graph.graph import Factor, PoseGraph
from vssm_gym.eval.studies.scan_graph.loops import LEAST_MATCHED, LoopSearch, match_covariance
from vssm_gym.eval.studies.scan_graph.matching import Match, match
from vssm_gym.eval.studies.scan_graph.submaps import SUBMAP, Submaps
from vssm_gym.geometry.planar_poses import compose, relation
from vssm_gym.progress import OnProgress
from vssm_gym.slam.planar_run import FLOOR_CELLS, FLOOR_TURN, SHARES

KEYFRAME = (5.0, 0.35)  # cells, rad: a scan that moved or turned so far from the last keyframe is one
LOST_SHARE = 0.5  # of a scan's points on the surface, below which it is searched for
LOST_WINDOW = (10.0, 0.6)  # cells, rad, of that search
SEARCHED_TOGETHER = 5  # keyframes whose loops are looked for at once
REFINEMENTS = 2  # of the refinement
AROUND = 15.0  # cells from a submap's nearest keyframe, within which a scan is matched to it again
MOST_AROUND = 8  # submaps that a keyframe is matched to in the refinement


@dataclass(frozen=True)
class ScanGraphRun:
    """Hold the outcome.

    Attributes:
        poses: x, y (m), heading (rad) at each scan, in the frame of the first, after the last optimisation.
        online: the same as it was known when the scan had come.
        keyframes: numbers of the scans that are nodes of the graph.
        loops: number of loops closed on the way.
        seconds: that it took.
        version: of GTSAM.
    """

    poses: Float[np.ndarray, "scans 3"]
    online: Float[np.ndarray, "scans 3"]
    keyframes: list[int]
    loops: int
    seconds: float
    version: str


def run_scan_graph(
    log: LaserLog, cell_size: float, max_range: float | None = None, on_progress: OnProgress | None = None
) -> ScanGraphRun:
    """Find the path of a log; its poses and loops are not read.

    Args:
        log: scans and odometry.
        cell_size: length that all others are in, m.
        max_range: m; farther readings are left out; None: those of the log.
        on_progress: called with ("scan graph", scans done, scans), then with ("refinement", rounds done, rounds).

    Raises:
        InputError: a range that is not above 0, a log of one scan, GTSAM is not installed, or its process died.
    """
    longest = log.max_range if max_range is None else min(max_range, log.max_range)
    if not longest > 0.0:
        raise InputError("slam2d", "max-range", f"above 0 m, not {longest:g}")
    if len(log) < 2:
        raise InputError("slam2d", "log", f"two scans or more; found {len(log)}")
    began = time.perf_counter()
    with PoseGraph("slam2d") as graph:
        drive = _Drive(log, cell_size, longest, graph)
        online = drive.track(on_progress)
        drive.refine(on_progress)
        poses = drive.placed()
    poses = relation(poses[:1], poses)
    return ScanGraphRun(poses, online, drive.keyframes, drive.loops.found, time.perf_counter() - began, graph.version)


class _Drive:
    """Hold what the stages of one run share."""

    def __init__(self, log: LaserLog, cell: float, max_range: float, graph: PoseGraph) -> None:
        self._log, self._cell, self._graph = log, cell, graph
        self._points = [points_of(log, scan, max_range) for scan in range(len(log))]
        self._submaps = Submaps(cell)
        self.loops = LoopSearch(self._submaps, graph)
        self.keyframes: list[int] = []
        self._chain: list[Factor] = []  # from each keyframe to the next
        self._from = np.zeros((len(log), 3))  # pose of each scan seen from the last keyframe before it
        self._node = np.zeros(len(log), int)

    def track(self, on_progress: OnProgress | None) -> Float[np.ndarray, "scans 3"]:
        """Track all scans, close loops, and return the poses as they were found."""
        graph, cell = self._graph, self._cell
        online = np.zeros((len(self._log), 3))
        self._keyframe(0, np.zeros(3), [])
        cloud, searched = self._submaps.newest(graph.poses), 0
        measured, spread = np.zeros(3), np.zeros((3, 3))  # by the odometry, since the keyframe
        at = np.zeros(3)
        floor, share = np.array([FLOOR_CELLS * cell, FLOOR_CELLS * cell, FLOOR_TURN]), np.array(SHARES)
        for scan, motion in enumerate(self._log.motions, 1):
            distance = float(np.hypot(motion[0], motion[1]))
            noise = (floor + share * [distance, distance, abs(motion[2])]) ** 2
            carry = _carried(motion)
            spread = carry @ spread @ carry.T + np.diag(noise)
            measured, start = compose(measured, motion), compose(at, motion)
            prior = np.linalg.inv(spread)
            found = match(cloud, self._points[scan], start, cell, (measured, prior))
            if found.share < LOST_SHARE and len(cloud.places):
                found = self._searched(cloud, scan, start, (measured, prior), found)
            at = found.pose
            self._node[scan], self._from[scan] = len(self.keyframes) - 1, at
            if np.hypot(at[0], at[1]) > KEYFRAME[0] * cell or abs(at[2]) > KEYFRAME[1] or scan == len(self._log) - 1:
                node = len(self.keyframes)
                covariance = match_covariance(found, cell, prior)
                step = Factor(node - 1, node, at, covariance)
                self._keyframe(scan, compose(graph.poses[-1], at), [step])
                self._chain.append(step)
                measured, spread, at = np.zeros(3), np.zeros((3, 3)), np.zeros(3)
                if len(self.keyframes) - searched >= SEARCHED_TOGETHER:
                    self._close(range(searched, len(self.keyframes)))
                    searched = len(self.keyframes)
                cloud = self._submaps.newest(graph.poses)
            online[scan] = compose(graph.poses[-1], at)
            if on_progress:
                on_progress("scan graph", scan, len(self._log) - 1)
        return online

    def refine(self, on_progress: OnProgress | None) -> None:
        """Match all keyframes to the submaps around them, and optimise, a few times."""
        for number in range(REFINEMENTS):
            self._submaps.forget()
            poses, factors = self._graph.poses, list(self._chain)
            for node in range(len(self.keyframes)):
                factors += [f for near in self._around(node, poses) if (f := self._again(node, near, poses))]
            self._graph.connect(factors, clear=True)
            self._graph.solve()
            if on_progress:
                on_progress("refinement", number + 1, REFINEMENTS)

    def placed(self) -> Float[np.ndarray, "scans 3"]:
        """Return the pose of every scan: a keyframe's own, or that found from the keyframe before it."""
        return compose(self._graph.poses[self._node], self._from)

    def _close(self, nodes: range) -> None:
        """Close the loops of several keyframes; a submap just completed is matched to by those before it too."""
        closed, newest = self.loops.close(nodes), len(self._submaps) - 1
        if newest > 0 and (newest + 1) * SUBMAP > nodes.start:
            before = range((newest - 1) * SUBMAP, newest * SUBMAP)
            closed += [f for node in before if (f := self._again(node, newest, self._graph.poses))]
        if closed:
            self._graph.connect(closed)
            self._graph.solve()

    def _searched(
        self, cloud: Cloud, scan: int, start: np.ndarray, prior: tuple[np.ndarray, np.ndarray], found: Match
    ) -> Match:
        """Return the match from the best pose of a window, or that found before where it has the larger share."""
        points, (width, turns) = self._points[scan], LOST_WINDOW
        if not len(points):
            return found
        peak = search(field(cloud, self._cell), points, start, self._cell, width * self._cell, turns)
        again = match(cloud, points, peak.pose, self._cell, prior)
        return again if again.share > found.share else found

    def _keyframe(self, scan: int, pose: np.ndarray, factors: list[Factor]) -> None:
        self._node[scan], self._from[scan] = self._graph.add(pose, factors), 0.0
        self.keyframes.append(scan)
        self._submaps.points.append(self._points[scan])

    def _around(self, node: int, poses: np.ndarray) -> list[int]:
        """Return the nearest submaps around a keyframe, without its own."""
        if not len(self._submaps):
            return []
        apart = self._submaps.distances(poses, poses[node, :2])
        nearest = [int(number) for number in np.argsort(apart) if number != node // SUBMAP]
        return [number for number in nearest[:MOST_AROUND] if apart[number] < AROUND * self._cell]

    def _again(self, node: int, number: int, poses: np.ndarray) -> Factor | None:
        anchor = self._submaps.anchor(number)
        start = relation(poses[anchor], poses[node])
        found = match(
            self._submaps.cloud(number, poses), self._points[self.keyframes[node]], start, self._cell, reach=2.0
        )
        if found.share < LEAST_MATCHED:
            return None
        return Factor(anchor, node, found.pose, match_covariance(found, self._cell), robust=True)


def _carried(motion: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the matrix that takes an error (forward, left, turn) over a motion into the frame after it."""
    c, s = np.cos(motion[2]), np.sin(motion[2])
    return np.array([[c, s, -c * motion[1] + s * motion[0]], [-s, c, s * motion[1] + c * motion[0]], [0.0, 0.0, 1.0]])
