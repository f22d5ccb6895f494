"""Test keyframes: a ring of images from distinct poses, searched by similarity."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings

from tests.helpers.analytic_room import camera_pose
from tests.helpers.localisation_room import ROOM
from tests.helpers.random_maps import seeds
from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.alignment.residuals import luminance
from vssm_gym.inference.alignment.rotation import RotationConfig
from vssm_gym.inference.tracking import keyframes
from vssm_gym.inference.tracking.keyframes import KeyframeConfig, Keyframes, remember, similar

CAMERA = Camera.from_hfov(160, 120, np.radians(70.0))
CAPACITY = 6
RING = KeyframeConfig(capacity=CAPACITY)
CONFIG = RotationConfig()
RNG = np.random.default_rng(0)
PICTURES = jnp.asarray(RNG.uniform(size=(3 * CAPACITY, 120, 160)), jnp.float32)


def f32(a: np.ndarray) -> jax.Array:
    return jnp.asarray(a, jnp.float32)


def seen(T: np.ndarray) -> jax.Array:
    return luminance(ROOM.image(T, CAMERA).rgb)


def keep(kept: Keyframes, T: np.ndarray, grey: jax.Array) -> Keyframes:
    return remember(kept, f32(T), grey, CAMERA)


def nothing() -> Keyframes:
    return keyframes.empty(CAMERA, RING)


def test_poses_near_a_keyframe_are_not_stored() -> None:
    """A pose is near if both its position and its rotation are close."""
    start = camera_pose((0.0, 0.0, 1.0), 0.0)
    kept = keep(nothing(), start, PICTURES[0])
    assert int(kept.count) == 1
    for x, yaw, is_new in (
        (0.0, 0.0, False),
        (0.9 * RING.distance, 0.0, False),
        (0.0, 0.95 * RING.angle, False),
        (0.9 * RING.distance, 0.95 * RING.angle, False),
        (1.1 * RING.distance, 0.0, True),
        (0.0, -1.1 * RING.angle, True),
    ):
        before = int(kept.count)
        kept = keep(kept, camera_pose((x, 0.0, 1.0), yaw), PICTURES[1])
        assert int(kept.count) - before == int(is_new), (x, yaw)


def test_a_pose_that_is_not_stored_changes_nothing() -> None:
    T = camera_pose((0.0, 0.0, 1.0), 0.0)
    kept = keep(nothing(), T, PICTURES[0])
    before = jax.tree.map(np.asarray, jax.tree.map(jnp.copy, kept))
    after = keep(kept, T, PICTURES[1])
    jax.tree.map(np.testing.assert_array_equal, before, jax.tree.map(np.asarray, after))


@settings(max_examples=10)
@given(seeds)
def test_the_oldest_are_overwritten_first(seed: int) -> None:
    """After any number of images the ring holds the newest, each with its own pose."""
    many = 1 + seed % (3 * CAPACITY)
    kept = nothing()
    for k in range(many):
        kept = keep(kept, camera_pose((1.0 * k, 0.0, 0.0), 0.0), PICTURES[k])
    assert int(kept.count) == many
    held = min(many, CAPACITY)
    places = np.asarray(kept.T_world_cam[:held, 0, 3])
    assert sorted(places) == list(range(many - held, many))
    for place, thumbnail in zip(places, np.asarray(kept.thumbnails), strict=False):
        alone = keep(nothing(), np.eye(4), PICTURES[int(place)])
        np.testing.assert_allclose(thumbnail, np.asarray(alone.thumbnails[0]), atol=1e-6)


def test_an_overwritten_pose_can_be_stored_again() -> None:
    kept = nothing()
    for k in range(CAPACITY + 1):
        kept = keep(kept, camera_pose((1.0 * k, 0.0, 0.0), 0.0), PICTURES[k])
    kept = keep(kept, camera_pose((0.0, 0.0, 0.0), 0.0), PICTURES[0])  # its slot went to the last one
    assert int(kept.count) == CAPACITY + 2


PLACES = [camera_pose((-0.4, -0.2 * k + 0.4, 1.0), 1.1 * k, 0.1) for k in range(5)]
LEFT = np.linalg.inv(camera_pose((0.0, 0.0, 0.0), 0.0)) @ camera_pose((0.0, 0.0, 0.0), 0.05)


def gallery() -> Keyframes:
    kept = nothing()
    for T in PLACES:
        kept = keep(kept, T, seen(T))
    return kept


def test_the_most_similar_keyframe_is_found_and_turned() -> None:
    """For a view turned by 3 degrees from a keyframe, that keyframe comes first, with the same turn."""
    kept = gallery()
    for k, T in enumerate(PLACES):
        found = np.asarray(similar(kept, seen(T @ LEFT), CAMERA, CONFIG, 3), float)
        assert found.shape == (3, 4, 4)
        np.testing.assert_allclose(found[0, :3, 3], T[:3, 3], atol=1e-5, err_msg=str(k))
        np.testing.assert_allclose(found[0, :3, :3], (T @ LEFT)[:3, :3], atol=0.01)


def test_brightness_does_not_matter() -> None:
    kept, dim = gallery(), 0.5 * seen(PLACES[2]) + 0.2
    found = np.asarray(similar(kept, dim, CAMERA, CONFIG, 1), float)
    np.testing.assert_allclose(found[0, :3, 3], PLACES[2][:3, 3], atol=1e-5)


def test_without_keyframes_the_identity_is_guessed() -> None:
    """A black image, which resembles no keyframe, gives finite poses too."""
    found = np.asarray(similar(nothing(), seen(PLACES[0]), CAMERA, CONFIG, 2))
    np.testing.assert_allclose(found, np.tile(np.eye(4), (2, 1, 1)), atol=1e-5)
    assert np.isfinite(np.asarray(similar(gallery(), jnp.zeros((120, 160)), CAMERA, CONFIG, 2))).all()


def test_any_keyframe_is_tried_before_none() -> None:
    """This includes a keyframe with the negative of the image."""
    T = camera_pose((0.3, 0.2, 0.1), 0.2)
    kept = keep(nothing(), T, PICTURES[0])
    found = np.asarray(similar(kept, 1.0 - PICTURES[0], CAMERA, CONFIG, 2), float)
    np.testing.assert_allclose(found[0, :3, 3], T[:3, 3], atol=1e-6)
