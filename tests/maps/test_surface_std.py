"""Test the law of a surface's std against a float64 oracle, on planes and edges, with and without errors of poses."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings

from tests.helpers.analytic_room import Room
from tests.helpers.field_oracle import FieldOracle
from tests.helpers.random_maps import kinds, random_map, seeds
from tests.maps.test_pose_errors import CAMERA, COVARIANCES, POSES, oracle_variance
from vssm_gym.maps.pose_errors import PoseErrors
from vssm_gym.maps.surface_std import surface_std
from vssm_gym.maps.voxel_map import OBSERVED_PRECISION, VoxelMap

VOXEL = 0.07
STEP = Room(interior=((-2.0, -4.0, -4.0), (1.53, 4.0, 4.0)), boxes=(((1.1, -0.2, -4.0), (1.6, 0.5, 4.0)),))


def step(count: float) -> VoxelMap:
    """Return a wall at x = 1.53 with a pillar before it, of which every cell was observed ``count`` times."""
    m = STEP.to_map((-0.5, -1.6, -1.2), VOXEL, (40, 48, 40))
    return eqx.tree_at(lambda m: m.occupancy_precision, m, jnp.full_like(m.occupancy_precision, count))


def oracle(m: VoxelMap, p: np.ndarray, reading: float = 0.006) -> np.ndarray:
    """Return the law in float64, from its own interpolation of the cells."""
    field, h = FieldOracle.of(m), float(m.voxel_size)
    at = lambda q: field(q)[..., 0]
    n = np.asarray(m.precision(jnp.asarray(p, jnp.float32))[..., 0], float)
    bend2 = sum((at(p + e) - 2.0 * at(p) + at(p - e)) ** 2 for e in h * np.eye(3)) / h**2
    parts = reading**2 / n + (0.02 * h) ** 2 + h**2 * 0.41**2 * bend2 / (1.0 + 0.41**2 * bend2 / 0.38**2)
    return np.where(n > OBSERVED_PRECISION, np.sqrt(parts), np.inf)


@settings(max_examples=10)
@given(kinds, seeds)
def test_the_law_is_that_of_the_oracle(kind: str, seed: int) -> None:
    """For any field, at any point, however often it was observed."""
    m, drawn = random_map(kind, seed), np.random.default_rng([seed, 2])
    precision = jnp.asarray(np.exp(drawn.uniform(-5.0, 5.0, m.occupancy.shape)), jnp.float32)
    m = eqx.tree_at(lambda m: m.occupancy_precision, m, precision)
    low, high = m.bounds
    p = np.asarray(low + np.random.default_rng(seed).uniform(0.0, 1.0, (64, 3)) * (high - low), np.float32)
    found = np.asarray(surface_std(m, p))
    assert np.isfinite(found).mean() > 0.2
    np.testing.assert_allclose(found, oracle(m, p.astype(float)), rtol=2e-3)


def test_a_plane_by_hand() -> None:
    """Nine readings with 6 mm and cells of 7 cm: 2 mm of readings, 1.4 mm of cells, nothing of curvature."""
    std = float(surface_std(step(9.0), jnp.array([1.53, -0.9, 0.1])))
    assert std == pytest.approx(np.hypot(0.002, 0.0014), rel=1e-3)


def test_readings_do_not_remove_the_part_of_the_cells() -> None:
    """On a plane 1.4 mm are left; at the pillar's edge the bend alone is above 1 cm and no more than 0.38 cells."""
    m = step(1e6)
    plane, edge = surface_std(m, jnp.array([[1.53, -0.9, 0.1], [1.1, -0.2, 0.1]]))
    assert float(plane) == pytest.approx(0.0014, rel=1e-2)
    assert 0.01 < float(edge) < 0.38 * VOXEL * 1.01


def test_what_was_not_observed_has_no_finite_std() -> None:
    m = VoxelMap.prior((0.0, 0.0, 0.0), VOXEL, (16, 16, 16))
    assert np.isinf(float(surface_std(m, jnp.array([0.5, 0.5, 0.5]))))


@pytest.mark.parametrize("reading", [0.001, 0.03])
def test_the_reading_scales_its_part_alone(reading: float) -> None:
    std = float(surface_std(step(1.0), jnp.array([1.53, -0.9, 0.1]), reading))
    assert std == pytest.approx(np.hypot(reading, 0.0014), rel=1e-3)


def test_errors_of_poses_add_their_variance() -> None:
    """The normal of the wall is x: the variance of the poses' displacement along it is added to the law."""
    m, p = step(9.0), np.array([[1.53, -0.9, 0.1], [1.53, 0.9, 0.3]])
    errors = PoseErrors.of(POSES, COVARIANCES, CAMERA, reach=6.0)
    expected = np.sqrt(oracle(m, p) ** 2 + oracle_variance(p, np.array([1.0, 0.0, 0.0])))
    np.testing.assert_allclose(np.asarray(surface_std(m, jnp.asarray(p), pose_errors=errors)), expected, rtol=1e-3)
