"""Test the rotation between two images: known turns are found, and untextured images give none."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers.analytic_room import camera_pose
from tests.helpers.localisation_room import ROOM
from tests.helpers.random_maps import seeds
from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.alignment.residuals import luminance
from vssm_gym.inference.alignment.rotation import RotationConfig, camera_rotation

CAMERA = Camera.from_hfov(160, 120, np.radians(70.0))
CONFIG = RotationConfig()
find = jax.jit(camera_rotation, static_argnums=3)


def turn(seed: int, degrees: float) -> np.ndarray:
    axis = np.random.default_rng(seed).standard_normal(3)
    return np.asarray(jaxlie.SO3.exp(jnp.asarray(np.radians(degrees) * axis / np.linalg.norm(axis))).as_matrix(), float)


def seen(T: np.ndarray) -> jax.Array:
    return luminance(ROOM.image(T, CAMERA).rgb)


def sky(seed: int, R: np.ndarray) -> jax.Array:
    """Return brightness by direction, with amplitudes that fall with frequency as in natural images."""
    rng = np.random.default_rng([seed, 2])
    size = np.geomspace(1.0, 20.0, 40)
    waves = rng.standard_normal((40, 3))
    waves *= (size / np.linalg.norm(waves, axis=-1))[:, None]
    d = np.asarray(CAMERA.rays(), float) @ R.T
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    value = np.sin(d @ waves.T + rng.uniform(0.0, 6.3, 40)) @ (1.0 / size)
    return jnp.asarray(0.5 + 0.1 * value, jnp.float32)


def angle(R: np.ndarray) -> float:
    """Return degrees."""
    return float(np.degrees(np.linalg.norm(np.asarray(jaxlie.SO3.from_matrix(jnp.asarray(R, jnp.float32)).log()))))


def room_pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng([seed, 1])
    return camera_pose(tuple(rng.uniform([-0.6, -0.4, 0.6], [0.0, 0.4, 1.2])), *rng.uniform(-0.4, 0.4, 3))


def turned(T: np.ndarray, R: np.ndarray) -> np.ndarray:
    after = T.copy()
    after[:3, :3] = T[:3, :3] @ R
    return after


@settings(max_examples=40)
@given(seeds, st.floats(0.0, 12.0))
def test_a_known_rotation_is_found(seed: int, degrees: float) -> None:
    """About any axis, to a third of a degree: a third of a pixel of the image it is found on."""
    R = turn(seed, degrees)
    found = np.asarray(find(sky(seed, R), sky(seed, np.eye(3)), CAMERA, CONFIG), float)
    assert angle(R.T @ found) < 0.3


@settings(max_examples=20)
@given(seeds, st.floats(0.0, 4.0))
def test_a_known_rotation_in_a_room_is_found(seed: int, degrees: float) -> None:
    """Depth does not matter. Patterns that repeat every 20 degrees are ambiguous from a quarter of that on."""
    T, R = room_pose(seed), turn(seed, degrees)
    found = np.asarray(find(seen(turned(T, R)), seen(T), CAMERA, CONFIG), float)
    assert angle(R.T @ found) < 0.3


@settings(max_examples=10)
@given(seeds)
def test_swapping_the_images_turns_back(seed: int) -> None:
    T, R = room_pose(seed), turn(seed, 3.0)
    a, b = seen(T), seen(turned(T, R))
    there, back = (np.asarray(find(x, y, CAMERA, CONFIG), float) for x, y in ((b, a), (a, b)))
    assert angle(there @ back) < 0.4


@settings(max_examples=10)
@given(seeds)
def test_an_image_and_itself_are_not_turned(seed: int) -> None:
    image = seen(room_pose(seed))
    np.testing.assert_allclose(np.asarray(find(image, image, CAMERA, CONFIG)), np.eye(3), atol=1e-5)


@pytest.mark.parametrize("grey", [0.0, 0.5, 1.0])
def test_images_without_texture_give_no_rotation(grey: float) -> None:
    """The result is the identity and no NaN, for every other image."""
    blank, image = jnp.full((120, 160), grey), seen(room_pose(3))
    for last, now in ((blank, blank), (blank, image)):
        np.testing.assert_allclose(np.asarray(find(now, last, CAMERA, CONFIG)), np.eye(3), atol=1e-5)
    lost = np.asarray(find(blank, image, CAMERA, CONFIG), float)
    np.testing.assert_allclose(lost @ lost.T, np.eye(3), atol=1e-4)


@settings(max_examples=10)
@given(seeds)
def test_noise_gives_a_rotation_all_the_same(seed: int) -> None:
    """Two unrelated images give some rotation, finite and orthogonal."""
    a, b = np.random.default_rng(seed).uniform(size=(2, 120, 160))
    R = np.asarray(find(jnp.asarray(a, jnp.float32), jnp.asarray(b, jnp.float32), CAMERA, CONFIG), float)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-4)
    assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-4)


def test_a_brighter_image_gives_the_same_rotation() -> None:
    """A change of a few grey levels beyond the elbow of the robust loss has little effect."""
    T, R = room_pose(2), turn(2, 3.0)
    found = np.asarray(find(seen(turned(T, R)) + 0.03, seen(T), CAMERA, CONFIG), float)
    assert angle(R.T @ found) < 0.5
