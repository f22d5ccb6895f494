"""Test the variational Gaussian: exact for a Gaussian, and the minimum of the divergence for another density."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vssm_gym.inference.alignment.variational import variational_gaussian


def test_a_gaussian_is_recovered():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    H, at = jnp.asarray(root @ root.T + np.eye(6), jnp.float32), jnp.asarray(rng.normal(size=6), jnp.float32)
    mean, covariance = variational_gaussian(lambda x: (H, H @ (x - at)), jnp.zeros(6), jnp.eye(6))
    np.testing.assert_allclose(mean, at, atol=1e-3)
    np.testing.assert_allclose(covariance @ H, np.eye(6), atol=1e-3)


def test_a_skewed_density_is_matched_on_average():
    """Cost ``exp(x) - x``: on the two points m +- s, ``exp(m) cosh(s) = 1 = 1 / s^2``; exact means give m = -1/2."""
    equations = lambda x: (jnp.exp(x)[None], jnp.exp(x) - 1.0)
    mean, covariance = variational_gaussian(equations, jnp.zeros(1), jnp.eye(1))
    assert float(mean[0]) == pytest.approx(-np.log(np.cosh(1.0)), abs=0.05)  # the MAP is at 0; six rounds
    assert float(covariance[0, 0]) == pytest.approx(1.0, abs=0.1)


def test_it_can_be_mapped_over_costs():
    found = jax.vmap(lambda h: variational_gaussian(lambda x: (h * jnp.eye(2), h * x), jnp.ones(2), jnp.eye(2))[1])
    np.testing.assert_allclose(found(jnp.array([1.0, 4.0]))[:, 0, 0], [1.0, 0.25], atol=1e-5)
