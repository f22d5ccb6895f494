"""Test the graph: against a closed form and a least-squares oracle, with a wrong loop, and without the library."""

import sys

import numpy as np
import pytest
from scipy.optimize import least_squares

from tests.eval.studies.scan_graph.optimisers import OPTIMISERS
from vssm_gym.errors import InputError
from vssm_gym.eval.studies.scan_graph.graph import Factor, PoseGraph
from vssm_gym.geometry.planar_poses import compose, relation

STEP = np.array([1.0, 0.0, np.pi / 2])
COVARIANCE = np.diag([0.01, 0.02, 0.005])


@pytest.mark.parametrize("command", OPTIMISERS)
def test_a_line_of_two_measurements_is_their_weighted_mean(command):
    """Along a line the posterior's mean is that of the weights, its variance the inverse of their sum."""
    with PoseGraph("test", command) as graph:
        graph.add(np.zeros(3))
        graph.add(np.array([1.0, 0.0, 0.0]))
        for x, variance in ((1.0, 0.04), (1.3, 0.01)):
            graph.connect([Factor(0, 1, np.array([x, 0.0, 0.0]), np.diag([variance] * 3))])
        graph.solve()
        np.testing.assert_allclose(graph.poses, [[0, 0, 0], [(25 * 1.0 + 100 * 1.3) / 125, 0, 0]], atol=1e-6)
        # A logarithm is linear in the places, and a little less so in the turn where measurements disagree
        np.testing.assert_allclose(graph.covariances([(0, 1)])[0], np.eye(3) / 125, rtol=0.01, atol=1e-8)
        assert graph.version


def squared(graph, factor):
    """Return the squared error of a factor at the graph's poses, in its covariance."""
    error = relation(factor.motion, relation(graph.poses[factor.a], graph.poses[factor.b]))
    return float(error @ np.linalg.solve(factor.covariance, error))


def square(closing):
    """Return the initial poses and the factors of a square driven with errors, and of its closing."""
    rng = np.random.default_rng(0)
    factors = [Factor(k, k + 1, STEP + rng.normal(size=3) * [0.05, 0.05, 0.03], COVARIANCE + 0.001) for k in range(7)]
    poses = [np.zeros(3)]
    for factor in factors:
        poses.append(compose(poses[-1], factor.motion))
    return np.array(poses), factors + closing


def built(graph, poses, factors):
    for pose in poses:
        graph.add(pose)
    graph.connect(factors)


def residuals(factors, poses):
    found = []
    for f in factors:
        error = relation(f.motion, relation(poses[f.a], poses[f.b]))
        found.append(np.linalg.solve(np.linalg.cholesky(f.covariance), error))
    return np.concatenate(found)


@pytest.mark.parametrize("command", OPTIMISERS)
def test_the_optimum_is_that_of_a_least_squares_oracle(command):
    """GTSAM's error is a logarithm, the oracle's a difference: for these errors they agree to a millimetre."""
    closing = [Factor(k, k + 4, np.zeros(3), 0.1 * COVARIANCE) for k in range(4)]
    poses, factors = square(closing)
    with PoseGraph("test", command) as graph:
        built(graph, poses, factors)
        before = sum(squared(graph, factor) for factor in factors)
        graph.solve()
        found, after = graph.poses, sum(squared(graph, factor) for factor in factors)
        covariance = graph.covariances([(1, 6), (0, 3)])
    solved = least_squares(
        lambda x: residuals(factors, np.vstack([np.zeros(3), x.reshape(-1, 3)])), poses[1:].ravel(), xtol=1e-12
    )
    oracle = np.vstack([np.zeros(3), solved.x.reshape(-1, 3)])
    assert np.abs(relation(oracle, found)).max() < 2e-3
    assert after < before and after == pytest.approx(2.0 * solved.cost, rel=0.02)
    np.testing.assert_allclose(covariance[1], _seen(solved, oracle, 0, 3), rtol=0.1, atol=2e-4)
    np.testing.assert_allclose(covariance[0], _seen(solved, oracle, 1, 6), rtol=0.1, atol=2e-4)


def _seen(solved, poses, a, b):
    """Return the covariance of b seen from a by finite differences of their relation."""
    total = np.linalg.inv(solved.jac.T @ solved.jac)
    flat, step = poses[1:].ravel(), 1e-6
    between = lambda x: relation(*np.vstack([np.zeros(3), x.reshape(-1, 3)])[[a, b]])
    J = np.stack([relation(between(flat), between(flat + step * e)) / step for e in np.eye(len(flat))], axis=1)
    return J @ total @ J.T


@pytest.mark.parametrize("command", OPTIMISERS)
def test_a_wrong_loop_changes_little_and_dropping_the_factors_drops_it(command):
    right = [Factor(k, k + 4, np.zeros(3), COVARIANCE, robust=True) for k in range(4)]
    wrong = Factor(0, 6, np.zeros(3), 1e-4 * np.eye(3), robust=True)
    poses, factors = square(right)
    with PoseGraph("test", command) as graph:
        built(graph, poses, factors)
        graph.solve()
        without = graph.poses
        graph.connect([wrong])
        graph.solve()
        assert np.abs(graph.poses - without)[:, :2].max() < 0.1
        assert squared(graph, wrong) > 1000.0
        graph.connect(factors, clear=True)
        graph.solve()
        np.testing.assert_allclose(relation(without, graph.poses), 0.0, atol=1e-3)


@pytest.mark.parametrize(
    "reason", ["raise ImportError('no wheel for this machine')", "raise OSError('no wheel for it')"]
)
def test_a_missing_library_is_one_clear_error(tmp_path, monkeypatch, reason):
    (tmp_path / "gtsam.py").write_text(reason)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(InputError, match=r"^slam2d: gtsam: expected GTSAM: pip install gtsam \(no wheel for") as caught:
        PoseGraph("slam2d").__enter__()
    assert "\n" not in str(caught.value)


def test_a_process_that_ends_early_is_one_clear_error():
    ends = "import sys; sys.stdin.readline(); print('{\"version\": \"0\"}', flush=True); sys.exit('out of memory')"
    with (
        pytest.raises(InputError, match=r"GTSAM's ended with exit code 1 after 0 requests \(out of memory\)"),
        PoseGraph("test", (sys.executable, "-c", ends)) as graph,
    ):
        assert graph.version == "0"
        graph.add(np.zeros(3))
