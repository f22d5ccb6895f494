"""Test the fit of a pose's posterior: Gaussians are recovered, two modes are kept, undefined densities do no harm."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.inference.smoothing.test_pose_flow import NOMINAL
from vssm_gym.errors import InputError
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import se3_exp
from vssm_gym.inference.filter import Rig
from vssm_gym.inference.smoothing.families import Chain, MeanField
from vssm_gym.inference.smoothing.pose_flow import PoseFlow
from vssm_gym.inference.smoothing.pose_posterior import (
    NO_WEIGHT,
    FitConfig,
    View,
    approach,
    bound,
    climb,
    effective_share,
    fit,
    weigh,
)
from vssm_gym.inference.smoothing.start_beliefs import START_REACH, start_beliefs
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model import emission
from vssm_gym.model.transition.belief import GaussianBelief
from vssm_gym.model.transition.manifold import POSES

STD = jnp.array([0.02, 0.04, 0.03, 0.05, 0.02, 0.03])  # m, rad
TURN_SLOPE = (2.0 * np.sqrt(2.0 * np.pi)) ** (1.0 / 3.0)  # rad of a unit of the chart near zero
FAR = se3_exp(jnp.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.5])) @ se3_exp(jnp.array([1.5, 0.0, 0.0, 0.0, 0.0, 0.0]))


class Humps(eqx.Module):
    """``log sum_k N(log(T_k^-1 T); 0, covariance)``: a likelihood with a mode at each pose."""

    T: jax.Array
    covariance: jax.Array
    factor: jax.Array = eqx.field(default_factory=lambda: jnp.ones(()))

    def log_prob(self, T):
        one = lambda mean: GaussianBelief(mean, self.factor**2 * self.covariance, POSES).log_prob(T)
        return jax.scipy.special.logsumexp(jax.vmap(one)(self.T)) - jnp.log(len(self.T))

    def widened(self, factor):
        return Humps(self.T, self.covariance, factor)


class Undefined(eqx.Module):
    """Give no density to poses beyond a plane: zero behind it, undefined near it."""

    humps: Humps
    x: jax.Array

    def log_prob(self, T):
        beyond = T[0, 3] - self.x
        none = jnp.where(beyond > 0.05, -jnp.inf, jnp.nan)
        return jnp.where(beyond > 0.0, none, self.humps.log_prob(T))

    def widened(self, factor):
        return Undefined(self.humps.widened(factor), self.x)


class Flat(eqx.Module):
    """``log p(z) = 0`` everywhere: what is left of a posterior is its likelihood."""

    def log_prob(self, state):
        return jnp.zeros(state.shape[:-2])


def correlated() -> jax.Array:
    rng = np.random.default_rng(0)
    root = np.asarray(STD)[:, None] * (np.eye(6) + 0.3 * np.tril(rng.normal(size=(6, 6)), -1))
    return jnp.asarray(root @ root.T, jnp.float32)


@pytest.mark.parametrize("family", [MeanField, Chain])
def test_the_bound_of_the_posterior_itself_is_the_evidence(family):
    """``q = p(z | x)``: no draw differs from the evidence, here 0."""
    q = family.around(NOMINAL[None], STD[None], POSES)
    target = Humps(NOMINAL[None], jnp.diag(STD**2))
    assert abs(float(bound(jax.random.key(0), q, Flat(), target, 2000))) < 0.1  # the entropy of errors has a noise


def test_the_bound_of_a_flow_is_below_the_evidence():
    q = PoseFlow.around(jax.random.key(0), NOMINAL, 0.05, 0.05 / TURN_SLOPE)
    target = Humps(NOMINAL[None], jnp.diag(STD**2))
    found = weigh(jax.random.key(1), q, Flat(), target, 20_000)
    evidence = float(jax.scipy.special.logsumexp(found.log_weight)) - np.log(20_000)
    assert abs(evidence) < 0.1  # importance sampling: the density integrates to one
    assert float(jnp.mean(found.log_weight)) < -0.3


def test_the_gradient_is_that_of_the_mean():
    """The reparameterised gradient is the slope of the estimate with the same draws."""
    q = PoseFlow.around(jax.random.key(0), NOMINAL, 0.05, 0.05 / TURN_SLOPE)
    target, keys = Humps(NOMINAL[None], correlated()), jax.random.split(jax.random.key(1), 8)
    moved = lambda x: eqx.tree_at(lambda q: (q.place, q.turn_scale), q, (q.place.at[0].add(x), q.turn_scale + x))
    mean = jax.jit(lambda x: jnp.mean(jax.vmap(lambda k: bound(k, moved(x), Flat(), target, 256))(keys)))
    slope = (float(mean(1e-2)) - float(mean(-1e-2))) / 2e-2
    assert float(jax.grad(mean)(0.0)) == pytest.approx(slope, rel=0.03)


def test_weights_that_are_alike_leave_all_draws():
    assert float(effective_share(jnp.full(10, -3.0))) == pytest.approx(1.0)
    assert float(effective_share(jnp.array([0.0, -1e9, -1e9, -1e9]))) == pytest.approx(0.25)


def undefined_beyond(x: float) -> Undefined:
    return Undefined(Humps(jnp.stack([NOMINAL, NOMINAL @ FAR]), jnp.diag(STD**2)), jnp.float32(x))


def test_a_draw_without_a_density_has_no_part():
    """Half of the draws have none; then all, some of which overflow."""
    q = PoseFlow.around(jax.random.key(0), NOMINAL, 0.05, 0.05 / TURN_SLOPE)
    x = float(NOMINAL[0, 3])
    found = weigh(jax.random.key(1), q, Flat(), undefined_beyond(x), 2048)
    without = np.asarray(found.log_weight) == NO_WEIGHT
    assert 0.4 < without.mean() < 0.6
    assert all(np.isfinite(value).all() for value in found)
    np.testing.assert_allclose(jax.nn.softmax(found.log_weight)[without], 0.0)
    far = eqx.tree_at(lambda q: q.place_scale, q, q.place_scale.at[0, 0].set(88.5))  # exp(88.5) times 2.4 overflows
    overflown = weigh(jax.random.key(1), far, Flat(), undefined_beyond(x), 2048)
    assert all(np.isfinite(value).all() for value in overflown)


@pytest.mark.slow
def test_rounds_without_a_density_change_nothing():
    """The density is defined in a ball that few draws reach: they alone count; where none does, ``fit`` says so."""
    q = PoseFlow.around(jax.random.key(0), NOMINAL, 1.5)
    far = Undefined(Humps(NOMINAL[None], jnp.diag(STD**2)), jnp.float32(NOMINAL[0, 3] - 99.0))
    kept = approach(jax.random.key(1), q, Flat(), far, FitConfig(rounds=5, draws=256))
    for before, after in zip(jax.tree.leaves(q), jax.tree.leaves(kept), strict=True):
        np.testing.assert_array_equal(after, before)
    with pytest.raises(InputError, match="likelihood: expected a density at one of 256 poses"):
        fit(jax.random.key(1), q, Flat(), far, FitConfig(rounds=5, draws=256))


@pytest.mark.parametrize("config", [{"rounds": 0}, {"annealed": 0.0}, {"effective": 1.5}, {"heat": 0.5}])
def test_a_bad_fit_is_refused(config):
    with pytest.raises(InputError, match=next(iter(config))):
        FitConfig(**config)


def test_starts_are_defined_where_some_draws_are_not():
    q = PoseFlow.around(jax.random.key(0), NOMINAL, 0.05, 0.05 / TURN_SLOPE)
    x = float(NOMINAL[0, 3])
    start, *rest = start_beliefs(jax.random.key(1), q, Flat(), undefined_beyond(x), (0.1, 0.1))
    assert start.share + sum(other.share for other in rest) == pytest.approx(1.0, abs=1e-5)
    assert np.isfinite(start.belief.covariance).all()
    assert x - START_REACH[0] < float(start.belief.mean.T_world_body[0, 3]) < x
    assert start_beliefs(jax.random.key(1), q, Flat(), undefined_beyond(x - 9.0), (0.1, 0.1)) == []


def test_a_start_from_few_draws_is_wide():
    """A posterior of 1 mm, of which a flow of half a metre draws a few poses by chance."""
    q = PoseFlow.around(jax.random.key(0), NOMINAL, 0.3, 0.3 / TURN_SLOPE)
    target = Humps(NOMINAL[None], 1e-6 * jnp.eye(6))
    start, *_ = start_beliefs(jax.random.key(1), q, Flat(), target, (0.1, 0.1))
    np.testing.assert_allclose(jnp.sqrt(jnp.diag(start.belief.covariance)[:6]), np.repeat(START_REACH, 3), rtol=1e-3)


def test_each_place_has_its_share():
    """Two places 0.9 m apart, one three times as likely as the other: a Gaussian of each, the likelier first."""
    aside = lambda x: NOMINAL @ se3_exp(jnp.array([x, 0.0, 0.0, 0.0, 0.0, 0.0]))
    T, std = jnp.stack([aside(-0.45), *[aside(0.45)] * 3]), jnp.array([0.1] * 3 + [0.05] * 3)
    q = PoseFlow.around(jax.random.key(0), NOMINAL, 0.4, 0.05 / TURN_SLOPE)
    first, second, *rest = start_beliefs(jax.random.key(1), q, Flat(), Humps(T, jnp.diag(std**2)), (0.1, 0.1))
    assert first.share / (first.share + second.share) == pytest.approx(0.75, abs=0.1)
    assert sum(other.share for other in rest) < 0.1
    for start, x in ((first, 0.45), (second, -0.45)):
        xi = POSES.error(aside(x), start.belief.mean.T_world_body)
        assert float(jnp.linalg.norm(xi[:3])) < 0.08 and float(jnp.linalg.norm(xi[3:])) < 0.04
        np.testing.assert_allclose(jnp.sqrt(jnp.diag(start.belief.covariance)[:6]), std, rtol=0.4)


@pytest.mark.slow
def test_a_flow_recovers_a_gaussian():
    """``L`` reaches the evidence, 0, of a correlated Gaussian from a wide start."""
    q = PoseFlow.around(jax.random.key(0), NOMINAL, 0.3, 0.3)
    target = Humps(NOMINAL[None], correlated())
    q = fit(jax.random.key(1), q, Flat(), target, FitConfig(rounds=40, steps=600, heat=2.0, rate=0.01))
    found = weigh(jax.random.key(2), q, Flat(), target, 4000)
    assert -0.1 < float(jnp.mean(found.log_weight)) < 0.02
    assert float(effective_share(found.log_weight)) > 0.8


@pytest.mark.slow
def test_a_flow_keeps_two_modes_where_a_gaussian_keeps_one():
    """Each mode has half of the posterior: a Gaussian loses ``log 2`` nats at least, the flow less."""
    T = jnp.stack([NOMINAL, NOMINAL @ FAR])
    target, prior = Humps(T, (2.0 * jnp.diag(STD)) ** 2), PoseFlow.around(jax.random.key(3), NOMINAL, 2.0)
    near = lambda poses: jnp.linalg.norm(poses[:, :3, 3] - T[1, :3, 3], axis=1) < 0.6
    q = fit(jax.random.key(1), prior, Flat(), target, FitConfig(steps=600, samples=256, rate=3e-4, heat=2.0))
    found = weigh(jax.random.key(2), q, Flat(), target, 4000)
    assert 0.1 < float(jnp.mean(near(found.poses))) < 0.9
    assert float(jnp.mean(found.log_weight)) > -np.log(2.0) + 0.05
    gaussian = Chain.around(NOMINAL[None], 2.0 * STD[None], POSES)
    gaussian = climb(jax.random.key(4), gaussian, Flat(), target, FitConfig(steps=300, heat=1.0))
    assert float(bound(jax.random.key(5), gaussian, Flat(), target, 4000)) < -np.log(2.0) + 0.1


@pytest.mark.slow
def test_a_view_counts_every_pixel_and_widens():
    """The likelihood of the image that is predicted falls as the camera moves, and less so where it is wide."""
    m = VoxelMap.prior((-1.0, -1.0, 0.5), 0.1, (16, 16, 16))
    z = jnp.broadcast_to(m.origin[2] + 0.1 * jnp.arange(16), (16, 16, 16))
    m = m.with_occupancy(m.blocked(z - 1.2))  # a wall 1.2 m ahead
    rig = Rig.of(Camera.from_hfov(8, 6, np.radians(40.0)))
    view = View(emission.render(m, jnp.eye(4), rig.camera), m, rig)
    moved = jnp.eye(4).at[2, 3].set(0.02)
    falls = [float(v.log_prob(jnp.eye(4)) - v.log_prob(moved)) for v in (view, view.widened(jnp.float32(5.0)))]
    assert 0.0 < falls[1] < falls[0]
