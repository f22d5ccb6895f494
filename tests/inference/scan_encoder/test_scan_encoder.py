"""Test that an encoder recovers poses in a room whose scans are a formula, and covers places that look alike."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.plane.scan_room import AnalyticRoom, full_circle
from vssm_gym.errors import InputError
from vssm_gym.inference.scan_encoder.encoder_file import load_encoder, save_encoder
from vssm_gym.inference.scan_encoder.mode import MODES_APART, modes_of
from vssm_gym.inference.scan_encoder.network import PoseMixture
from vssm_gym.inference.scan_encoder.prior import VisitedPlaces
from vssm_gym.inference.scan_encoder.training import EncoderConfig, elbo, fit_encoder

CONFIG = EncoderConfig(components=4, width=96, scans=8192, updates=1500, batch=128, elbo_updates=0)
PILLAR, BARE = AnalyticRoom(full_circle()), AnalyticRoom(full_circle(), pillar=(0.3, 0.4, 0.0))


def visited(std=0.02):
    """Return a drive around the room."""
    t = np.linspace(0.0, 2.0 * np.pi, 200)
    path = np.stack([0.5 + 0.38 * np.cos(t), 0.3 + 0.2 * np.sin(t), t], axis=-1)
    free = np.hypot(path[:, 0] - 0.3, path[:, 1] - 0.4) > 0.1
    return VisitedPlaces.of(path[free], std)


@pytest.fixture(scope="module")
def encoder():
    return fit_encoder(PILLAR, visited(), CONFIG)[0]


def truth(n, seed):
    states = visited().sample(jax.random.key(seed), 4 * n)
    free = np.asarray(PILLAR.ranges(states)).min(axis=1) > 0.02
    return states[free][:n]


def test_densities_integrate_to_one():
    q = PoseMixture(
        jnp.log(jnp.array([0.3, 0.7])), jnp.array([[0.4, 0.5, 3.1], [0.6, 0.5, 0.0]]), jnp.full((2, 3), 0.08)
    )
    axis, turns = np.linspace(0.0, 1.0, 60), np.linspace(-np.pi, np.pi, 120, endpoint=False)
    grid = np.stack(np.meshgrid(axis, axis, turns, indexing="ij"), axis=-1)
    cell = (axis[1] - axis[0]) ** 2 * (turns[1] - turns[0])
    for density in (q, VisitedPlaces.of(np.array([[0.4, 0.5], [0.5, 0.6]]), 0.08)):
        total = np.exp(np.asarray(density.log_prob(jnp.asarray(grid, jnp.float32)))).sum() * cell
        assert total == pytest.approx(1.0, abs=0.01)
    assert np.abs(np.asarray(q.sample(jax.random.key(0), 50)[:, 2])).max() <= np.pi


@pytest.mark.slow
def test_poses_of_a_room_are_recovered(encoder):
    states = truth(20, seed=5)
    scans = np.asarray(PILLAR.ranges(states))
    found = np.array([modes_of(encoder, PILLAR, scan, 0).poses[0] for scan in scans])
    assert np.sort(np.hypot(*(found - states)[:, :2].T))[-2] < 0.012
    assert np.abs(np.angle(np.exp(1j * (found - states)[:, 2]))).max() < 0.05


def test_the_belief_itself_knows_the_place(encoder):
    """Without the model's help: a component of most scans is near, and the density beats the prior's."""
    states = truth(40, seed=6)
    scans = PILLAR.sample(jax.random.key(1), states)
    q = jax.vmap(encoder)(scans)
    away = np.linalg.norm(np.asarray(q.mean)[..., :2] - np.asarray(states)[:, None, :2], axis=-1)
    assert np.median(away.min(axis=1)) < 0.06
    gained = jax.vmap(PoseMixture.log_prob)(q, states) - visited().log_prob(states)
    assert np.median(np.asarray(gained)) > 2.0


def test_places_that_look_alike_are_all_held():
    """A bare room looks the same turned by half a circle: both poses are likely, and either explains the scan."""
    encoder = fit_encoder(BARE, VisitedPlaces.of(np.array([[0.25, 0.2], [0.75, 0.4]]), 0.03), CONFIG)[0]
    state = np.array([0.25, 0.2, 0.4])
    other = np.array([0.75, 0.4, 0.4 - np.pi])
    scan = BARE.ranges(jnp.asarray(state, jnp.float32))
    densities = encoder(scan).log_prob(jnp.asarray(np.stack([state, other]), jnp.float32))
    assert np.asarray(densities).min() > 0.0
    found = modes_of(encoder, BARE, np.asarray(scan), 0)
    for pose in (state, other):
        assert np.hypot(*(found.poses[:2] - pose)[:, :2].T).min() < 0.01
    assert found.scores[1] == pytest.approx(found.scores[0], abs=1.0)
    assert (np.diff(found.scores) <= 0.0).all()
    apart = np.hypot(*np.moveaxis(found.poses[:, None, :2] - found.poses[None, :, :2], -1, 0))
    assert apart[~np.eye(len(apart), dtype=bool)].min() >= MODES_APART - 1e-6


def test_a_wrong_encoder_does_not_hide_a_place(encoder):
    """The prior proposes too: a network that points elsewhere with certainty costs nothing but its draws."""
    lost = eqx.tree_at(
        lambda e: e.layers[-1], encoder, (0.0 * encoder.layers[-1][0], 0.0 * encoder.layers[-1][1] - 3.0)
    )
    states = truth(10, seed=8)
    scans = np.asarray(PILLAR.ranges(states))
    found = np.array([modes_of(lost, PILLAR, scan, 0).poses[0] for scan in scans])
    assert np.hypot(*(found - states)[:, :2].T).max() < 0.02


def test_the_bound_rises_and_stays_below_the_evidence():
    """The ELBO of the room's scans grows by its own objective, from an encoder that has learned little."""
    config = EncoderConfig(
        components=4, width=64, scans=1024, updates=50, batch=64, elbo_updates=60, elbo_batch=16, elbo_rate=1e-3
    )
    _, bounds = fit_encoder(PILLAR, visited(), config)
    assert len(bounds) == 60
    assert np.isfinite(bounds).all()
    assert bounds[-20:].mean() > bounds[:20].mean()


def test_the_bound_is_below_the_evidence(encoder):
    """The evidence is that of many draws of the prior."""
    states = truth(2, seed=7)
    scans = PILLAR.sample(jax.random.key(2), states)
    for scan in scans:
        drawn = visited().sample(jax.random.key(3), 50_000)
        evidence = jax.scipy.special.logsumexp(PILLAR.log_prob(scan, drawn)) - np.log(50_000)
        keys = jax.random.split(jax.random.key(4), 32)
        bound = np.mean(jax.vmap(lambda key, x=scan: elbo(encoder, PILLAR, x, key))(keys))
        assert bound < float(evidence) + 0.5


def test_the_same_seed_gives_the_same_encoder_and_a_file_keeps_it(tmp_path):
    config = EncoderConfig(components=2, width=16, scans=300, updates=20, batch=16, elbo_updates=2, elbo_batch=2)
    a, b = (fit_encoder(PILLAR, visited(), config, seed=3)[0] for _ in range(2))
    save_encoder(tmp_path / "encoder.npz", a)
    kept = load_encoder(tmp_path / "encoder.npz", visited(), 1.5)
    scan = PILLAR.ranges(truth(1, 0)[0])
    for other in (b, kept):
        np.testing.assert_array_equal(a(scan).mean, other(scan).mean)
    (tmp_path / "encoder.npz").write_bytes(b"PK")
    with pytest.raises(InputError):
        load_encoder(tmp_path / "encoder.npz", visited(), 1.5)


def test_what_cannot_be_trained_is_refused():
    with pytest.raises(InputError, match="places"):
        fit_encoder(PILLAR, VisitedPlaces.of(np.array([[0.3, 0.4]]), 0.001), CONFIG)
    with pytest.raises(InputError, match="components"):
        EncoderConfig(components=0)
    with pytest.raises(InputError, match="std"):
        VisitedPlaces.of(np.zeros((1, 2)), 0.0)
