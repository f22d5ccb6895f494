"""Run each method of SLAM on one traversal of a maze; the true poses of the drive judge and are read by no method."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from vssm_gym.data.laser_logs import LaserLog
from vssm_gym.data.strip_logs import StripLog
from vssm_gym.data.traversals import errors, traverse
from vssm_gym.envs.tasks.mazes import load_maze
from vssm_gym.eval.metrics.pose_calibration import pose_calibration
from vssm_gym.eval.studies.scan_graph.run import run_scan_graph
from vssm_gym.geometry.planar_poses import relation
from vssm_gym.slam.latent_run import run_latent, run_strips
from vssm_gym.slam.planar_run import run_scans

OCCUPANCY_CELL = 0.01  # m
SCAN_CHART_CELL = 0.0625  # m, of a latent grid of scans
STRIP_CHART_CELL = 0.1  # m, of one of strips
ERRORS_EVERY = 100  # steps between two errors of a row
FIRST_JUDGED = 10  # steps before which a covariance is that of the known start


@dataclass(frozen=True)
class Estimate:
    """Hold what a method has found."""

    poses: Float[np.ndarray, "scans 3"]  # x, y (m), heading (rad), from the first
    covariance: Float[np.ndarray, "scans 3 3"] | None = None  # of their errors: forward, left (m), turn (rad)
    seconds: float = 0.0


def _odometry(log: LaserLog, seed: int) -> Estimate:
    return Estimate(log.path())


def _occupancy(log: LaserLog, seed: int) -> Estimate:
    found = run_scans(log, OCCUPANCY_CELL)
    return Estimate(found.poses, found.covariance, found.seconds)


def _latent(passes: int) -> Callable[[LaserLog, int], Estimate]:
    def run(log: LaserLog, seed: int) -> Estimate:
        found = run_latent(log, SCAN_CHART_CELL, passes=passes, seed=seed)
        return Estimate(found.poses, found.covariance, found.seconds)

    return run


def _strips(log: StripLog, seed: int) -> Estimate:
    found = run_strips(log, STRIP_CHART_CELL, passes=1, seed=seed)
    return Estimate(found.poses, found.covariance, found.seconds)


def _graph(log: LaserLog, seed: int) -> Estimate:
    found = run_scan_graph(log, OCCUPANCY_CELL)
    return Estimate(found.poses, None, found.seconds)


METHODS: dict[str, Callable[[Any, int], Estimate]] = {
    "odometry": _odometry,
    "occupancy": _occupancy,
    "latent": _latent(0),
    "latent_offline": _latent(1),
    "strips_offline": _strips,
    "graph": _graph,  # it needs GTSAM
}
DRAWS_PARTICLES = ("latent", "latent_offline", "strips_offline")  # what a seed changes


def judged_run(
    method: str, maze: str, traversal: int, seed: int, steps: int, noise: str, sensor_noise: str
) -> dict[str, Any]:
    """Return the figures of one run: errors of the position (m), NEES over the dimension, seconds."""
    sensor = "camera" if method.startswith("strips") else "lidar"
    log = traverse(load_maze(maze), steps, traversal, noise, sensor_noise, sensor=sensor)  # type: ignore[call-overload]
    found = METHODS[method](log, seed)
    off = errors(log, found.poses)
    true = relation(log.poses[:1], log.poses)
    stated: dict[str, float | None] = {"nees": None, "in_95": None}
    if found.covariance is not None:
        later = slice(FIRST_JUDGED, None)
        stated = pose_calibration(found.poses[later], found.covariance[later], true[later])
    return {
        "end": float(off[-1]),
        "mean": float(off.mean()),
        "largest": float(off.max()),
        "errors": [round(float(v), 5) for v in off[::ERRORS_EVERY]],
        "nees": stated["nees"],
        "in_95": stated["in_95"],
        "seconds": round(found.seconds, 2),
    }
