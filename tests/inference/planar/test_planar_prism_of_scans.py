"""Test SLAM with a laser scanner against exact scans of a room: emission, update, alignment, and whole drives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vssm_gym.data.laser_logs import LaserLog
from vssm_gym.data.traversals import errors, traverse
from vssm_gym.envs.physics.planar import scan
from vssm_gym.envs.tasks.mazes import load_maze
from vssm_gym.errors import InputError
from vssm_gym.geometry.planar_poses import compose, relation
from vssm_gym.inference.particles import BootstrapFilter, ParticleBelief
from vssm_gym.inference.planar import PlanarPrism
from vssm_gym.inference.planar.config import PlanarConfig
from vssm_gym.inference.planar.scan_alignment import align
from vssm_gym.inference.planar.scan_update import update
from vssm_gym.maps.planar_map import PlanarMap
from vssm_gym.model.scan_emission import OccupancyScans, ScanLikelihood, render_scan
from vssm_gym.model.scan_model import ScanModel
from vssm_gym.model.scanner import Scanner
from vssm_gym.model.transition import Imu, ImuNoise, planar_belief
from vssm_gym.model.transition.manifold import PLANAR
from vssm_gym.model.transition.odometry import Odometry
from vssm_gym.slam.planar_run import loop_errors, run_scans

BEAMS, CELL = 64, 0.01
MAZE = load_maze("pillars-v1")
ANGLES = 2.0 * np.pi * np.arange(BEAMS) / BEAMS
PLACES = np.array([[0.1, 0.1, 0.3], [0.5, 0.9, -2.0], [0.9, 0.5, 1.0], [0.3, 0.5, 3.0], [0.7, 0.3, -1.0]])


def scanner(mount: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Scanner:
    return Scanner(jnp.asarray(ANGLES, jnp.float32), jnp.asarray(mount, jnp.float32), jnp.float32(1.5))


def measured(state: np.ndarray, mount: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> jax.Array:
    return jnp.asarray(scan(compose(state, np.array(mount))[None], MAZE.rectangles, BEAMS)[0], jnp.float32)


@pytest.fixture(scope="module")
def mapped() -> PlanarMap:
    """Return the map of scans from free places all over the maze."""
    m = PlanarMap.prior(np.array([-0.05, -0.05]), np.array([1.05, 1.05]), CELL)
    places = MAZE.space.sample(np.random.default_rng(0), 400)
    for k, xy in enumerate(places):
        state = np.array([*xy, 0.1 * k])
        m = STEP(m, measured(state), jnp.asarray(state, jnp.float32))
    return m


STEP = jax.jit(lambda m, ranges, state: update(m, ranges, state, scanner(), PlanarConfig()))


def test_a_map_of_a_circle_is_its_distance():
    """A scan from the middle of a circle of 0.4 m: the occupancy of a cell in the band is its distance behind it."""
    m = PlanarMap.prior(np.array([-0.6, -0.6]), np.array([0.6, 0.6]), 0.02)
    m = update(m, jnp.full(BEAMS, 0.4), jnp.zeros(3), scanner(), PlanarConfig())
    behind = np.linalg.norm(np.asarray(m.centres()), axis=-1) - 0.4
    band = 4.0 * 0.02
    seen = behind < band - 1e-3
    np.testing.assert_allclose(np.asarray(m.occupancy)[seen], np.clip(behind, -band, band)[seen], atol=1e-3)
    assert not m.observed[behind > band + 1e-3].any() and m.observed[seen].all()
    np.testing.assert_allclose(render_scan(m, scanner(), jnp.zeros(3)), 0.4, atol=1e-3)


def test_a_reading_that_is_missing_says_nothing():
    m = PlanarMap.prior(np.array([-0.6, -0.6]), np.array([0.6, 0.6]), 0.02)
    after = update(m, jnp.zeros(BEAMS), jnp.zeros(3), scanner(), PlanarConfig())
    np.testing.assert_array_equal(after.occupancy, m.occupancy)
    np.testing.assert_array_equal(after.precision, m.precision)


def test_half_a_circle_updates_no_cell_behind_the_scanner():
    half = Scanner(jnp.linspace(-np.pi / 2, np.pi / 2, 33), jnp.zeros(3), jnp.float32(1.5))
    m = PlanarMap.prior(np.array([-0.6, -0.6]), np.array([0.6, 0.6]), 0.02)
    m = update(m, jnp.full(33, 0.4), jnp.zeros(3), half, PlanarConfig())
    x = np.asarray(m.centres())[..., 0]
    assert m.observed[x > 0.05].any() and not m.observed[x < -0.05].any()


@pytest.mark.parametrize("mount", [(0.0, 0.0, 0.0), (0.03, -0.01, 0.4)])
def test_the_map_predicts_what_is_measured(mapped, mount):
    for state in PLACES:
        predicted = np.asarray(render_scan(mapped, scanner(mount), jnp.asarray(state, jnp.float32)))
        off = np.abs(predicted - np.asarray(measured(state, mount)))
        assert np.median(off) < 0.3 * CELL and np.mean(off < 3.0 * CELL) > 0.9


@pytest.mark.parametrize("k", range(len(PLACES)))
def test_a_scan_finds_its_pose(mapped, k):
    """From 2 cm and 3 degrees off; the covariance shrinks and stays symmetric and positive."""
    true, rng = PLACES[k], np.random.default_rng(k)
    start = compose(true, rng.normal(0.0, [0.012, 0.012, 0.05]))
    prior = planar_belief(jnp.asarray(start, jnp.float32), jnp.diag(jnp.array([0.03, 0.03, 0.1]) ** 2))
    found = align(mapped, measured(true), prior, scanner(), PlanarConfig())
    off = relation(true, np.asarray(found.belief.mean, float))
    assert np.hypot(*off[:2]) < 0.3 * CELL and abs(off[2]) < 0.01
    assert float(found.used) > 0.8
    assert (np.linalg.eigvalsh(np.asarray(found.belief.covariance, float)) > 0.0).all()
    assert float(jnp.trace(found.belief.covariance)) < 0.1 * float(jnp.trace(prior.covariance))


def test_a_scan_of_nothing_known_leaves_the_prior():
    m = PlanarMap.prior(np.array([-1.0, -1.0]), np.array([1.0, 1.0]), 0.02)
    prior = planar_belief(jnp.array([0.1, 0.2, 0.3]), jnp.diag(jnp.array([0.03, 0.02, 0.1]) ** 2))
    found = align(m, jnp.full(BEAMS, 0.4), prior, scanner(), PlanarConfig())
    np.testing.assert_allclose(found.belief.mean, prior.mean, atol=1e-6)
    np.testing.assert_allclose(found.belief.covariance, prior.covariance, rtol=1e-3)
    assert float(found.used) == 0.0


def test_particles_and_gauss_newton_agree(mapped):
    """The same scan, weighed at particles by the density of its ranges, has its mean where the alignment has it."""
    true = PLACES[3]
    spread = jnp.diag(jnp.array([0.01, 0.01, 0.03]) ** 2)
    prior = planar_belief(jnp.asarray(compose(true, np.array([0.008, -0.005, 0.03])), jnp.float32), spread)
    aligned = align(mapped, measured(true), prior, scanner(), PlanarConfig()).belief
    likelihood = ScanLikelihood(measured(true), OccupancyScans(mapped, scanner(), 0.5 * CELL, 0.05))
    drawn = ParticleBelief.of(prior.sample(jax.random.key(0), 3000), PLANAR)
    found = BootstrapFilter(Odometry((0.01, 0.01, 0.03))).observe(drawn, likelihood).belief
    assert float(found.effective) > 10.0
    assert np.hypot(*relation(true, np.asarray(found.mean, float))[:2]) < 0.5 * CELL
    assert np.hypot(*relation(np.asarray(aligned.mean, float), np.asarray(found.mean, float))[:2]) < 0.5 * CELL


@pytest.fixture(scope="module")
def drive() -> LaserLog:
    return traverse(MAZE, 400, seed=1)


@pytest.mark.slow
def test_a_drive_is_tracked_better_than_by_its_odometry(drive):
    run = run_scans(drive, CELL)
    off, integrated = errors(drive, run.poses), errors(drive, drive.path())
    assert off.max() < 1.5 * CELL < integrated.max()
    assert run.used[1:].min() > 0.5
    true = relation(drive.poses[:1], drive.poses)
    xi = np.asarray(PLANAR.error(jnp.asarray(run.poses, jnp.float32), jnp.asarray(true, jnp.float32)), float)
    nees = np.einsum("ti,tij,tj->t", xi, np.linalg.inv(run.covariance), xi) / 3.0
    assert 0.2 < np.median(nees) < 4.0  # the drift of the map is no part of the covariance
    assert len(run.poses) == len(run.covariance) == len(run.used) == len(drive)


def test_nothing_that_is_for_the_judge_is_read(drive):
    """Other poses and other loops in the log change no estimate."""
    blind = LaserLog(
        drive.ranges, drive.angles, drive.max_range, drive.mount, drive.motions, None,
        np.array([[0, 50]]), np.array([[9.0, 9.0, 9.0]]),
    )  # fmt: skip
    few = lambda log: LaserLog(
        log.ranges[:101], log.angles, log.max_range, log.mount, log.motions[:100],
        None if log.poses is None else log.poses[:101], log.loops, log.relations,
    )  # fmt: skip
    np.testing.assert_array_equal(run_scans(few(blind), CELL).poses, run_scans(few(drive), CELL).poses)


def test_errors_over_loops_by_hand():
    log = LaserLog(
        np.ones((3, 4)), np.arange(4.0), 2.0, np.zeros(3), np.zeros((2, 3)), None,
        np.array([[0, 2], [2, 1]]), np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 3.1]]),
    )  # fmt: skip
    found = loop_errors(log, np.array([[0.0, 0.0, 0.0], [1.0, 0.0, -3.1], [1.0, 0.5, 0.0]]))
    np.testing.assert_allclose(found, [[0.5, 0.0], [0.5, 2.0 * np.pi - 6.2]], atol=1e-6)


def test_what_does_not_fit_is_refused(drive):
    with pytest.raises(InputError, match="max-range: expected above 0 m, not 0"):
        run_scans(drive, CELL, max_range=0.0)
    with pytest.raises(InputError, match="cell_size: expected 2 x 2 to 40,000,000 cells"):
        run_scans(drive, 1e-5)
    with pytest.raises(InputError, match="transition: expected one of a robot in the plane; found Imu"):
        PlanarPrism(scanner(), Imu(ImuNoise(0.1, 0.6, 0.2, 0.3)))
    with pytest.raises(InputError, match="iterations: expected at least 1, not 0"):
        PlanarConfig(iterations=0)
    with pytest.raises(InputError, match="band: expected above 0"):
        PlanarConfig(band=0.0)


def test_an_occupancy_map_is_a_model_of_scans(mapped):
    model = OccupancyScans(mapped, scanner(), 0.5 * CELL)
    assert isinstance(model, ScanModel)
    states = jnp.asarray(np.array(PLACES[:2]), jnp.float32)
    predicted = model.ranges(states)
    assert predicted.shape == (2, BEAMS) and bool(jnp.all(predicted > 0.0))
    drawn = jax.vmap(model.sample, (0, None))(jax.random.split(jax.random.key(0), 400), states)
    np.testing.assert_allclose(jnp.mean(drawn, axis=0), predicted, atol=0.4 * CELL)
    np.testing.assert_allclose(
        jnp.mean(jnp.abs(drawn - predicted)), 0.5 * CELL, rtol=0.05
    )  # b of a Laplace distribution
    again = model.draw_map(jax.random.key(1))
    away = np.asarray((again.m.occupancy - mapped.occupancy) * jnp.sqrt(mapped.precision))
    solid = mapped.observed & (np.asarray(mapped.occupancy) > 0.5 * CELL) & (np.asarray(mapped.occupancy) < 3.0 * CELL)
    assert abs(away[solid].std() - 1.0) < 0.05 and np.abs(again.ranges(states) - predicted).max() > 0.0
    np.testing.assert_allclose(again.ranges(states), predicted, atol=6.0 * CELL)


@pytest.mark.slow
def test_unknown_space_of_a_drawn_map_lets_beams_pass():
    """The first thing that a beam meets there is ``free_path`` cells away on average, and no draw skips what is solid.

    A beam is about a cell wide: solid cells are corners of the grid, with slopes to their free neighbours.
    """
    m = PlanarMap.prior(np.array([-1.0, -1.0]), np.array([1.0, 1.0]), 0.01)
    for free_path in (10.0, 20.0):
        model = OccupancyScans(m, scanner(), 0.5 * CELL, free_path=free_path)
        drawn = [model.draw_map(jax.random.key(k)) for k in range(12)]
        drawn = [one for one in drawn if float(one.m.occupancy_at(jnp.zeros(2))) < 0.0]  # not in what is solid
        met = np.concatenate([np.asarray(one.ranges(jnp.zeros(3))) for one in drawn])
        assert 0.6 < met.mean() / (free_path * CELL) < 1.6, free_path
    ends = model.scanner.endpoints(jnp.zeros(3), drawn[0].ranges(jnp.zeros(3)))
    np.testing.assert_allclose(drawn[0].m.occupancy_at(ends), 0.0, atol=CELL)


def test_ranges_are_differentiable_in_the_pose(mapped):
    model, state = OccupancyScans(mapped, scanner(), 0.5 * CELL), jnp.asarray(PLACES[0], jnp.float32)
    J = np.asarray(jax.jacrev(model.ranges)(state))[:, :2]
    ahead = np.stack([np.cos(ANGLES + PLACES[0][2]), np.sin(ANGLES + PLACES[0][2])], axis=-1)
    assert np.median(-(J * ahead).sum(axis=1)) == pytest.approx(1.0, abs=0.1)  # a step ahead is a step nearer
