"""Test the latent grid against enumeration, linear regression in float64, and the geometry of a room."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vssm_gym.errors import InputError
from vssm_gym.inference.latent.config import LatentConfig
from vssm_gym.inference.latent.decoder_fit import fit_decoder
from vssm_gym.inference.latent.elbo import elbo
from vssm_gym.inference.latent.scan_charts import Panorama, ScanCharts, ScanReading, panorama
from vssm_gym.inference.particles import BootstrapFilter, ParticleBelief
from vssm_gym.maps.latent_grid import ChartDecoder, LatentGrid
from vssm_gym.model.latent_scans import LatentScans, seen_from
from vssm_gym.model.scan_emission import ScanLikelihood
from vssm_gym.model.scan_model import ScanModel
from vssm_gym.model.scanner import Scanner
from vssm_gym.model.transition.manifold import PLANAR
from vssm_gym.model.transition.odometry import Odometry

BEAMS = 8
CELL = 0.5
STD = 0.3
PLAIN = LatentConfig(latents=2, reading_std=STD / CELL, counted=1.0, counted_map=1.0, slope=0.0, huber=1e6)
ANGLES = 2.0 * np.pi * np.arange(BEAMS) / BEAMS
SCANNER = Scanner(jnp.asarray(ANGLES, jnp.float32), jnp.zeros(3), jnp.float32(10.0))
POSES = np.array([[0.0, 0.0, 0.0], [0.5, 0.5, 0.0], [1.0, 0.5, 0.0]])  # at centres of cells, so one chart each


def decoder() -> ChartDecoder:
    wave = np.stack([np.cos(ANGLES), np.sin(ANGLES)])
    return ChartDecoder(jnp.float32(2.0), jnp.asarray(0.4 * wave, jnp.float32))


def grid() -> LatentGrid:
    return LatentGrid.prior(np.zeros(2), np.full(2, 1.0), CELL, decoder())


def scan(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return 2.0 + 0.4 * rng.normal(size=2) @ (np.asarray(decoder().basis) / 0.4) + STD * rng.normal(size=BEAMS)


def put(m: LatentGrid, x: np.ndarray, pose: np.ndarray, sign: float = 1.0, config: LatentConfig = PLAIN) -> LatentGrid:
    beams = jnp.asarray(x, jnp.float32)
    reading = ScanReading(beams, panorama(beams, SCANNER, BEAMS))
    return ScanCharts(SCANNER, config).write(m, reading, jnp.asarray(pose, jnp.float32), sign)


def regression(scans: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, float]:
    """Return mean, covariance and log evidence of one chart's latents, by Bayesian linear regression in float64."""
    W = np.asarray(decoder().basis, float)
    A, y = np.tile(W.T, (len(scans), 1)), np.concatenate(scans) - 2.0
    precision = np.eye(2) + A.T @ A / STD**2
    covariance = np.linalg.inv(precision)
    joint = A @ A.T + STD**2 * np.eye(len(y))
    evidence = -0.5 * (y @ np.linalg.solve(joint, y) + np.linalg.slogdet(2.0 * np.pi * joint)[1])
    return covariance @ A.T @ y / STD**2, covariance, evidence


def test_a_chart_is_the_posterior_of_its_latents():
    scans = [scan(1), scan(2)]
    m = put(put(grid(), scans[0], POSES[1]), scans[1], POSES[1])
    mean, covariance, _ = regression(scans)
    W = np.asarray(decoder().basis, float)
    np.testing.assert_allclose(m.chart[1, 1], 2.0 + mean @ W, rtol=1e-4)
    np.testing.assert_allclose(m.spread[1, 1], np.sqrt(np.diag(W.T @ covariance @ W)), rtol=1e-4)
    np.testing.assert_allclose(m.chart[0, 0], 2.0)


def test_the_bound_is_the_evidence_where_the_posterior_is_exact():
    """For a known pose ``E_q log p(x | M) - KL(q | p)`` is the log evidence, and below it for any other ``q``."""
    x = scan(3)
    exact = regression([x])[2]

    def bound(m: LatentGrid) -> tuple[float, float]:
        model = LatentScans(m, SCANNER, STD, 1.0, 1e6)
        draw = lambda key: model.draw_map(key).log_prob(jnp.asarray(x, jnp.float32), jnp.asarray(POSES[1], jnp.float32))
        nats = jax.vmap(draw)(jax.random.split(jax.random.key(0), 4000)) - 0.5 * BEAMS * np.log(2.0 * np.pi)
        return float(nats.mean() - m.divergence()), float(nats.std()) / np.sqrt(4000)

    found, error = bound(put(grid(), x, POSES[1]))
    assert abs(found - exact) < 4.0 * error + 1e-3 and error < 0.05
    other, error = bound(put(put(grid(), x, POSES[1]), scan(9), POSES[1]))
    assert other + 4.0 * error < exact


def test_three_poses_are_enumerated():
    """Importance weights under each map, and the posterior of the pose, agree with an enumeration of three poses."""
    known, x = [scan(4), scan(5)], scan(5) + 0.05
    m = put(put(grid(), known[0], POSES[0]), known[1], POSES[1])  # the third chart is not known
    model = LatentScans(m, SCANNER, STD, 1.0, 1e6)
    belief = ParticleBelief.of(jnp.asarray(POSES, jnp.float32), PLANAR)
    weigh = BootstrapFilter(Odometry((0.01, 0.01, 0.01))).observe
    drawn = model.draw_map(jax.random.key(1))
    found = weigh(belief, ScanLikelihood(jnp.asarray(x, jnp.float32), drawn)).belief.weight
    charts = np.asarray(drawn.m.chart, float)[[0, 1, 2], [0, 1, 1]]
    log = -0.5 * np.sum((x - charts) ** 2, axis=1) / STD**2
    np.testing.assert_allclose(found, np.exp(log - log.max()) / np.exp(log - log.max()).sum(), rtol=2e-3)
    # p(z | x) of the outer expectation over q(M), against the ratio of closed-form evidences
    evidence = np.array([regression([*known[i : i + 1], x])[2] - regression(known[i : i + 1])[2] for i in range(2)])
    evidence = np.append(evidence, regression([x])[2])
    exact = np.exp(evidence - evidence.max()) / np.exp(evidence - evidence.max()).sum()

    def likelihoods(key: jax.Array) -> jax.Array:
        one = model.draw_map(key)
        return jnp.exp(one.log_prob(jnp.asarray(x, jnp.float32), jnp.asarray(POSES, jnp.float32)))

    each = np.asarray(jax.vmap(likelihoods)(jax.random.split(jax.random.key(2), 20_000)), float)
    np.testing.assert_allclose(each.mean(axis=0) / each.mean(axis=0).sum(), exact, atol=0.01)


@pytest.mark.slow
def test_the_bound_of_a_motion_and_a_scan_against_an_enumeration_of_poses():
    """With a known map, ``scans + motions + entropy`` of one step is below the evidence of all places along a line.

    The gap is the divergence of ``q`` from the posterior: next to none where ``q`` has the posterior's moments.
    """
    m = grid()
    for k, pose in enumerate(POSES):
        for _ in range(400):  # charts that are as good as known
            m = put(m, scan(k), pose)
    model, transition = LatentScans(m, SCANNER, 0.4, 1.0, 1e6), Odometry((0.15, 1e-4, 1e-4), (0.0, 0.0, 0.0))
    start, control, forward = jnp.zeros(3), jnp.array([0.5, 0.0, 0.0]), np.linspace(-0.1, 1.1, 481)
    line = jnp.asarray(np.stack([forward, 0.0 * forward, 0.0 * forward], axis=-1), jnp.float32)
    x = model.ranges(jnp.array([0.4, 0.0, 0.0]))
    joint = np.asarray(model.log_prob(x, line), float) - 0.5 * ((forward - 0.5) / 0.15) ** 2
    weight = np.exp(joint - joint.max())
    # The motion's density over the two other axes integrates to one: along the line its normaliser is that of one axis
    spacing = forward[1] - forward[0]
    evidence = joint.max() + np.log(weight.sum() * spacing) - np.log(0.15 * np.sqrt(2.0 * np.pi))
    mean = float((weight * forward).sum() / weight.sum())
    std = float(np.sqrt((weight * (forward - mean) ** 2).sum() / weight.sum()))

    def bound(mean: float, std: float) -> float:
        means = jnp.stack([start, jnp.array([mean, 0.0, 0.0])])
        covariance = jnp.stack([1e-12 * jnp.eye(3), jnp.diag(jnp.array([std, 1e-4, 1e-4]) ** 2)])
        given = jnp.stack([control, control]), jnp.stack([x, x]), jnp.array([1])
        found = elbo(jax.random.key(0), transition, model, means, covariance, *given, 4000)
        return float(found.scans + found.motions + found.entropy)

    assert evidence - 0.25 < bound(mean, std) < evidence + 0.02
    assert bound(mean + 2.0 * std, std) < evidence - 0.5
    assert bound(mean, 3.0 * std) < evidence - 0.5


@settings(max_examples=20, deadline=None)
@given(x=st.floats(0.0, 1.0), y=st.floats(0.0, 1.0), heading=st.floats(-3.1, 3.1))
def test_what_was_written_can_be_erased(x, y, heading):
    before = put(grid(), scan(6), POSES[0])
    pose = np.array([x, y, heading])
    after = put(put(before, scan(7), pose), scan(7), pose, -1.0)
    np.testing.assert_allclose(after.chart, before.chart, atol=2e-3)
    np.testing.assert_allclose(after.spread, before.spread, atol=2e-3)
    np.testing.assert_array_equal(put(before, scan(7), pose, 0.0).weight, before.weight)


def room(xy: np.ndarray, bearing: np.ndarray) -> np.ndarray:
    """Return the ranges from a place in a room of 4 m x 3 m about the origin."""
    u = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    u = np.where(np.abs(u) < 1e-9, 1e-9, u)
    return np.min((np.sign(u) * np.array([2.0, 1.5]) - xy) / u, axis=-1)


@settings(max_examples=30, deadline=None)
@given(x=st.floats(-0.25, 0.25), y=st.floats(-0.25, 0.25))
def test_a_chart_seen_from_beside_has_its_parallax(x, y):
    bearing = 2.0 * np.pi * (np.arange(360) + 0.25) / 360
    chart = jnp.asarray(room(np.zeros(2), 2.0 * np.pi * np.arange(360) / 360), jnp.float32)
    found = seen_from(chart, jnp.asarray([x, y], jnp.float32), jnp.asarray(bearing, jnp.float32))
    exact = room(np.array([x, y]), bearing)
    assert np.quantile(np.abs(found - exact), 0.95) < 0.02
    off = np.hypot(x, y)
    if off > 0.1:
        assert np.abs(found - exact).mean() < 0.2 * np.abs(np.asarray(chart) - exact).mean()


def test_a_latent_grid_is_a_model_of_scans():
    m = put(grid(), scan(8), POSES[1])
    model = LatentScans(m, SCANNER, STD)
    assert isinstance(model, ScanModel)
    at = jnp.asarray(POSES[1:2], jnp.float32)
    np.testing.assert_allclose(model.ranges(at)[0], m.chart[1, 1], rtol=1e-5)
    drawn = jax.vmap(model.sample, (0, None))(jax.random.split(jax.random.key(0), 2000), at)
    np.testing.assert_allclose(jnp.std(drawn, axis=0), STD, rtol=0.1)
    turned = model.ranges(jnp.array([0.5, 0.5, 2.0 * np.pi / BEAMS]))
    np.testing.assert_allclose(turned, jnp.roll(m.chart[1, 1], -1), rtol=1e-4)


def test_a_scan_without_readings_says_nothing():
    m = put(grid(), scan(8), POSES[1])
    again = put(m, np.zeros(BEAMS), POSES[1])
    np.testing.assert_array_equal(again.weight, m.weight)
    model = LatentScans(m, SCANNER, STD)
    assert float(model.log_prob(jnp.zeros(BEAMS), jnp.zeros(3))) == 0.0


@pytest.mark.parametrize("beams", [180, 181])
def test_half_a_circle_is_half_a_panorama(beams):
    angles = np.radians(np.arange(beams) - 90.0)
    half = Scanner(jnp.asarray(angles, jnp.float32), jnp.zeros(3), jnp.float32(10.0))
    ranges = 1.0 + 0.001 * np.arange(beams)
    found: Panorama = panorama(jnp.asarray(ranges, jnp.float32), half, 360)
    wanted = (np.arange(360) + 90) % 360
    inside = wanted < beams
    np.testing.assert_array_equal(found.valid, inside.astype(float))
    np.testing.assert_allclose(np.asarray(found.ranges)[inside], ranges[wanted[inside]], rtol=1e-4)


def test_a_decoder_has_the_covariance_of_the_scans():
    rng = np.random.default_rng(0)
    phase = rng.uniform(0.0, 2.0 * np.pi, (2000, 1))
    ranges = 3.0 + 0.5 * np.cos(ANGLES + phase) + 0.2 * np.cos(2.0 * ANGLES + 5.0 * phase)
    found = fit_decoder(ranges, ANGLES, BEAMS, 4)
    W = np.asarray(found.basis, float)
    exact = 0.5 * (0.25 * np.cos(ANGLES[:, None] - ANGLES) + 0.04 * np.cos(2.0 * (ANGLES[:, None] - ANGLES)))
    np.testing.assert_allclose(W.T @ W, exact, atol=0.01)
    assert float(found.mean) == pytest.approx(3.0, abs=0.02)
    with pytest.raises(InputError, match="latents"):
        fit_decoder(ranges, ANGLES, BEAMS, BEAMS + 1)
    with pytest.raises(InputError, match="reading"):
        fit_decoder(np.zeros((2, BEAMS)), ANGLES, BEAMS, 2)


def test_no_cells_are_refused():
    with pytest.raises(InputError, match="cells"):
        LatentGrid.prior(np.zeros(2), np.ones(2), 0.0, decoder())
    with pytest.raises(InputError, match="cells"):
        LatentGrid.prior(np.zeros(2), np.full(2, 1e6), 0.1, decoder())
