"""Test the Huber density against scipy's, and that its slope is bounded."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import huber

from vssm_gym.model.huber import huber_log_prob


@pytest.mark.parametrize("elbow", [0.5, 2.0, 4.0])
def test_it_is_the_loss_of_the_standardised_residual(elbow):
    residual, variance = np.meshgrid(np.linspace(-3.0, 3.0, 41), np.array([0.04, 1.0, 9.0]))
    std = np.sqrt(variance)
    expected = -huber(elbow, residual / std) - np.log(std)
    found = huber_log_prob(jnp.asarray(residual, jnp.float32), jnp.asarray(variance, jnp.float32), elbow)
    np.testing.assert_allclose(found, expected, rtol=2e-5, atol=2e-5)


def test_far_residuals_pull_no_more_than_those_at_the_elbow():
    far = jnp.array([-50.0, 0.1, 1.0, 50.0])
    slope = jax.vmap(jax.grad(huber_log_prob), in_axes=(0, 0, None))(far, jnp.full(4, 0.25), 2.0)
    np.testing.assert_allclose(slope, [4.0, -0.4, -4.0, -4.0], rtol=1e-5)
