"""Test families of trajectories: their covariances and entropies against dense matrices in float64."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from tests.inference.smoothing.line_motion import LINE
from vssm_gym.geometry.transforms import se3_exp
from vssm_gym.inference.smoothing.families import Chain, MeanField, TrajectoryBelief
from vssm_gym.model.transition import PLANAR, RIGID
from vssm_gym.model.transition.belief import GaussianBelief
from vssm_gym.model.transition.manifold import RigidState

TIME, SAMPLES = 4, 40_000
FAMILIES = (MeanField, Chain)


def planar_means() -> jax.Array:
    return jnp.asarray(np.random.default_rng(0).uniform(-1.0, 1.0, (TIME, 3)), jnp.float32)


def planar_std() -> jax.Array:
    return jnp.asarray(np.random.default_rng(1).uniform(0.05, 0.3, (TIME, 3)), jnp.float32)


@pytest.fixture(scope="module")
def chain() -> Chain:
    """Return a chain with correlations of every kind."""
    rng = np.random.default_rng(2)
    within, below = rng.normal(0.0, 0.5, (TIME, 3, 3)), rng.normal(0.0, 0.5, (TIME - 1, 3, 3))
    plain = Chain.around(planar_means(), planar_std(), PLANAR)
    blocks = (jnp.asarray(within, jnp.float32), jnp.asarray(below, jnp.float32))
    return eqx.tree_at(lambda q: (q.within, q.below), plain, blocks)


def dense_root(q: Chain) -> np.ndarray:
    """Return ``L`` in float64."""
    time, n = q.log_std.shape
    precision = np.exp(-np.asarray(q.log_std, float))
    L = np.zeros((time, n, time, n))
    for t in range(time):
        L[t, :, t] = precision[t][:, None] * (np.eye(n) + np.tril(np.asarray(q.within[t], float), -1))
        if t:
            L[t, :, t - 1] = precision[t][:, None] * np.asarray(q.below[t - 1], float)
    return L.reshape(time * n, time * n)


@pytest.fixture(scope="module")
def errors(chain: Chain) -> np.ndarray:
    """Return the errors of many draws, ``(samples, time * n)``."""
    drawn = chain.draw(jax.random.key(0), SAMPLES)
    return np.asarray(PLANAR.error(planar_means(), drawn.states), float).reshape(SAMPLES, -1)


def test_marginals_are_blocks_of_the_dense_inverse(chain: Chain) -> None:
    L = dense_root(chain)
    covariance = np.linalg.inv(L @ L.T)
    found = chain.marginals()
    for t in range(TIME):
        block = slice(3 * t, 3 * t + 3)
        np.testing.assert_allclose(found.covariance[t], covariance[block, block], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(found.mean, planar_means(), atol=1e-6)


def test_draws_have_the_covariance_of_the_dense_inverse(chain: Chain, errors: np.ndarray) -> None:
    """Whitened by the dense factor they are standard normal: every entry within 5 standard errors."""
    white = errors @ dense_root(chain)
    assert np.abs(white.mean(axis=0)).max() < 5.0 / np.sqrt(SAMPLES)
    off = white.T @ white / SAMPLES - np.eye(white.shape[1])
    assert np.abs(off).max() < 5.0 * np.sqrt(2.0 / SAMPLES)


def test_the_entropy_is_that_of_the_dense_gaussian_on_the_manifold(chain: Chain, errors: np.ndarray) -> None:
    """``E[-log q]`` with respect to the volume of SE(2): that of the errors plus the mean log volume."""
    L = dense_root(chain)
    gaussian = stats.multivariate_normal(np.zeros(len(L)), np.linalg.inv(L @ L.T)).entropy()
    a = errors.reshape(SAMPLES, TIME, 3)[..., 2]
    volume = np.log(2.0 * (1.0 - np.cos(a)) / a**2).sum(axis=1)
    found = np.asarray(chain.draw(jax.random.key(0), SAMPLES).entropy, float).sum(axis=1)
    np.testing.assert_allclose(found, gaussian + volume, atol=1e-3)
    assert volume.mean() < -0.01


def test_the_entropy_of_independent_steps_is_minus_their_log_density() -> None:
    """Against the beliefs over single states, whose density on the manifold is tested for itself."""
    q = MeanField.around(planar_means(), 3.0 * planar_std(), PLANAR)
    drawn, marginals = q.draw(jax.random.key(1), SAMPLES), q.marginals()
    for t in range(TIME):
        belief = GaussianBelief(marginals.mean[t], marginals.covariance[t], PLANAR)
        difference = np.asarray(drawn.entropy[:, t] + belief.log_prob(drawn.states[:, t]), float)
        assert abs(difference.mean()) < 5.0 * difference.std() / np.sqrt(SAMPLES)


def test_a_chain_without_correlations_is_the_mean_field() -> None:
    mean_field, chain = (family.around(planar_means(), planar_std(), PLANAR) for family in FAMILIES)
    key = jax.random.key(3)
    for a, b in zip(jax.tree.leaves(mean_field.draw(key, 7)), jax.tree.leaves(chain.draw(key, 7)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
    for a, b in zip(mean_field.marginals(), chain.marginals(), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("family", FAMILIES)
def test_draws_are_reparameterised(family: type[MeanField | Chain]) -> None:
    """On a line ``dz / d mean = 1`` and ``dz / d log std = z - mean``; nominal states are not free."""
    q = family.around(jnp.zeros((TIME, 2)), jnp.full((TIME, 2), 0.3), LINE)
    key = jax.random.key(4)
    g = jax.grad(lambda q: q.draw(key, 1).states[0, 1, 0])(q)
    assert float(g.offset[1, 0]) == pytest.approx(1.0)
    assert float(g.log_std[1, 0]) == pytest.approx(float(q.draw(key, 1).states[0, 1, 0]), rel=1e-5)
    assert not np.any(g.nominal)


@pytest.mark.parametrize("family", FAMILIES)
def test_families_carry_rigid_motions(family: type[MeanField | Chain]) -> None:
    """Poses stay rotations and means follow the offsets in the body frame."""
    T = se3_exp(jnp.asarray(np.random.default_rng(5).normal(size=(TIME, 6)), jnp.float32))
    q = family.around(RigidState(T, jnp.zeros((TIME, 6))), jnp.full((TIME, 12), 0.1), RIGID)
    assert isinstance(q, TrajectoryBelief)
    moved = eqx.tree_at(lambda q: q.offset, q, q.offset.at[2, 0].set(0.5))
    drawn = moved.draw(jax.random.key(6), 5)
    R = drawn.states.T_world_body[..., :3, :3]
    np.testing.assert_allclose(R @ jnp.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-5)
    assert drawn.states.velocity.shape == (5, TIME, 6) and drawn.entropy.shape == (5, TIME)
    step = moved.marginals().mean.T_world_body[2, :3, 3] - T[2, :3, 3]
    np.testing.assert_allclose(step, 0.5 * T[2, :3, 0], atol=1e-5)
