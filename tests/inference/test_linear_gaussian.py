"""Test the linear-Gaussian algebra against dense NumPy linear algebra in float64, and its laws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.inference.linear_gaussian import Gaussian, LinearGaussian, invert, joint, marginal, split

sizes = st.sampled_from([(1, 1), (3, 2), (6, 6)])  # few, since every size compiles again
seeds = st.integers(0, 2**32 - 1)


def spd(rng: np.random.Generator, n: int) -> np.ndarray:
    root = rng.normal(size=(n, n))
    return root @ root.T + 0.1 * np.eye(n)


def system(seed: int, n: int, m: int) -> tuple[np.ndarray, ...]:
    """Return ``mu, Sigma, A, a, S`` of float32 values, as float64."""
    rng = np.random.default_rng(seed)
    parts = rng.normal(size=n), spd(rng, n), rng.normal(size=(m, n)), rng.normal(size=m), spd(rng, m)
    return tuple(p.astype(np.float32).astype(float) for p in parts)


def model(mu, Sigma, A, a, S) -> tuple[Gaussian, LinearGaussian]:
    mu, Sigma, A, a, S = (jnp.asarray(p, jnp.float32) for p in (mu, Sigma, A, a, S))
    return Gaussian(mu, Sigma), LinearGaussian(A, a, S)


def dense_joint(mu, Sigma, A, a, S) -> tuple[np.ndarray, np.ndarray]:
    """Compute the joint from the precision of ``p(z) p(x | z)``, without the module's formulas."""
    P, Q = np.linalg.inv(Sigma), np.linalg.inv(S)
    precision = np.block([[P + A.T @ Q @ A, -A.T @ Q], [-Q @ A, Q]])
    information = np.concatenate([P @ mu - A.T @ Q @ a, Q @ a])
    covariance = np.linalg.inv(precision)
    return covariance @ information, covariance


def close(actual: jax.Array, expected: np.ndarray, tolerance: float = 2e-3) -> None:
    np.testing.assert_allclose(np.asarray(actual, float), expected, atol=tolerance * max(1.0, np.abs(expected).max()))


@given(seeds, sizes)
def test_the_joint_is_the_dense_product(seed: int, size: tuple[int, int]) -> None:
    n, m = size
    parts = system(seed, n, m)
    mean, covariance = dense_joint(*parts)
    whole = joint(*model(*parts))
    close(whole.mean, mean)
    close(whole.covariance, covariance)
    alone = marginal(*model(*parts))
    close(alone.mean, mean[n:])
    close(alone.covariance, covariance[n:, n:])


@given(seeds, sizes)
def test_the_inverse_conditional_is_the_dense_posterior(seed: int, size: tuple[int, int]) -> None:
    n, m = size
    mu, Sigma, A, a, S = system(seed, n, m)
    x = np.random.default_rng(seed + 1).normal(size=m)
    precision = np.linalg.inv(Sigma) + A.T @ np.linalg.inv(S) @ A
    covariance = np.linalg.inv(precision)
    mean = covariance @ (np.linalg.inv(Sigma) @ mu + A.T @ np.linalg.inv(S) @ (x - a))
    posterior = invert(*model(mu, Sigma, A, a, S)).given(jnp.asarray(x, jnp.float32))
    close(posterior.mean, mean, 1e-2)
    close(posterior.covariance, covariance)


@given(seeds, sizes)
def test_splitting_and_joining_are_inverse(seed: int, size: tuple[int, int]) -> None:
    n, m = size
    rng = np.random.default_rng(seed)
    p = Gaussian(jnp.asarray(rng.normal(size=n + m), jnp.float32), jnp.asarray(spd(rng, n + m), jnp.float32))
    again = joint(*split(p, n))
    close(again.mean, np.asarray(p.mean, float))
    close(again.covariance, np.asarray(p.covariance, float))


@given(seeds, sizes)
def test_bayes_rule_holds_both_ways(seed: int, size: tuple[int, int]) -> None:
    """``p(z) p(x | z) = p(x) p(z | x)`` as joints, the second one reordered."""
    n, m = size
    p_z, p_x_z = model(*system(seed, n, m))
    forward, backward = joint(p_z, p_x_z), joint(marginal(p_z, p_x_z), invert(p_z, p_x_z))
    order = np.r_[m : m + n, 0:m]
    close(backward.mean[order], np.asarray(forward.mean, float), 1e-2)
    close(backward.covariance[jnp.ix_(order, order)], np.asarray(forward.covariance, float), 1e-2)


def test_a_scalar_observation_by_hand() -> None:
    """Prior N(0, 4), x = z + N(0, 1), x = 5: gain 0.8, posterior N(4, 0.8)."""
    prior = Gaussian(jnp.zeros(1), jnp.full((1, 1), 4.0))
    posterior = invert(prior, LinearGaussian(jnp.eye(1), jnp.zeros(1), jnp.eye(1))).given(jnp.full(1, 5.0))
    np.testing.assert_allclose([posterior.mean[0], posterior.covariance[0, 0]], [4.0, 0.8], rtol=1e-6)


def test_an_exact_observation_leaves_no_variance() -> None:
    prior = Gaussian(jnp.zeros(2), jnp.array([[1.0, 0.5], [0.5, 2.0]]))
    exact = LinearGaussian(jnp.array([[1.0, 0.0]]), jnp.zeros(1), jnp.zeros((1, 1)))
    posterior = invert(prior, exact).given(jnp.array([3.0]))
    np.testing.assert_allclose(np.asarray(posterior.mean), [3.0, 1.5], atol=1e-6)
    np.testing.assert_allclose(np.asarray(posterior.covariance), [[0.0, 0.0], [0.0, 1.75]], atol=1e-6)


@pytest.mark.parametrize("spread", [1.0, 1e-3, 1e-6])
def test_conditionals_stay_positive_where_the_rest_is_nearly_determined(spread: float) -> None:
    """Float32 must not make variances negative when the pose noise vanishes."""
    rng = np.random.default_rng(3)
    A = rng.normal(size=(6, 6))
    prior = Gaussian(jnp.zeros(6), jnp.asarray(spd(rng, 6), jnp.float32))
    tight = LinearGaussian(jnp.asarray(A, jnp.float32), jnp.zeros(6), jnp.eye(6) * spread**2)
    covariance = np.asarray(invert(prior, tight).covariance, float)
    np.testing.assert_array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance).min() > -1e-9
