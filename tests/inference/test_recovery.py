"""Test recovery: a displaced camera is relocalised in the map, and a wrong pose is not accepted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers.analytic_room import Room, camera_pose
from tests.helpers.localisation_room import ROOM, known_map
from tests.helpers.random_maps import seeds
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import se3_log
from vssm_gym.inference.alignment.residuals import luminance
from vssm_gym.inference.alignment.rotation import RotationConfig
from vssm_gym.inference.tracking.keyframes import KeyframeConfig, empty, remember, similar
from vssm_gym.inference.tracking.recovery import RecoveryConfig, recover
from vssm_gym.model.emission import RGBD

CAMERA = Camera.from_hfov(80, 60, np.radians(70.0))
CONFIG = RecoveryConfig()
RANGE = 8.0  # m
OTHER = Room(interior=((-2.6, -1.2, 0.0), (1.2, 2.4, 2.6)), boxes=(((-0.6, 0.9, 0.0), (0.5, 1.4, 1.6)),))


def f32(a: np.ndarray) -> jax.Array:
    return jnp.asarray(a, jnp.float32)


def place(rng: np.random.Generator) -> np.ndarray:
    return camera_pose(tuple(rng.uniform([-0.9, -0.4, 0.7], [-0.3, 0.4, 1.2])), rng.uniform(-0.5, 0.5), 0.15)


def off(T: np.ndarray, rng: np.random.Generator, metres: float, degrees: float) -> np.ndarray:
    """Displace a pose along the floor and turn it left or right: float64."""
    yaw = np.radians(degrees) * rng.choice([-1.0, 1.0])
    angle = rng.uniform(0.0, 2.0 * np.pi)
    c, s = np.cos(yaw), np.sin(yaw)
    after = T.copy()
    after[:3, :3] = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ T[:3, :3]
    after[:2, 3] += metres * np.array([np.cos(angle), np.sin(angle)])
    return after


def error(T: jax.Array, truth: np.ndarray) -> tuple[float, float]:
    """Return m, degrees."""
    xi = np.asarray(se3_log(f32(np.linalg.inv(truth) @ np.asarray(T, float))))
    return float(np.linalg.norm(xi[:3])), float(np.degrees(np.linalg.norm(xi[3:])))


@pytest.mark.slow
@settings(max_examples=8)
@given(seeds, st.floats(0.0, 0.4), st.floats(0.0, 25.0))
def test_a_camera_carried_off_is_found_from_a_keyframe(seed: int, metres: float, degrees: float) -> None:
    """Up to 40 cm and 25 degrees, by a keyframe near where it stands: to a tenth of a cell of 10 cm."""
    rng = np.random.default_rng(seed)
    start = place(rng)
    now = off(start, rng, metres, degrees)
    view = off(now, rng, 0.1, 4.0)
    kept = empty(CAMERA, KeyframeConfig(capacity=8))
    for T in (view, start, camera_pose((0.2, 0.3, 1.0), 2.6, 0.1)):
        kept = remember(kept, f32(T), luminance(ROOM.image(T, CAMERA).rgb), CAMERA)
    image = ROOM.image(now, CAMERA)
    guesses = similar(kept, luminance(image.rgb), CAMERA, RotationConfig(), CONFIG.keyframes)
    attempt = recover(known_map(), jnp.stack([f32(start), *guesses]), image, CAMERA, jnp.eye(6), RANGE, CONFIG)
    assert bool(attempt.accepted)
    metres_off, degrees_off = error(attempt.T_world_cam, now)
    assert metres_off < 0.02
    assert degrees_off < 0.7


def test_the_best_of_the_starts_is_taken() -> None:
    """Its position in the list and bad starts do not matter."""
    now = place(np.random.default_rng(4))
    image = ROOM.image(now, CAMERA)
    near, away, behind = off(now, np.random.default_rng(1), 0.05, 3.0), np.eye(4), camera_pose((1.5, 0.0, 1.0), 3.0)
    for starts in ([near, away, behind], [away, near, behind], [away, behind, near]):
        attempt = recover(known_map(), f32(np.stack(starts)), image, CAMERA, jnp.eye(6), RANGE, CONFIG)
        assert bool(attempt.accepted)
        assert error(attempt.T_world_cam, now)[0] < 0.02


@settings(max_examples=8)
@given(seeds)
def test_a_picture_of_another_place_does_not_fit(seed: int) -> None:
    """An image of another room with the same wallpaper fits from no start in this one."""
    rng = np.random.default_rng(seed)
    starts = np.stack([place(rng), place(rng), camera_pose((0.2, 0.0, 1.0), 2.5)])
    image = OTHER.image(camera_pose((-1.6, 0.3, 1.3), rng.uniform(-0.3, 0.6), 0.3), CAMERA)
    assert not bool(recover(known_map(), f32(starts), image, CAMERA, jnp.eye(6), RANGE, CONFIG).accepted)


def test_what_is_unexplained_of_an_image_counts_in_proportion_to_its_contrast() -> None:
    """An image with a fifth of the contrast correlates as well, but differs from the map by more than it contains."""
    now = place(np.random.default_rng(4))
    starts, image = f32(np.stack([off(now, np.random.default_rng(1), 0.05, 3.0)] * 3)), ROOM.image(now, CAMERA)
    mean = jnp.mean(image.rgb, axis=(0, 1))
    pale = RGBD(image.depth, mean + 0.2 * (image.rgb - mean), image.hit, image.known)
    sharp, washed = (recover(known_map(), starts, one, CAMERA, jnp.eye(6), RANGE, CONFIG) for one in (image, pale))
    assert bool(sharp.accepted)
    assert not bool(washed.accepted)
    assert float(washed.fit_quality.photometric) < CONFIG.max_photometric
    assert float(washed.agreement.correlation) > CONFIG.min_correlation


def blank(image: RGBD) -> RGBD:
    return RGBD(0 * image.depth, 0 * image.rgb, jnp.zeros_like(image.hit), jnp.zeros_like(image.known))


@pytest.mark.parametrize("what", ["an image without depth", "starts outside the map"])
def test_without_depth_or_a_start_in_the_map_nothing_fits(what: str) -> None:
    """The poses are finite nevertheless."""
    now = place(np.random.default_rng(4))
    image, starts = ROOM.image(now, CAMERA), np.stack([now, now, now])
    if what == "an image without depth":
        image = blank(image)
    else:
        starts[:, 0, 3] += 50.0
    attempt = recover(known_map(), f32(starts), image, CAMERA, jnp.eye(6), RANGE, CONFIG)
    assert not bool(attempt.accepted)
    assert np.isfinite(np.asarray(attempt.T_world_cam)).all()
