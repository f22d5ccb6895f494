"""Test particles against exact filters, an enumeration of three poses and a grid on a line, and their weights' laws."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from vssm_gym.errors import InputError
from vssm_gym.inference.particles import BootstrapFilter, ParticleBelief
from vssm_gym.inference.particles.bootstrap import StateLikelihood
from vssm_gym.inference.particles.weights import effective_number, normalised, systematic
from vssm_gym.model.transition import Belief, GaussianBelief, Transition, planar_belief
from vssm_gym.model.transition.manifold import PLANAR

THREE = jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.5], [0.0, 1.0, -1.0]])
STEPS = np.array([[0.7, 0.2, 0.1], [0.1, 0.6, 0.3], [0.25, 0.25, 0.5]])  # p(pose after | pose before)
SEEN = np.array([[0.5, 0.3, 0.2], [0.1, 0.8, 0.1], [0.2, 0.2, 0.6], [0.4, 0.5, 0.1]])  # p(x_t | pose), t = 1 ... 4
STD, DT = 0.1, 1.0

weights = st.lists(st.floats(-30.0, 5.0), min_size=1, max_size=40).map(lambda w: jnp.array(w, jnp.float32))


class Jumps(Transition):
    """Jump between the three poses by a table."""

    table: jax.Array

    manifold = PLANAR
    controls = 1
    commanded = False

    def mean(self, state, control, dt):
        return state

    def noise_covariance(self, state, control, dt):
        return jnp.eye(3)

    def sample(self, key, state, control, dt):
        now = jnp.argmin(jnp.linalg.norm(state[:, None] - THREE, axis=-1), axis=1)
        return THREE[jax.random.categorical(key, jnp.log(self.table)[now], axis=-1)]


class Table(eqx.Module):
    """Give each of the three poses a likelihood."""

    likelihood: jax.Array

    def log_prob(self, state):
        return jnp.log(self.likelihood)[jnp.argmin(jnp.linalg.norm(state[..., None, :] - THREE, axis=-1), axis=-1)]


class Line(Transition):
    """Move along x by the control, with noise."""

    manifold = PLANAR
    controls = 1
    commanded = True

    def mean(self, state, control, dt):
        return state.at[..., 0].add(control[..., 0])

    def noise_covariance(self, state, control, dt):
        return jnp.diag(jnp.array([STD, 1e-6, 1e-6]) ** 2)


class Wall(eqx.Module):
    """Measure the distance to the nearer one of two walls, at -2 and 2: all places but the middle come in pairs."""

    distance: jax.Array

    def log_prob(self, state):
        return jax.scipy.stats.norm.logpdf(self.distance, 2.0 - jnp.abs(state[..., 0]), 0.1)


def test_the_filter_tends_to_the_enumeration_of_three_poses():
    """The evidence of four observations and the last posterior are those of the forward algorithm."""
    exact, evidence = SEEN[0] / 3.0, 0.0
    for t in range(len(SEEN)):
        exact = exact if t == 0 else (exact @ STEPS) * SEEN[t]
        evidence, exact = evidence + np.log(exact.sum()), exact / exact.sum()
    filtered, n = BootstrapFilter(Jumps(jnp.asarray(STEPS))), 30_000
    belief = ParticleBelief.of(THREE[jnp.arange(n) % 3], PLANAR)
    found = filtered.observe(belief, Table(jnp.asarray(SEEN[0])))
    total = float(found.log_evidence)
    for t in range(1, len(SEEN)):
        key = jax.random.fold_in(jax.random.key(0), t)
        found = filtered.step(key, found.belief, jnp.zeros(1), Table(jnp.asarray(SEEN[t])), DT)
        total += float(found.log_evidence)
    at = np.linalg.norm(np.asarray(found.belief.states)[:, None] - np.asarray(THREE), axis=-1) < 1e-3
    np.testing.assert_allclose(np.asarray(found.belief.weight) @ at, exact, atol=0.01)
    assert total == pytest.approx(evidence, abs=0.01)


def test_the_filter_tends_to_an_exact_filter_on_a_grid():
    """Two places that look alike keep their shares, until the motion tells them apart."""
    grid = np.linspace(-4.0, 4.0, 4001)
    density = stats.norm.pdf(grid, 0.3, 1.0)
    kernel = stats.norm.pdf(grid, 0.0, STD)
    filtered, n = BootstrapFilter(Line()), 20_000
    x = jnp.asarray(0.3 + jax.random.normal(jax.random.key(1), (n,)))
    belief = ParticleBelief.of(jnp.stack([x, 0.0 * x, 0.0 * x], axis=1), PLANAR)
    for t, (move, measured) in enumerate([(0.0, 1.0), (0.2, 1.2), (0.3, 1.5), (0.5, 1.9), (0.5, 1.6)]):
        density = np.interp(grid - move, grid, density)
        density = np.convolve(density, kernel, mode="same")
        density *= np.exp(np.asarray(Wall(jnp.float32(measured)).log_prob(jnp.asarray(grid)[:, None])))
        mass = density / density.sum()
        key = jax.random.fold_in(jax.random.key(2), t)
        belief = filtered.step(key, belief, jnp.array([move]), Wall(jnp.float32(measured)), DT).belief
        density = mass
        places = np.asarray(belief.states)[:, 0]
        left = float(np.asarray(belief.weight) @ (places < 0.0))
        assert left == pytest.approx(mass[grid < 0.0].sum(), abs=0.03)
        mean = mass @ grid
        assert float(belief.gaussian().mean[0]) == pytest.approx(mean, abs=0.05)
        assert float(belief.gaussian().covariance[0, 0]) == pytest.approx(mass @ (grid - mean) ** 2, abs=0.06)


def test_the_evidence_has_no_bias():
    """The mean over many filters is the exact probability, of three particles too."""
    exact = float((np.ones(3) / 3.0 @ STEPS) @ SEEN[1])
    belief = ParticleBelief.of(THREE, PLANAR)
    filtered = BootstrapFilter(Jumps(jnp.asarray(STEPS)))
    one = lambda key: filtered.step(key, belief, jnp.zeros(1), Table(jnp.asarray(SEEN[1])), DT).log_evidence
    found = np.exp(np.asarray(jax.vmap(one)(jax.random.split(jax.random.key(0), 4000))))
    assert found.mean() == pytest.approx(exact, abs=4.0 * found.std() / np.sqrt(4000))


@given(weights, st.integers(1, 50), st.integers(0, 2**31 - 1))
def test_systematic_draws_are_floor_or_one_more(log_weight, draws, seed):
    chosen = np.asarray(systematic(jax.random.key(seed), log_weight, draws))
    counts = np.bincount(chosen, minlength=len(log_weight))
    expected = draws * np.exp(np.asarray(normalised(log_weight), np.float64))
    assert counts.sum() == draws and (np.abs(counts - expected) < 1.0 + 1e-3).all()


@given(weights)
def test_the_effective_number_is_between_one_and_all(log_weight):
    assert 1.0 - 1e-4 <= float(effective_number(log_weight)) <= len(log_weight) * (1.0 + 1e-4)
    assert float(jnp.sum(jnp.exp(normalised(log_weight)))) == pytest.approx(1.0, abs=1e-4)


def test_weights_that_are_all_zero_are_equal():
    np.testing.assert_allclose(jnp.exp(normalised(jnp.full(4, -jnp.inf))), 0.25)
    assert float(effective_number(jnp.full(4, -jnp.inf))) == pytest.approx(4.0)


@pytest.mark.slow
def test_particles_of_a_gaussian_have_its_moments():
    """Near a heading of pi, where angles wrap; weights that undo a proposal leave the moments too."""
    A = np.array([[0.2, 0.0, 0.0], [0.1, 0.3, 0.0], [0.05, -0.1, 0.2]])
    covariance, wide = jnp.asarray(A @ A.T, jnp.float32), jnp.asarray(2.0 * A @ A.T, jnp.float32)
    mean = jnp.array([0.4, -0.7, 3.1])
    exact, proposal = planar_belief(mean, covariance), planar_belief(mean, wide)
    states = proposal.sample(jax.random.key(0), 6000)
    plain = ParticleBelief.of(exact.sample(jax.random.key(1), 6000), PLANAR)
    weighed = ParticleBelief(states, exact.log_prob(states) - proposal.log_prob(states), PLANAR)
    for belief in (plain, weighed):
        found = belief.gaussian()
        np.testing.assert_allclose(PLANAR.error(mean, found.mean), 0.0, atol=0.02)
        np.testing.assert_allclose(found.covariance, covariance, atol=8e-3)
        assert float(belief.entropy()) == pytest.approx(float(exact.entropy()), abs=0.1)
    drawn = ParticleBelief.of(weighed.sample(jax.random.key(2), 6000), PLANAR).gaussian()
    np.testing.assert_allclose(drawn.covariance, covariance, atol=1e-2)


def test_resampling_keeps_the_belief_and_equalises_the_weights():
    states = planar_belief(jnp.zeros(3), jnp.eye(3)).sample(jax.random.key(0), 5000)
    belief = ParticleBelief(states, -5.0 * (states[:, 0] - 0.5) ** 2, PLANAR)
    again = belief.resampled(jax.random.key(1))
    assert float(again.effective) == pytest.approx(5000.0, rel=1e-3)
    assert float(belief.effective) < 2500.0
    np.testing.assert_allclose(again.mean, belief.mean, atol=0.06)


def test_particles_are_a_belief():
    belief = ParticleBelief.of(THREE, PLANAR)
    assert isinstance(belief, Belief) and isinstance(Table(jnp.ones(3)), StateLikelihood)
    assert isinstance(belief.gaussian(), GaussianBelief)


def test_a_share_beyond_one_is_refused():
    with pytest.raises(InputError, match=r"least: expected a share between 0 and 1, not 1\.5"):
        BootstrapFilter(Line(), 1.5)
