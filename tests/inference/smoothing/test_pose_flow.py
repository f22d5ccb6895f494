"""Test the flow over a pose: chart, layers and density against autodiff in float64, integrals and Gaussians."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from vssm_gym.geometry.transforms import inverse, se3_exp
from vssm_gym.inference.smoothing.coupling import Couplings
from vssm_gym.inference.smoothing.families import TrajectoryBelief
from vssm_gym.inference.smoothing.pose_flow import PoseFlow
from vssm_gym.inference.smoothing.rotation_chart import LARGEST, from_rotation, log_volume, to_rotation
from vssm_gym.model.transition.belief import Belief, GaussianBelief
from vssm_gym.model.transition.manifold import POSES

NOMINAL = se3_exp(jnp.array([0.4, -0.7, 1.1, 0.3, -0.5, 0.9]))
POINTS = st.lists(st.floats(-2.5, 2.5, width=32), min_size=3, max_size=3)


def disturbed(tree, size: float, seed: int = 1):
    """Return parameters with noise, so that every layer does something."""
    leaves, structure = jax.tree.flatten(tree)
    keys = jax.random.split(jax.random.key(seed), len(leaves))
    return jax.tree.unflatten(
        structure, [leaf + size * jax.random.normal(k, leaf.shape) for k, leaf in zip(keys, leaves, strict=True)]
    )


def bent(std: float = 1.0, turn_std: float = 1.0) -> PoseFlow:
    """Return a flow far from a Gaussian."""
    plain = PoseFlow.around(jax.random.key(0), NOMINAL, std, turn_std)
    return eqx.tree_at(lambda q: q.nominal, disturbed(plain, 0.1), NOMINAL)


def as_float64(tree):
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf, np.float64)), tree)


@given(POINTS)
@settings(deadline=None, max_examples=50)
def test_the_chart_has_an_inverse(w):
    w = jnp.asarray(w, jnp.float32)
    np.testing.assert_allclose(from_rotation(to_rotation(w)), w, atol=2e-3)


def test_a_standard_normal_becomes_uniform():
    """Angle and axis of uniform rotations: ``P(angle <= a) = (a - sin a) / pi``, axes on the sphere."""
    R = np.asarray(to_rotation(jax.random.normal(jax.random.key(0), (20_000, 3))), float)
    angle = np.arccos(np.clip(0.5 * (np.trace(R, axis1=1, axis2=2) - 1.0), -1.0, 1.0))
    assert stats.kstest(angle, lambda a: (a - np.sin(a)) / np.pi).pvalue > 0.01
    for row, column in ((0, 0), (1, 2), (2, 1)):  # each entry of a uniform rotation is uniform
        assert stats.kstest(R[:, row, column], stats.uniform(-1.0, 2.0).cdf).pvalue > 0.01


@given(POINTS)
@settings(deadline=None, max_examples=20)
def test_the_volume_of_the_chart_is_its_jacobian(w):
    w = jnp.asarray(w, jnp.float32)
    np.testing.assert_allclose(log_volume(w), _turned_volume(w), atol=2e-3)


def _turned_volume(w):
    """Return ``log |R^T dR / dw|`` by automatic differentiation."""
    change = jnp.einsum("ji,jkn->ikn", to_rotation(w), jax.jacfwd(to_rotation)(w))
    return jnp.linalg.slogdet(jnp.stack([change[2, 1], change[0, 2], change[1, 0]]))[1]


def test_the_chart_is_smooth_where_nothing_turns():
    np.testing.assert_allclose(log_volume(jnp.zeros(3)), _turned_volume(jnp.zeros(3)), atol=1e-5)
    assert float(jnp.linalg.norm(from_rotation(jnp.eye(3)))) == 0.0
    assert np.isfinite(jax.jacrev(from_rotation)(jnp.eye(3))).all()


def test_beyond_the_table_a_rotation_stays_a_rotation():
    R = to_rotation(jnp.array([2.0 * LARGEST, 0.0, 0.0]))
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-6)
    assert abs(float(jnp.trace(R)) + 1.0) < 1e-6  # half a turn


def test_new_layers_are_the_identity():
    layers, x = Couplings.of(jax.random.key(0), 3, 2), jnp.array([0.3, -5.0, 2.0])
    y, log_det = layers.forward(x, jnp.array([0.2, 1.0]))
    np.testing.assert_allclose(y, x, atol=1e-5)
    assert abs(float(log_det)) < 1e-4


@jax.jit
def there_and_back(layers, x, context):
    """Compile once what all examples need."""
    y, log_det = layers.forward(x, context)
    back, again = layers.inverse(y, context)
    return back, jnp.stack([log_det, again]), jax.jacfwd(lambda x: layers.forward(x, context)[0])(x)


@given(st.lists(st.floats(-6.0, 6.0, width=32), min_size=3, max_size=3), st.integers(0, 5))
@settings(deadline=None, max_examples=40)
def test_layers_invert_and_state_their_jacobian(x, seed):
    with jax.enable_x64(True):
        layers = as_float64(disturbed(Couplings.of(jax.random.key(seed), 3, 1), 0.1, seed))
        x = jnp.asarray(x, jnp.float64)
        back, log_det, jacobian = there_and_back(layers, x, jnp.array([0.4]))
        np.testing.assert_allclose(back, x, atol=1e-8)
        np.testing.assert_allclose(log_det, np.linalg.slogdet(jacobian)[1], atol=1e-8)


def test_it_is_a_belief_and_a_family():
    assert isinstance(bent(), Belief)
    assert isinstance(bent(), TrajectoryBelief)


def test_a_draw_states_the_density_that_log_prob_finds():
    drawn = bent().sample_with_log_prob(jax.random.key(2), 2000)
    off = np.abs(np.asarray(bent().log_prob(drawn.poses) - drawn.log_prob))
    assert np.quantile(off, 0.99) < 1e-3
    assert off.max() < 0.05  # near half a turn single precision does not resolve the chart


@pytest.mark.slow
def test_the_density_is_the_change_of_variables():
    """``log q = log N(eps) - log |T^-1 dT / d eps|``, the Jacobian by automatic differentiation."""
    q = bent()
    for eps in np.random.default_rng(0).normal(size=(6, 6)).astype(np.float32):
        push = lambda e: q._push(e)[0]
        T = push(jnp.asarray(eps))
        change = jnp.einsum("ij,jkn->ikn", inverse(T), jax.jacfwd(push)(jnp.asarray(eps)))
        twist = jnp.stack([*change[:3, 3], change[2, 1], change[0, 2], change[1, 0]])
        expected = stats.norm.logpdf(eps).sum() - np.linalg.slogdet(np.asarray(twist, float))[1]
        np.testing.assert_allclose(q.log_prob(T), expected, atol=5e-3)


def test_the_density_integrates_to_one():
    """By importance: poses of a wider belief, ``E_p[q / p] = 1`` within 4 standard errors."""
    q, wide = bent(0.7), PoseFlow.around(jax.random.key(3), NOMINAL, 3.0)
    drawn = wide.sample_with_log_prob(jax.random.key(4), 60_000)
    ratio = np.exp(np.asarray(q.log_prob(drawn.poses) - drawn.log_prob, float))
    assert ratio.std() / np.sqrt(len(ratio)) < 0.05
    assert abs(ratio.mean() - 1.0) < 4.0 * ratio.std() / np.sqrt(len(ratio))


def test_it_starts_as_a_gaussian_position_and_any_rotation():
    q = PoseFlow.around(jax.random.key(0), NOMINAL, 2.0)
    T = POSES.perturb(NOMINAL, jnp.array([1.0, -2.0, 0.5, 0.4, 1.0, -2.0]))
    position = stats.norm(NOMINAL[:3, 3], 2.0).logpdf(np.asarray(T[:3, 3])).sum()
    np.testing.assert_allclose(q.log_prob(T), position - np.log(8.0 * np.pi**2), atol=1e-4)


def test_entropy_is_that_of_its_start():
    exact = np.log(8.0 * np.pi**2) + 3.0 * stats.norm(scale=2.0).entropy()
    q = PoseFlow.around(jax.random.key(0), NOMINAL, 2.0)
    np.testing.assert_allclose(q.entropy(), exact, atol=0.1)  # 3 standard errors of 4096 draws


def test_a_narrow_one_is_a_gaussian_in_the_tangent():
    """``w = xi / 1.711``: the chart's slope at zero, ``(2 sqrt(2 pi))^(1/3)``."""
    std, slope = 0.01, (2.0 * np.sqrt(2.0 * np.pi)) ** (1.0 / 3.0)
    q = PoseFlow.around(jax.random.key(0), NOMINAL, std, std / slope)
    gaussian = GaussianBelief(NOMINAL, std**2 * jnp.eye(6), POSES)
    poses = gaussian.sample(jax.random.key(1), 1000)
    np.testing.assert_allclose(q.log_prob(poses), gaussian.log_prob(poses), atol=0.05)


def test_no_draw_moves_the_nominal_pose():
    gradient = jax.grad(lambda q: q.sample_with_log_prob(jax.random.key(0), 8).log_prob.sum())(bent())
    assert not np.asarray(gradient.nominal).any()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_marginals_have_the_spread_of_the_draws():
    q = bent(0.1, 0.1)
    mean, covariance = q.marginals()
    xi = np.asarray(POSES.error(mean[0], q.sample(jax.random.key(7), 20_000)), float)
    np.testing.assert_allclose(covariance[0], xi.T @ xi / len(xi), atol=0.1 * float(jnp.trace(covariance[0])))


def test_no_draw_of_strong_layers_overflows():
    """Each layer scales by a function of what the last one has scaled: without a bound, twice an exponential."""
    layers = disturbed(Couplings.of(jax.random.key(0), 3, 0), 1.0)
    y, log_det = jax.jit(jax.vmap(lambda x: layers.forward(x, jnp.zeros(0))))(
        3.0 * jax.random.normal(jax.random.key(2), (4096, 3))
    )
    assert np.isfinite(y).all() and np.isfinite(log_det).all()
