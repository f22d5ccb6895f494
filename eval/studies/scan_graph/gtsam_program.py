"""Optimise a graph of planar poses as a program of its own; the only module that imports GTSAM.

    python -m vssm_gym.eval.studies.scan_graph.gtsam_program

    X* = argmin sum_f rho(|log(Z_f^-1 X_a^-1 X_b)|^2 in the covariance of f),     X_0 held at its first value

by Levenberg-Marquardt on a factor graph; ``rho`` is Cauchy's for factors that may be wrong. On standard input it takes
one line of JSON for each request, and answers with one. First ``version`` or an ``error``. Then, each field optional:

    clear   drop all factors
    poses   x, y, heading of further nodes (they are numbered)
    factors a, b, pose of b seen from a, covariance (xx, xy, xt, yy, yt, tt; in the frame of b), whether it is robust
    solve   optimise; the answer has ``poses``, of all nodes
    pairs   a, b: the answer has ``covariances`` of b's error as seen from a, likewise (9 numbers each)

The other end is :mod:`vssm_gym.eval.studies.scan_graph.graph`.
"""

import importlib
import json
import os
import sys
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

HOW_GTSAM = "GTSAM: pip install gtsam"
GAUGE = 1e-6  # m, rad: standard deviation of the first node
CAUCHY = 2.0  # standard deviations, beyond which a robust factor loses weight
ITERATIONS = 30  # of Levenberg-Marquardt at most
STEADY = 1e-6  # relative change of the cost, that ends it


class Optimiser:
    """Hold the graph; raises ImportError or OSError where GTSAM is not installed."""

    def __init__(self) -> None:
        gtsam: Any = importlib.import_module("gtsam")  # not part of any extra: types may be there or not
        self._gtsam, self._values = gtsam, gtsam.Values()
        try:
            self.version = version("gtsam")
        except PackageNotFoundError:  # built from source, without a distribution
            self.version = ""
        self._clear()

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """Do what a request asks for."""
        gtsam, given = self._gtsam, {}
        if request.get("clear"):
            self._clear()
        for pose in request.get("poses", ()):
            node = self._values.size()
            self._values.insert(node, gtsam.Pose2(*pose))
            if node == 0:
                self._hold()
        for a, b, x, y, turn, *covariance, robust in request.get("factors", ()):
            noise = gtsam.noiseModel.Gaussian.Covariance(_symmetric(covariance))
            if robust:
                noise = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(CAUCHY), noise)
            self._graph.add(gtsam.BetweenFactorPose2(int(a), int(b), gtsam.Pose2(x, y, turn), noise))
        if request.get("solve"):
            parameters = gtsam.LevenbergMarquardtParams()
            parameters.setMaxIterations(ITERATIONS)
            parameters.setRelativeErrorTol(STEADY)
            self._values = gtsam.LevenbergMarquardtOptimizer(self._graph, self._values, parameters).optimize()
            poses = [self._values.atPose2(node) for node in range(self._values.size())]
            given["poses"] = [[pose.x(), pose.y(), pose.theta()] for pose in poses]
        if pairs := request.get("pairs"):
            marginals = gtsam.Marginals(self._graph, self._values)
            given["covariances"] = [self._between(marginals, a, b).ravel().tolist() for a, b in pairs]
        return given

    def _clear(self) -> None:
        self._graph = self._gtsam.NonlinearFactorGraph()
        if self._values.size():
            self._hold()

    def _hold(self) -> None:
        noise = self._gtsam.noiseModel.Isotropic.Sigma(3, GAUGE)
        self._graph.add(self._gtsam.PriorFactorPose2(0, self._values.atPose2(0), noise))

    def _between(self, marginals: Any, a: int, b: int) -> np.ndarray:
        """Return the covariance of b seen from a: the error of b, less that of a carried over to it."""
        joint = marginals.jointMarginalCovariance([a, b])
        carry = self._values.atPose2(b).between(self._values.atPose2(a)).AdjointMap()
        aa, ab, bb = joint.at(a, a), joint.at(a, b), joint.at(b, b)
        return np.asarray(bb - carry @ ab - (carry @ ab).T + carry @ aa @ carry.T)


def _symmetric(upper: list[float]) -> np.ndarray:
    xx, xy, xt, yy, yt, tt = upper
    return np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]])


def main() -> None:
    """Answer requests until the input ends; see the module."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # the library's own output must not mix with answers
    sys.stdin.readline()
    try:
        optimiser = Optimiser()
    except (ImportError, OSError) as reason:
        print(json.dumps({"error": f"{HOW_GTSAM} ({str(reason).splitlines()[0]})"}), file=answers, flush=True)
        return
    print(json.dumps({"version": optimiser.version}), file=answers, flush=True)
    for line in sys.stdin:
        print(json.dumps(optimiser.answer(json.loads(line))), file=answers, flush=True)


if __name__ == "__main__":
    main()
