"""Test samples of the map: moments of their surfaces against the stated law, walls that stay walls, moved poses."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.analytic_room import Room, camera_pose
from tests.helpers.localisation_room import CAMERA, GRID, ROOM
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import se3_exp
from vssm_gym.inference.mapping.map_update import update
from vssm_gym.maps.block_table import BlockTable
from vssm_gym.maps.pose_errors import PoseErrors
from vssm_gym.maps.surface_std import surface_std
from vssm_gym.maps.voxel_map import PRIOR_OCCUPANCY_STD, VoxelMap
from vssm_gym.model.emission import MAX_DEPTH, intersect, march, render, world_rays
from vssm_gym.model.map_samples import (
    DIRECTIONS,
    FIELDS,
    FREQUENCIES,
    Coefficients,
    MeasurementNoise,
    correlation,
    deform,
    draw_coefficients,
    sample_map,
)

VOXEL = 0.07
WALL = Room(interior=((-2.0, -4.0, -4.0), (1.53, 4.0, 4.0)))
PLACE = 1.53  # m, of the wall along x
READING = MeasurementNoise(depth=0.03)  # of a poor sensor, so that the wall is uncertain by 1 cm after 9 readings
STATED = np.hypot(0.01, 0.02 * VOXEL)
DRAWS = 120


def wall(slots: int | None = None) -> VoxelMap:
    """Return a room whose wall at x = 1.53 was observed nine times by every cell."""
    m = WALL.to_map((1.0, -1.6, -0.2), VOXEL, (16, 40, 8))
    precision = jnp.full_like(m.occupancy_precision, 9.0)
    m = eqx.tree_at(lambda m: (m.occupancy_precision, m.colour_precision), m, (precision, precision))
    if slots is None:
        return m
    n = m.occupancy.shape[0]
    sparse = VoxelMap.prior(m.origin, VOXEL, m.shape, slots=slots)
    arrays = lambda m: (m.occupancy, m.occupancy_precision, m.colour, m.colour_precision)
    filled = [new.at[1 : 1 + n].set(old) for new, old in zip(arrays(sparse), arrays(m), strict=True)]
    sparse = eqx.tree_at(arrays, sparse, tuple(filled))
    sparse = eqx.tree_at(lambda m: m.table, sparse, BlockTable.of(m.blocks, slots, np.arange(n)))
    return sparse.with_occupancy(sparse.occupancy)


@jax.jit
def surface(m: VoxelMap, yz: jax.Array) -> jax.Array:
    """Return the place of the wall along x at ``yz`` (..., 2), m; NaN where there is none within 12 cm."""
    x = PLACE + jnp.linspace(-0.12, 0.12, 49)
    p = jnp.concatenate(
        [jnp.broadcast_to(x[:, None], (*yz.shape[:-1], 49, 1)), jnp.repeat(yz[..., None, :], 49, -2)], -1
    )
    o = m.occupancy_at(p)
    before, after = o[..., :-1], o[..., 1:]
    rises = (before <= 0.0) & (after > 0.0)
    at = x[:-1] - before / jnp.where(after > before, after - before, 1.0) * (x[1] - x[0])
    return jnp.where(rises.any(-1), jnp.take_along_axis(at, jnp.argmax(rises, -1)[..., None], -1)[..., 0], jnp.nan)


def on_wall(y: np.ndarray, z: float = 0.11) -> jax.Array:
    return jnp.asarray(np.stack([y, np.full_like(y, z)], axis=-1), jnp.float32)


@pytest.fixture(scope="module")
def drawn() -> np.ndarray:
    """Return where the wall is (m, from its mean) in many samples, at points 7 mm apart along y."""
    m, yz = wall(), on_wall(np.arange(-1.0, 1.0, 0.007))
    keys = jax.random.split(jax.random.key(0), DRAWS)
    return np.asarray(jax.lax.map(lambda key: surface(sample_map(key, m, READING), yz), keys), float) - PLACE


@pytest.mark.slow
def test_the_mean_of_the_samples_is_the_map(drawn: np.ndarray) -> None:
    assert np.isfinite(drawn).all()
    assert np.abs(drawn.mean(axis=0)).max() < 4.5 * STATED / np.sqrt(DRAWS)
    assert abs(drawn.mean()) < 0.1 * STATED


def test_the_std_of_the_surface_is_the_stated_one(drawn: np.ndarray) -> None:
    """1.01 cm: 3 cm of a reading after nine of them, and 2 % of a cell. Between cells the grid smooths some away."""
    assert float(surface_std(wall(), jnp.array([PLACE, 0.0, 0.11]), 0.03)) == pytest.approx(STATED, rel=1e-3)
    spread = drawn.std(axis=0)
    assert np.sqrt(np.mean(spread**2)) == pytest.approx(STATED, rel=0.08)
    np.testing.assert_allclose(spread, STATED, rtol=0.3)


def test_points_of_a_wall_move_together(drawn: np.ndarray) -> None:
    """Their correlation is that of the field: near 1 within a cell, a half at 35 cm, a fifth at 70 cm."""
    found, m = [], wall()
    for lag in (10, 20, 50, 100, 200):
        pairs = (drawn[:, :-lag] * drawn[:, lag:]).mean(axis=0) / drawn.std(axis=0)[:-lag] / drawn.std(axis=0)[lag:]
        found.append((0.007 * lag, pairs.mean()))
    r, rho = np.array(found).T
    np.testing.assert_allclose(rho, np.asarray(correlation(jnp.asarray(r), m.voxel_size)), atol=0.2)
    assert rho[0] > 0.9
    assert (np.diff(rho) < 0.0).all()


def test_the_frequencies_give_the_stated_correlation() -> None:
    """``mean_f cos(omega_f . r)`` of 64 frequencies is within 0.04 of the squared exponential along every axis."""
    r = np.linspace(0.0, 2.0, 81)
    for axis in range(3):
        halves = [np.cos(np.outer(r / length, DIRECTIONS[:, axis])).mean(axis=1) for length in (2.0 * VOXEL, 0.5)]
        np.testing.assert_allclose(0.5 * sum(halves), np.asarray(correlation(jnp.asarray(r), VOXEL)), atol=0.04)


def test_walls_stay_walls(drawn: np.ndarray) -> None:
    """Over a cell the surface changes far less than it is displaced; were cells independent, by 1.4 times as much."""
    rough = (drawn[:, 10:] - drawn[:, :-10]).std()
    assert rough < 0.4 * drawn.std()


def test_a_sparse_map_moves_as_the_dense_one() -> None:
    yz = on_wall(np.arange(-0.9, 0.9, 0.05))
    places = [np.asarray(surface(sample_map(jax.random.key(3), m, READING), yz)) for m in (wall(), wall(slots=200))]
    np.testing.assert_allclose(places[1], places[0], atol=1e-5)


def test_samples_are_functions_of_their_coefficients() -> None:
    m = wall()
    none = Coefficients(jnp.zeros((FIELDS, 4 * FREQUENCIES)), jnp.zeros((0, 6)))
    np.testing.assert_allclose(np.asarray(deform(m, none).occupancy), np.asarray(m.occupancy), atol=1e-5)
    first, again, other = (sample_map(jax.random.key(seed), m) for seed in (5, 5, 6))
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
    assert not np.array_equal(np.asarray(first.occupancy), np.asarray(other.occupancy))
    made = deform(m, draw_coefficients(jax.random.key(5)))
    np.testing.assert_allclose(np.asarray(made.occupancy), np.asarray(first.occupancy), atol=1e-6)


def test_errors_of_poses_move_the_whole_room() -> None:
    """One keyframe whose pose is wrong by 5 cm and 2 degrees: every wall of the sample is where that motion puts it."""
    m = eqx.tree_at(lambda m: m.occupancy_precision, wall(), jnp.full_like(wall().occupancy_precision, 1e9))
    T = jnp.asarray(camera_pose((0.0, 0.0, 0.0), 0.0), jnp.float32)[None]
    xi = jnp.array([0.05, 0.02, 0.0, 0.0, 0.0, 0.035])
    errors = PoseErrors(T, jnp.diag(xi)[None], jnp.ones(1), Camera.from_hfov(64, 48, np.radians(90)))
    displaced = replace(m, pose_errors=errors)
    sample = deform(displaced, Coefficients(jnp.zeros((FIELDS, 4 * FREQUENCIES)), jnp.ones((1, 6))), READING)
    assert sample.pose_errors is None
    y = np.arange(-0.8, 0.8, 0.05)
    moved = np.asarray(se3_exp(xi), float)
    mean = np.stack([np.full_like(y, PLACE), y, np.full_like(y, 0.11)], axis=-1) @ moved[:3, :3].T + moved[:3, 3]
    found = np.asarray(surface(sample, jnp.asarray(mean[:, 1:], jnp.float32)))
    np.testing.assert_allclose(found, mean[:, 0], atol=1.5e-3)


@pytest.fixture(scope="module")
def seen() -> VoxelMap:
    """Return a room mapped from two images: observed in part, as real maps are."""
    m = VoxelMap.prior(*GRID)
    for yaw in (0.0, 0.4):
        T = camera_pose((-1.0, 0.0, 1.0), yaw)
        image = ROOM.image(T, CAMERA)
        m = update(m, image.depth, image.rgb, jnp.asarray(T, jnp.float32), CAMERA)
    return m


def test_what_was_not_observed_stays_so(seen: VoxelMap) -> None:
    """No sample adds a surface to unknown space: cells without an observation keep the prior, and about as many."""
    sample = sample_map(jax.random.key(1), seen)
    unseen = [np.asarray(m.occupancy_precision) == np.float32(PRIOR_OCCUPANCY_STD**-2) for m in (seen, sample)]
    np.testing.assert_array_equal(np.asarray(sample.occupancy)[unseen[1]], np.asarray(seen.occupancy)[unseen[0]].max())
    assert unseen[1].mean() == pytest.approx(unseen[0].mean(), abs=0.01)
    assert 0.1 < unseen[0].mean() < 0.9


def test_samples_are_searched_by_their_own_index(seen: VoxelMap) -> None:
    """With a stale index rays would skip surfaces of the sample; the fixed march skips nothing."""
    drawn = sample_map(jax.random.key(2), seen, MeasurementNoise(depth=0.1))
    T = jnp.asarray(camera_pose((-1.0, 0.0, 1.0), 0.2), jnp.float32)
    image = render(drawn, T, CAMERA)
    centre, directions = world_rays(T, CAMERA)
    k, hit = march(drawn, centre, directions, MAX_DEPTH)
    depth = np.where(hit, np.asarray(intersect(drawn, centre, directions, jnp.where(hit, k, 2))), 0.0)
    assert np.mean(np.abs(depth - np.asarray(image.depth).reshape(-1)) > 1e-3) < 1e-3
