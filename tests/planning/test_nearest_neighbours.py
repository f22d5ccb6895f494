"""Test the estimates of entropy and information from samples: Gaussians and boxes of known ones, and the laws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vssm_gym.errors import InputError
from vssm_gym.planning.exploration.information.nearest_neighbours import knn_entropy, knn_information


def gaussian(seed: int, n: int, covariance: np.ndarray) -> jax.Array:
    rng = np.random.default_rng(seed)
    return jnp.asarray(rng.multivariate_normal(np.zeros(len(covariance)), covariance, n), jnp.float32)


@pytest.mark.parametrize("d", [1, 2, 4])
@pytest.mark.parametrize("k", [1, 3, 8])
def test_the_entropy_of_a_gaussian(d, k):
    A = np.random.default_rng(d).normal(size=(d, d)) + 2.0 * np.eye(d)
    exact = 0.5 * np.linalg.slogdet(2.0 * np.pi * np.e * A @ A.T)[1]
    assert float(knn_entropy(gaussian(0, 3000, A @ A.T), k)) == pytest.approx(exact, abs=0.1)


def test_the_entropy_of_a_box():
    samples = jnp.asarray(np.random.default_rng(0).uniform(0.0, [2.0, 0.5], (3000, 2)), jnp.float32)
    assert float(knn_entropy(samples)) == pytest.approx(np.log(1.0), abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.0, 0.6, 0.95])
def test_the_information_of_gaussians(rho):
    """``X = rho M + noise`` of unit variance: ``I = -1/2 log(1 - rho^2)``."""
    rng, n, maps = np.random.default_rng(1), 1500, 20
    of = lambda m, shape: rho * m + np.sqrt(1.0 - rho**2) * rng.normal(size=shape)
    marginal = of(rng.normal(size=(n, 1)), (n, 1))
    conditional = of(rng.normal(size=(maps, 1, 1)), (maps, n, 1))
    found = knn_information(jnp.asarray(marginal, jnp.float32), jnp.asarray(conditional, jnp.float32))
    assert float(found) == pytest.approx(-0.5 * np.log(1.0 - rho**2), abs=0.06)


@pytest.mark.slow
def test_the_information_of_many_observations_of_one_thing():
    """Sixteen readings of one number with noise of std s: ``I = 1/2 log(1 + 16 / s^2)``, from a thousand samples."""
    rng, n, maps, s = np.random.default_rng(2), 1000, 30, 0.5
    marginal = rng.normal(size=(n, 1)) + s * rng.normal(size=(n, 16))
    conditional = rng.normal(size=(maps, 1, 1)) + s * rng.normal(size=(maps, n, 16))
    found = float(knn_information(jnp.asarray(marginal, jnp.float32), jnp.asarray(conditional, jnp.float32)))
    exact = 0.5 * np.log(1.0 + 16.0 / s**2)
    assert exact - 0.1 < found < exact + 0.8  # the bias in 16 dimensions
    nearer = rng.normal(size=(n, 1)) + 2.0 * s * rng.normal(size=(n, 16))
    noisier = rng.normal(size=(maps, 1, 1)) + 2.0 * s * rng.normal(size=(maps, n, 16))
    less = float(knn_information(jnp.asarray(nearer, jnp.float32), jnp.asarray(noisier, jnp.float32)))
    assert less < found - 0.3  # the order of what is compared is kept


@settings(max_examples=20)
@given(st.floats(0.1, 10.0), st.floats(-50.0, 50.0), st.integers(0, 99))
def test_entropy_moves_with_scale_and_not_with_place(scale, offset, seed):
    """``H(a X + b) = H(X) + d log a``."""
    samples = gaussian(seed, 60, np.eye(3))
    moved = float(knn_entropy(scale * samples + offset))
    assert moved == pytest.approx(float(knn_entropy(samples)) + 3.0 * np.log(scale), abs=0.02)


def test_equal_samples_have_a_finite_entropy():
    assert np.isfinite(float(knn_entropy(jnp.ones((10, 2)))))


def test_what_cannot_be_compared_is_refused():
    with pytest.raises(InputError, match="k: expected between 1 and 3, one fewer than the samples; found 4"):
        knn_entropy(jnp.zeros((4, 2)), 4)
    with pytest.raises(InputError, match="conditional: expected"):
        knn_information(jnp.zeros((10, 2)), jnp.zeros((3, 9, 2)))
