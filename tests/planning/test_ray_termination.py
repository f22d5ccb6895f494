"""Test where imagined rays end: the ground in closed form, and unknown space against fine sampling."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers.analytic_room import camera_pose, ray_directions
from tests.helpers.random_maps import ORIGIN, SHAPE, VOXEL, seeds
from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.mapping.observation import MapUpdateConfig
from vssm_gym.maps.voxel_map import PRIOR_OCCUPANCY_STD, VoxelMap
from vssm_gym.planning.exploration.information import InformationConfig, expected_gain
from vssm_gym.planning.exploration.information.ray_termination import end_rays

CAMERA = Camera.from_hfov(12, 9, 1.3)
FAR = np.full((2, CAMERA.height, CAMERA.width), 3.0, np.float32)


def poses(seed: int) -> np.ndarray:
    """Return two camera poses in the grid."""
    rng = np.random.default_rng(seed)
    low = np.array(ORIGIN)
    places = low + VOXEL * np.array(SHAPE) * rng.uniform(0.1, 0.9, (2, 3))
    return np.stack([camera_pose(tuple(p), *rng.uniform(-1.0, 1.0, 2)) for p in places])


def speckled(seed: int, sparse: bool) -> VoxelMap:
    """Return a map of which a random half of the cells, in clusters, was observed."""
    m = VoxelMap.prior(ORIGIN, VOXEL, SHAPE)
    known = np.random.default_rng(seed).random(SHAPE) < 0.5
    precision = np.where(known, 1.0, PRIOR_OCCUPANCY_STD**-2).astype(np.float32)
    nx, ny, nz = (n // 8 for n in SHAPE)
    blocks = precision.reshape(nx, 8, ny, 8, nz, 8).transpose(0, 2, 4, 1, 3, 5).reshape(m.occupancy_precision.shape)
    if not sparse:
        return eqx.tree_at(lambda m: m.occupancy_precision, m, jnp.asarray(blocks))
    stored = np.random.default_rng(seed).permutation(len(blocks))
    m = VoxelMap.prior(ORIGIN, VOXEL, SHAPE, slots=len(blocks) + 1)
    table = type(m.table).of(m.blocks, len(blocks) + 1, stored)
    rows = np.concatenate([np.full((1, 512), PRIOR_OCCUPANCY_STD**-2, np.float32), blocks[stored]])
    return eqx.tree_at(lambda m: (m.occupancy_precision, m.table), m, (jnp.asarray(rows), table))


def test_without_ground_and_hazard_nothing_changes() -> None:
    np.testing.assert_array_equal(end_rays(FAR, poses(0), CAMERA, speckled(0, False), 0.0, -np.inf), FAR)


@given(seed=seeds, ground=st.floats(-0.5, 0.3))
def test_rays_end_at_the_ground(seed: int, ground: float) -> None:
    """``p_z = ground`` where a ray was cut, ``p_z >= ground`` everywhere."""
    T = poses(seed)
    ended = end_rays(FAR, T, CAMERA, VoxelMap.prior(ORIGIN, VOXEL, SHAPE), 0.0, ground)
    for pose, image in zip(T, ended, strict=True):
        z = pose[2, 3] + image.reshape(-1).astype(float) * ray_directions(pose, CAMERA)[:, 2]
        cut = image.reshape(-1) < FAR[0, 0, 0]
        assert (z > ground - 1e-5).all()
        np.testing.assert_allclose(z[cut], ground, atol=1e-5)


@given(seed=seeds, unknown=st.floats(0.05, 2.0))
def test_in_unknown_space_rays_have_the_configured_length(seed: int, unknown: float) -> None:
    """This holds inside the map and outside of it."""
    T = poses(seed)
    ended = end_rays(FAR, T, CAMERA, VoxelMap.prior(ORIGIN, VOXEL, SHAPE), 1.0 / unknown, -np.inf)
    for pose, image in zip(T, ended, strict=True):
        length = image.reshape(-1) * np.linalg.norm(ray_directions(pose, CAMERA), axis=1)
        np.testing.assert_allclose(length, np.minimum(unknown, 3.0 * length / image.reshape(-1)), rtol=1e-5)


@pytest.mark.parametrize("sparse", [False, True])
@settings(max_examples=12)
@given(seed=seeds, unknown=st.floats(0.2, 2.0))
def test_the_length_through_unknown_cells_is_limited(sparse: bool, seed: int, unknown: float) -> None:
    """The limit agrees with the same integral in steps of a fiftieth, on average to within a cell's diagonal."""
    m, T = speckled(seed, sparse), poses(seed)
    precision, origin = np.asarray(m.dense(m.occupancy_precision)).reshape(m.shape), np.asarray(m.origin)
    ended = end_rays(FAR, T, CAMERA, m, 1.0 / unknown, -np.inf)
    off = []
    for pose, image in zip(T, ended, strict=True):
        for ray, end in zip(ray_directions(pose, CAMERA), image.reshape(-1).astype(float), strict=True):
            length = float(np.linalg.norm(ray))
            s = (np.arange(round(end * length / (0.02 * VOXEL))) + 0.5) * 0.02 * VOXEL
            cell = np.rint((pose[:3, 3] + s[:, None] / length * ray - origin) / VOXEL).astype(int)
            inside = np.all((cell >= 0) & (cell < m.shape), axis=1)
            held = np.where(inside[:, None], cell, 0)
            hidden = ~inside | (precision[tuple(held.T)] < 0.1)
            way = 0.02 * VOXEL * hidden.sum()
            off.append(way - unknown if end < 3.0 - 1e-6 else min(0.0, unknown - way))
    assert np.abs(off).mean() < 2.0 * VOXEL
    assert np.abs(off).max() < 0.5 * unknown + 5.0 * VOXEL


def test_a_hazard_field_ends_rays_where_surfaces_are_expected() -> None:
    """A uniform field over the columns equals a number; a dense stripe ends the rays across it."""
    m = VoxelMap.prior(ORIGIN, VOXEL, SHAPE)
    np.testing.assert_array_equal(
        end_rays(FAR, poses(1), CAMERA, m, np.full(SHAPE[:2], 0.8), -np.inf),
        end_rays(FAR, poses(1), CAMERA, m, 0.8, -np.inf),
    )
    start = np.array(ORIGIN) + VOXEL * np.array([2.0, SHAPE[1] / 2.0, SHAPE[2] / 2.0])
    T = np.stack([camera_pose(tuple(start), yaw, 0.0) for yaw in (0.0, np.pi)])  # along x and away from it
    stripe = np.full(SHAPE[:2], 0.01)
    stripe[10:13] = 20.0
    ahead, behind = end_rays(FAR, T, CAMERA, m, stripe, -np.inf)
    # One surface is expected after 5 cm of the stripe; it begins at the edge of its first column.
    first = (10.0 - 0.5 - 2.0) * VOXEL
    middle = ahead[CAMERA.height // 2, CAMERA.width // 2]
    assert first < middle < first + 0.05 + 2.0 * VOXEL
    np.testing.assert_array_equal(behind, FAR[0])


def test_the_expected_gain_falls_with_the_hazard_and_below_the_ground() -> None:
    """A larger hazard ends rays earlier, and a ray that ends at the ground observes nothing below it."""
    m, T = VoxelMap.prior(ORIGIN, VOXEL, SHAPE), poses(3)[:, None]
    clear = MapUpdateConfig(max_depth=3.0)

    config = InformationConfig(pixels=None, every=1, update=clear, max_depth=3.0)
    every, some, few = (expected_gain(m, T, CAMERA, config, hazard=hazard).total for hazard in (0.0, 1.0, 2.0))
    assert (few < some).all() and (some < every).all()
    down = np.stack([camera_pose((0.0, 0.0, 1.2), yaw, 0.5) for yaw in (0.0, 1.0)])[:, None]
    on_ground = replace(config, ground=0.6)
    assert (expected_gain(m, down, CAMERA, on_ground).total < expected_gain(m, down, CAMERA, config).total).all()
