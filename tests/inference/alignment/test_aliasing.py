"""Test that a pose is unique: no shifted pose explains the image as well."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.analytic_room import Room, camera_pose
from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.alignment.aliasing import is_unique
from vssm_gym.inference.alignment.residuals import AlignConfig
from vssm_gym.model.emission import RGBD

CAMERA = Camera.from_hfov(80, 60, np.radians(70.0))
ROOM = Room(((-2.0, -1.6, 0.0), (2.2, 1.7, 2.3)), (((0.9, -0.4, 0.0), (1.4, 0.5, 0.8)),))
CONFIG = AlignConfig()
WALL = camera_pose((0.8, 0.2, 1.5), 0.0)  # sees one wall and nothing else
CORNER = camera_pose((-0.8, 0.1, 1.1), 0.1, 0.2)


def striped(period: float, seed: int) -> RGBD:
    """Return the wall with a vertical stripe every ``period`` metres, a level edge, and noise."""
    image = ROOM.image(WALL, CAMERA)
    x, y, _ = np.moveaxis(np.asarray(CAMERA.backproject(image.depth)), -1, 0)
    away = np.abs((x / period + 0.5) % 1.0 - 0.5) * period  # m, from the middle of the nearest stripe
    grey = 0.4 + 0.3 / (1.0 + np.exp((away - 0.15 * period) / 0.01)) + 0.1 / (1.0 + np.exp((0.1 - y) / 0.01))
    grey = grey + np.random.default_rng(seed).normal(0.0, 0.02, grey.shape)
    return eqx.tree_at(lambda i: i.rgb, image, jnp.asarray(grey[..., None] * np.ones(3), jnp.float32))


def unique(T: jax.Array, reference: RGBD, image: RGBD) -> bool:
    return bool(is_unique(T, jnp.eye(6), reference, image, CAMERA, CONFIG))


@pytest.mark.parametrize(("period", "expected"), [(0.3, False), (0.2, False), (3.0, True)])
def test_a_wall_of_equal_stripes_fits_at_several_places(period: float, expected: bool) -> None:
    assert unique(jnp.eye(4), striped(period, 0), striped(period, 1)) == expected


def test_a_plain_wall_fits_everywhere_along_it() -> None:
    wall = ROOM.image(WALL, CAMERA)
    plain = eqx.tree_at(lambda i: i.rgb, wall, jnp.full_like(wall.rgb, 0.5))
    assert not unique(jnp.eye(4), plain, plain)


def test_a_corner_with_its_colours_is_unique() -> None:
    image = ROOM.image(CORNER, CAMERA)
    assert unique(jnp.eye(4), image, image)


def test_an_image_without_any_reading_is_not_unique() -> None:
    """Nothing is confirmed if nothing can be compared."""
    image = ROOM.image(CORNER, CAMERA)
    empty = jax.tree.map(jnp.zeros_like, image)
    assert not unique(jnp.eye(4), image, empty) and not unique(jnp.eye(4), empty, image)
    assert not unique(jnp.full((4, 4), jnp.nan), image, image)
