"""Test the parts of the objective against float64, and the bound and the score by their laws."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from tests.helpers.dynamics.logs import circling
from tests.helpers.dynamics.transitions import random_transition
from vssm_gym.data.dynamics.log import cut
from vssm_gym.model.transition import RIGID, Imu
from vssm_gym.training.dynamics.fit import FitConfig, optimizer_for
from vssm_gym.training.dynamics.inverse_emission import new_inverse_emission
from vssm_gym.training.dynamics.objective import Model, _divergence, elbo, emission, fused, predictions
from vssm_gym.training.dynamics.windows import measure_scales, states_of, windows

DT = 0.1  # s


@pytest.fixture(scope="module")
def data():
    return windows([cut(circling(6.0), DT)], RIGID, 8, 5)


@pytest.fixture(scope="module")
def model():
    transition = random_transition(spread=0.05)
    return Model(transition, new_inverse_emission(jax.random.key(1), transition), jnp.full(2, -4.0))


def test_fusion_is_the_product_of_gaussians():
    rng = np.random.default_rng(0)
    s, m, r = rng.uniform(0.1, 2.0, 50), rng.normal(size=50), rng.uniform(0.1, 2.0, 50)
    mean, std = fused(*(jnp.asarray(a, jnp.float32) for a in (s, m, r)))
    variance = 1.0 / (1.0 / s**2 + 1.0 / r**2)
    np.testing.assert_allclose(mean, variance * m / r**2, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(std, np.sqrt(variance), rtol=1e-5)


def test_the_divergence_of_gaussians_is_their_mean_log_ratio():
    rng = np.random.default_rng(1)
    mean, std, prior = rng.normal(size=3), rng.uniform(0.3, 1.5, 3), rng.uniform(0.5, 2.0, 3)
    x = mean + std * rng.standard_normal((400_000, 3))
    ratio = stats.norm.logpdf(x, mean, std) - stats.norm.logpdf(x, 0.0, prior)
    found = _divergence(*(jnp.asarray(a, jnp.float32) for a in (mean, std, prior)))
    assert abs(float(found) - ratio.sum(axis=1).mean()) < 0.02


def test_the_emission_is_a_density_of_small_errors(model):
    """It is that of a Gaussian in the tangent, by scipy, where angles are small."""
    transition = model.transition
    xi = np.random.default_rng(2).normal(size=6) * 0.02
    z = transition.start(transition.nominal.manifold.resting(jnp.eye(4)))
    T = transition.nominal.manifold.pose(RIGID.perturb(z.body, jnp.asarray([*xi, *np.zeros(6)], jnp.float32)))
    expected = stats.norm.logpdf(xi, 0.0, np.exp(-4.0)).sum()
    assert float(emission(model, z, T)) == pytest.approx(expected, abs=0.02)


def test_windows_follow_each_other(data):
    steps = cut(circling(6.0), DT)
    states = states_of(steps, RIGID)
    np.testing.assert_array_equal(data.states.T_world_body[1], states.T_world_body[5:14])
    np.testing.assert_array_equal(data.controls[1], np.asarray(steps.controls[5:13], np.float32))


def test_scales_are_those_of_the_data(data):
    """The mean of the inputs, and the root mean square of the nominal errors, which an ideal IMU hardly has."""
    scales = measure_scales(Imu(), data, DT)
    assert scales.centre.shape == (15,)
    np.testing.assert_allclose(scales.centre[-6:], data.controls.mean(axis=(0, 1)), rtol=1e-5, atol=1e-6)
    assert float(scales.errors[:6].max()) < 0.02
    assert float(scales.step) == pytest.approx(DT)


def test_the_bound_prefers_the_right_noise_of_measured_poses(model, data):
    """Poses without error are likelier under an emission of decimetres than of metres."""
    at = lambda log_std: eqx.tree_at(lambda m: m.log_stds, model, jnp.full(2, log_std))
    bounds = [float(eqx.filter_jit(elbo)(at(log_std), data, jax.random.key(0), DT)) for log_std in (-1.0, 1.0, 3.0)]
    assert bounds[0] > bounds[1] > bounds[2]


def test_the_bound_knows_neither_place_nor_yaw(model, data):
    turn = np.eye(4)
    turn[:2, :2], turn[:3, 3] = [[0.0, -1.0], [1.0, 0.0]], [5.0, -3.0, 1.0]
    velocity = np.asarray(data.states.velocity).reshape(*data.states.velocity.shape[:-1], 2, 3) @ turn[:3, :3].T
    states = eqx.tree_at(
        lambda s: (s.T_world_body, s.velocity),
        data.states,
        (
            jnp.asarray(turn @ np.asarray(data.states.T_world_body), jnp.float32),
            jnp.asarray(velocity.reshape(data.states.velocity.shape), jnp.float32),
        ),
    )
    elsewhere = eqx.tree_at(lambda d: d.states, data, states)
    bounds = [float(eqx.filter_jit(elbo)(model, d, jax.random.key(0), DT)) for d in (data, elsewhere)]
    assert bounds[1] == pytest.approx(bounds[0], rel=1e-3)


def test_a_sure_and_right_prediction_scores_best(data):
    """Noise that is far too large, or a bias, costs."""
    right = random_transition(spread=0.0)
    louder = lambda gain: eqx.tree_at(
        lambda t: t.network.offset, right, right.network.offset.at[14:].set(jnp.log(gain))
    )
    score = lambda t: float(eqx.filter_jit(predictions)(t, data, jax.random.key(0), DT).score)
    assert score(louder(0.01)) < score(louder(0.5)) < score(louder(5.0))
    biased = eqx.tree_at(lambda t: t.network.offset, louder(0.01), louder(0.01).network.offset.at[6].add(20.0))
    assert score(biased) > 2.0 * score(louder(0.01))


def test_a_gradient_that_is_not_finite_changes_nothing():
    optimizer, start = optimizer_for(FitConfig(updates=10)), jnp.ones(3)
    state = optimizer.init(start)
    for _ in range(9):  # however often
        step, state = optimizer.update(jnp.array([1.0, jnp.nan, 0.0]), state, start)
        np.testing.assert_array_equal(step, 0.0)
    step, _ = optimizer.update(jnp.array([1.0, 1.0, 0.0]), state, start)
    assert (np.asarray(step[:2]) < 0.0).all()


def test_the_rate_falls_to_zero_and_gradients_are_bounded():
    """However large the gradient, the first step is the rate: Adam's is the gradient over its own size."""
    config = FitConfig(updates=20, rate=0.01)
    optimizer, start = optimizer_for(config), jnp.zeros(2)
    state, steps = optimizer.init(start), []
    for _ in range(config.updates):
        step, state = optimizer.update(jnp.array([1e6, 0.0]), state, start)
        steps.append(-float(step[0]))
    np.testing.assert_allclose(steps[0], config.rate, rtol=1e-3)
    assert steps == sorted(steps, reverse=True) and steps[-1] < 0.01 * config.rate
