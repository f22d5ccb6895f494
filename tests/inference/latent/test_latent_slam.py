"""Test the filter, the backward pass and whole runs with a latent grid."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vssm_gym.data.laser_logs import LaserLog
from vssm_gym.data.traversals import errors, traverse
from vssm_gym.envs.tasks.mazes import load_maze
from vssm_gym.errors import InputError
from vssm_gym.inference.latent.config import LatentConfig
from vssm_gym.inference.latent.decoder_fit import fit_decoder
from vssm_gym.inference.latent.elbo import elbo
from vssm_gym.inference.latent.filter import smoothed
from vssm_gym.inference.latent.passes import Log, Pass, advance, put_all, without_first_chunk
from vssm_gym.inference.latent.scan_charts import ScanCharts, ScanReading, panorama
from vssm_gym.inference.latent.strip_charts import StripConfig, brightness
from vssm_gym.inference.particles import ParticleBelief
from vssm_gym.maps.latent_grid import LatentGrid
from vssm_gym.model.scan_model import ScanModel
from vssm_gym.model.scanner import Scanner
from vssm_gym.model.transition.manifold import PLANAR
from vssm_gym.model.transition.odometry import Odometry
from vssm_gym.slam.latent_run import LatentRun, run_latent, run_strips

CELL = 1.0 / 16.0
STEPS = 400
SMALL = LatentConfig(particles=60)


@pytest.fixture(scope="module")
def drive() -> LaserLog:
    return traverse(load_maze("pillars-v1"), STEPS, seed=1)


@pytest.fixture(scope="module")
def run(drive) -> LatentRun:
    return run_latent(drive, CELL, passes=1, config=SMALL)


def test_backwards_as_a_batch():
    """Along a line the smoothed moments are those of the joint Gaussian of all poses, solved at once in float64."""
    transition, steps = Odometry((0.1, 0.05, 1e-3), (0.0, 0.0, 0.0)), 4
    controls = np.tile([1.0, 0.0, 0.0], (steps, 1))
    measured, std = np.array([0.0, 1.2, 1.9, 3.3, 4.1]), 0.2
    mean, variance = [0.0], [std**2]
    for x in measured[1:]:
        predicted, spread = mean[-1] + 1.0, variance[-1] + 0.01
        gain = spread / (spread + std**2)
        mean.append(predicted + gain * (x - predicted))
        variance.append((1.0 - gain) * spread)
    states = jnp.asarray([[m, 0.0, 0.0] for m in mean], jnp.float32)
    covariance = jnp.asarray([np.diag([v, 1e-4, 1e-6]) for v in variance], jnp.float32)
    found, of_found = smoothed(transition, states, covariance, jnp.asarray(controls, jnp.float32), 0.0)
    difference = np.diff(np.eye(steps + 1), axis=0)
    precision = np.eye(steps + 1) / std**2 + difference.T @ difference / 0.01
    right = measured / std**2 + difference.T @ np.ones(steps) / 0.01
    np.testing.assert_allclose(found[:, 0], np.linalg.solve(precision, right), atol=1e-4)
    np.testing.assert_allclose(of_found[:, 0, 0], np.diag(np.linalg.inv(precision)), rtol=1e-3)


@pytest.mark.slow
def test_a_drive_is_better_than_its_odometry(drive, run):
    integrated, off = errors(drive, drive.path()), errors(drive, run.poses)
    assert off.mean() < 0.6 * integrated.mean() and off.max() < 0.05
    assert run.poses.shape == (STEPS + 1, 3) and len(run.log_evidence) == 2
    assert run.log_evidence[1] > run.log_evidence[0]  # the first pass knew nothing of later chunks
    np.linalg.cholesky(run.covariance[1:])


def test_its_map_predicts_scans(drive, run):
    assert isinstance(run.model, ScanModel)
    chosen = slice(50, STEPS, 25)
    predicted = np.asarray(run.model.ranges(jnp.asarray(run.poses[chosen], jnp.float32)))
    seen = drive.ranges[chosen]
    off = np.abs(predicted - seen)[seen > 0.0]
    unknown = np.abs(seen.mean() - seen)[seen > 0.0]
    assert np.median(off) < 0.025 and off.mean() < 0.4 * unknown.mean()


@pytest.mark.slow
def test_a_minibatch_estimates_the_bound(drive, run):
    """The mean over minibatches is the bound of all steps; poses or a map that know less have a lower one."""
    transition = Odometry((0.001, 0.001, 0.006), (0.02, 0.02, 0.02))
    controls = jnp.asarray(np.concatenate([np.zeros((1, 3)), drive.motions]), jnp.float32)
    mean, covariance = jnp.asarray(run.poses, jnp.float32), jnp.asarray(run.covariance, jnp.float32)

    def bound(steps: np.ndarray, mean: jax.Array, draws: int = 32) -> float:
        key = jax.random.key(3)
        given = controls, jnp.asarray(drive.ranges), jnp.asarray(steps)
        return elbo(key, transition, run.model, mean, covariance, *given, draws)

    every = np.arange(1, STEPS + 1)
    whole = bound(every, mean)
    halves = [bound(every[part::2], mean) for part in (0, 1)]
    parts = np.mean([float(half.scans) for half in halves])
    assert parts == pytest.approx(float(whole.scans), rel=0.02)
    assert np.mean([float(half.entropy) for half in halves]) == pytest.approx(float(whole.entropy), rel=1e-4)
    assert float(bound(every, mean + jnp.array([0.05, 0.0, 0.0])).total) < float(whole.total)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"max_range": 0.0}, "max-range: expected above 0 m"),
        ({"passes": -1}, "passes: expected at least 0"),
        ({"cell_size": 0.0}, "cell_size"),
    ],
)
def test_what_does_not_fit_is_refused(drive, given, message):
    with pytest.raises(InputError, match=message):
        run_latent(drive, **({"cell_size": CELL} | given))


@pytest.mark.parametrize(
    ("field", "kind"), [("reading_std", float), ("counted", float), ("particles", int), ("chunk", int)]
)
def test_numbers_that_do_not_fit_are_refused(field, kind):
    with pytest.raises(InputError, match=field):
        LatentConfig(**{field: kind(0)})


@pytest.mark.slow
def test_strips_are_tracked_by_charts_of_colours():
    drive = traverse(load_maze("pillars-v1"), 900, seed=0, sensor="camera", beams=32)
    found = run_strips(drive, 0.1, passes=1, config=StripConfig(latents=12, particles=100))
    off, integrated = errors(drive, found.poses), errors(drive, drive.path())
    assert off.mean() < 0.6 * integrated.mean() and found.poses.shape == (901, 3)
    assert off[-1] < 0.4 * integrated[-1]
    pixels = jnp.asarray(brightness(drive.images))
    known = jnp.asarray(found.poses, jnp.float32)
    right = jax.vmap(found.model.log_prob)(pixels, known)
    turned = jax.vmap(found.model.log_prob)(pixels, known + jnp.array([0.0, 0.0, 1.0]))
    assert float(jnp.mean(right - turned)) > 1.0  # a strip says where ahead is
    assert float(jnp.min(pixels)) > 0.0 and float(jnp.max(pixels)) <= 1.0


def test_a_step_off_line_sees_the_map_of_the_other_chunks():
    """Before every step the map holds exactly the readings that are more than a chunk away, each once."""
    log, chunk = traverse(load_maze("pillars-v1"), 30, seed=2, beams=16), 4
    config = LatentConfig(latents=6, particles=8, chunk=chunk)
    decoder = fit_decoder(log.ranges, log.angles, 16, 6)
    prior = LatentGrid.prior(np.array([-1.5, -1.5]), np.array([1.5, 1.5]), 0.25, decoder)
    scanner = Scanner(jnp.asarray(log.angles, jnp.float32), jnp.zeros(3), jnp.float32(1.5))
    charts = ScanCharts(scanner, config)
    beams = jnp.asarray(log.ranges)
    readings = ScanReading(beams, jax.vmap(lambda scan: panorama(scan, scanner, 16))(beams))
    poses = jnp.asarray(log.path(), jnp.float32)
    controls = jnp.asarray(np.concatenate([np.zeros((1, 3)), log.motions]), jnp.float32)
    time = len(controls)
    m = without_first_chunk(charts, put_all(charts, prior, readings, poses), readings, poses, chunk)
    belief = ParticleBelief.of(jnp.zeros((8, 3)), PLANAR)
    at = Pass(belief, m, jnp.zeros((time, 3)), jnp.zeros((time, 3, 3)), jnp.zeros(time))
    transition = Odometry((0.001, 0.001, 0.004))
    for t in range(1, time):
        far = np.flatnonzero(np.abs(np.arange(time) - t) > chunk)
        expected = put_all(charts, prior, jax.tree.map(lambda rows, far=far: rows[far], readings), poses[far])
        np.testing.assert_allclose(at.m.weight, expected.weight, atol=1e-4 * float(expected.weight.max()))
        at = advance(charts, transition, chunk, jax.random.key(0), at, Log(controls, readings), jnp.array([t]), poses)
