"""Test calibration metrics: samples from the stated Gaussian are calibrated, others deviate as expected."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.stats import kstest

from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import inverse, se3_adjoint, se3_exp
from vssm_gym.slam.calibration import Calibration, fit_scale, nees, pose_residuals, segments, whiten

seeds = st.integers(0, 2**32 - 1)


def covariances(rng: np.random.Generator, n: int, d: int = 6) -> np.ndarray:
    """Return full covariances, different for each frame, with one axis far more certain than the rest."""
    A = rng.normal(size=(n, d, d)) * 10.0 ** rng.uniform(-4.0, -1.0, (n, d, 1))
    return A @ np.swapaxes(A, 1, 2) + 1e-12 * np.eye(d)


def samples(rng: np.random.Generator, S: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """Draw residuals whose true covariance is ``scale`` times the stated one."""
    return np.sqrt(scale) * np.einsum("nij,nj->ni", np.linalg.cholesky(S), rng.normal(size=S.shape[:2]))


def hat(delta: np.ndarray) -> np.ndarray:
    v, w = delta[:3], delta[3:]
    return np.array([[0, -w[2], w[1], v[0]], [w[2], 0, -w[0], v[1]], [-w[1], w[0], 0, v[2]], [0, 0, 0, 0.0]])


@given(seeds, st.sampled_from([1e-9, 1e-5, 1e-3, 0.1, 1.0]))
def test_the_residual_is_the_tangent_step_to_the_truth(seed: int, size: float) -> None:
    """``T_true = T_est exp(delta)`` with the matrix exponential, tiny and large steps alike."""
    rng = np.random.default_rng(seed)
    delta = size * rng.uniform(-1.5, 1.5, (4, 6))
    T_est = np.stack([expm(hat(rng.uniform(-1.5, 1.5, 6))) for _ in range(4)])
    T_true = T_est @ np.stack([expm(hat(d)) for d in delta])
    np.testing.assert_allclose(pose_residuals(T_est, T_true), delta, atol=1e-9 * max(1.0, size))


def test_the_residual_is_the_models_own_tangent() -> None:
    """The same order and side as ``geometry.se3_exp``, which the filter's covariances refer to."""
    with jax.enable_x64(True):
        delta = np.array([[0.1, -0.2, 0.3, 0.4, -0.5, 0.6]])
        T = np.asarray(se3_exp(jax.numpy.asarray(delta)))
        np.testing.assert_allclose(pose_residuals(np.eye(4)[None], T), delta, atol=1e-12)


@given(seeds)
def test_moving_both_trajectories_changes_nothing(seed: int) -> None:
    """A residual in another body frame, with its covariance transformed by the adjoint, has the same NEES too."""
    rng = np.random.default_rng(seed)
    T_est = np.stack([expm(hat(d)) for d in rng.uniform(-1, 1, (5, 6))])
    T_true = T_est @ np.stack([expm(hat(d)) for d in rng.uniform(-0.1, 0.1, (5, 6))])
    A, B = (expm(hat(d)) for d in rng.uniform(-2, 2, (2, 6)))
    e = pose_residuals(T_est, T_true)
    np.testing.assert_allclose(pose_residuals(A @ T_est, A @ T_true), e, atol=1e-9)
    S = covariances(rng, 5) + 1e-6 * np.eye(6)
    with jax.enable_x64(True):
        adjoint = np.asarray(se3_adjoint(jax.numpy.asarray(inverse(B))))
    moved = nees(pose_residuals(T_est @ B, T_true @ B), adjoint @ S @ adjoint.T)
    np.testing.assert_allclose(moved, nees(e, S), rtol=1e-5)


@given(seeds, st.integers(1, 12))
def test_nees_is_the_squared_mahalanobis_distance(seed: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    S = covariances(rng, 6, d) + 1e-4 * np.eye(d)
    e = rng.normal(size=(6, d))
    np.testing.assert_allclose(nees(e, S), [x @ np.linalg.solve(s, x) for x, s in zip(e, S, strict=True)], rtol=1e-7)


@pytest.mark.parametrize("d", [3, 6])
def test_samples_of_the_stated_gaussian_are_calibrated(d: int) -> None:
    """The mean NEES is d, whitened axes are standard normal, and the calibration curve is the diagonal."""
    rng = np.random.default_rng(0)
    S = covariances(rng, 5000, d)
    c = Calibration.of(samples(rng, S), S)
    assert c.nees.mean() == pytest.approx(d, rel=0.04)
    for axis in c.whitened.T:
        assert kstest(axis, "norm").pvalue > 1e-3
    np.testing.assert_allclose(np.cov(c.whitened.T), np.eye(d), atol=0.06)
    predicted, observed = c.curve()
    np.testing.assert_allclose(predicted, observed, atol=0.03)
    assert (np.diff(predicted) >= 0.0).all()
    summary = c.summary()
    assert summary["share_within_95"] == pytest.approx(0.95, abs=0.01)
    assert summary["gap"] < 0.02
    assert fit_scale({"all": c}) == pytest.approx(1.0, rel=0.04)


@pytest.mark.parametrize(("factor", "side"), [(4.0, -1.0), (0.25, 1.0)])
def test_the_curve_is_below_the_diagonal_for_overconfidence(factor: float, side: float) -> None:
    """Errors of four times the stated covariance put the curve below the diagonal, errors of a quarter above it."""
    rng = np.random.default_rng(1)
    S = covariances(rng, 3000)
    c = Calibration.of(samples(rng, S, factor), S)
    predicted, observed = c.curve()
    middle = (predicted > 0.1) & (predicted < 0.9)
    assert (side * (observed - predicted)[middle] > 0.05).all()
    assert np.sign(c.summary()["bias"]) == side
    assert c.summary()["nees_over_dimension"] == pytest.approx(factor, rel=0.06)


def test_the_scale_maximises_the_likelihood() -> None:
    rng = np.random.default_rng(2)
    S = covariances(rng, 800)
    runs = {name: Calibration.of(samples(rng, S, factor), S) for name, factor in {"a": 4.0, "b": 4.0, "c": 1.0}.items()}
    scale = fit_scale(runs)
    # Negative log-likelihood per frame and axis up to a constant: (ln s + NEES / (s d)) / 2
    cost = lambda s: np.log(s) + np.mean([c.nees.mean() / c.dimension for c in runs.values()]) / s
    assert all(cost(scale) <= cost(scale * f) for f in (0.9, 0.99, 1.01, 1.1))
    np.testing.assert_allclose(runs["a"].scaled(4.0).nees, runs["a"].nees / 4.0)


@given(seeds, st.floats(0.5, 6.0), st.integers(10, 200))
def test_segments_share_no_frame_and_last_as_long_as_asked(seed: int, seconds: float, frames: int) -> None:
    """Stamps of about 10 Hz; only the rest at the end, which is shorter than a segment, is in none."""
    rng = np.random.default_rng(seed)
    times = 3.0 + 0.1 * np.arange(frames) + rng.uniform(-0.02, 0.02, frames)
    cut = segments(times, seconds)
    chosen = [i for part in cut for i in range(part.start, part.stop)]
    assert chosen == list(range(len(chosen)))  # consecutive, each frame once
    for part in cut:
        assert seconds - 0.3 < times[part.stop - 1] - times[part.start] < seconds
    assert times[-1] - times[len(chosen) - 1] < seconds + 0.3


def test_a_run_of_whole_segments_is_used_up() -> None:
    """100 frames at 5 Hz are four segments of 5 s: the last frame lasts as long as the others."""
    assert segments(0.2 * np.arange(100), 5.0) == [slice(25 * i, 25 * (i + 1)) for i in range(4)]
    assert segments(0.2 * np.arange(99), 5.0) == [slice(25 * i, 25 * (i + 1)) for i in range(3)]
    assert segments(np.array([0.0, 0.2]), 5.0) == []


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0, 0.0])
def test_an_invalid_covariance_is_refused(bad: float) -> None:
    S = np.tile(np.eye(6), (3, 1, 1))
    S[1, 2, 2] = bad
    with pytest.raises(InputError, match="covariances"):
        whiten(np.ones((3, 6)), S)
    with pytest.raises(InputError, match="at least one frame"):
        fit_scale({})
