"""Test faults of a hand-held camera: none is fatal, each is reported, and none enters the map."""

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.analytic_room import camera_pose
from tests.helpers.prism_room import (
    CAMERA,
    CONFIG,
    DT,
    EXPECTED,
    ROOM,
    copy,
    error,
    image,
    same_map,
    start,
    true_pose,
    walked,
)
from tests.helpers.prism_room import step as filtered
from vssm_gym.errors import InputError
from vssm_gym.eval.faults.injectors import IMAGE_FAULTS, ImageFault
from vssm_gym.inference.filter import FilterInfo
from vssm_gym.inference.prism.config import PrismConfig
from vssm_gym.inference.prism.filter import PrismState
from vssm_gym.inference.status import Status
from vssm_gym.model.emission import RGBD, render

LOST, NO_READING, OK, RECOVERED, REPEATED = (
    Status.LOST,
    Status.NO_READING,
    Status.OK,
    Status.RECOVERED,
    Status.REPEATED,
)

WALKED = 12  # frames before anything happens
TRACKED = (OK, RECOVERED)
BEHIND = camera_pose((0.2, 0.3, 1.2), 2.7, 0.4)  # sees what the walk never saw


def without_depth(taken: RGBD, rgb: float = 1.0) -> RGBD:
    nothing = jnp.zeros_like(taken.hit)
    return RGBD(jnp.zeros_like(taken.depth), rgb * taken.rgb, nothing, nothing)


def black() -> RGBD:
    return without_depth(image(0), 0.0)


def step(state: PrismState, taken: RGBD, dt: float = DT, config=CONFIG):
    state, info = filtered(state, taken, dt, config)
    assert info.status.message
    assert all(np.isfinite(np.asarray(a)).all() for a in (info.belief.covariance, info.belief.mean.T_world_body))
    return state, info


def check_map(state: PrismState, k: float) -> None:
    """Assert that the map, rendered from the true pose, shows the room."""
    T = jnp.asarray(np.linalg.inv(true_pose(0)) @ true_pose(k), jnp.float32)
    seen = render(state.map, T, CAMERA, CONFIG.update.max_depth)
    known = np.asarray(seen.known)
    off = np.abs(np.asarray(seen.depth, float) - ROOM.depth(true_pose(k), CAMERA))[known]
    assert known.mean() > 0.8
    assert np.median(off) < 0.01
    assert np.quantile(off, 0.9) < 0.06


@cache
def undisturbed() -> np.ndarray:
    """Return the stds of pose and velocity of a walk without faults."""
    return stds(walked(WALKED)[1][-1])


def stds(info: FilterInfo) -> np.ndarray:
    return np.sqrt(np.diag(np.asarray(info.belief.covariance, float)))


def back_on_the_walk(state: PrismState, k: int, frames: int = 3) -> None:
    """Assert that from frame ``k`` on the camera is tracked as without the fault, and the map shows the room."""
    for j in range(k, k + frames):
        state, info = step(state, image(j))
        assert info.status in TRACKED, f"frame {j}: {info.status.message}"
        metres, degrees = error(info.belief, true_pose(j))
        assert metres < 0.02
        assert degrees < 1.0
    assert info.status == OK
    assert (stds(info)[:6] < 2.5 * undisturbed()[:6]).all(), stds(info) / undisturbed()
    check_map(state, k + frames - 1)


@pytest.mark.slow
@pytest.mark.parametrize("config", [CONFIG, EXPECTED], ids=["mean", "expectation"])
def test_frames_that_are_dropped(config: PrismConfig) -> None:
    """Half a second has no image, while the camera moves 12 cm and 6 degrees."""
    state, _ = walked(WALKED, config)
    state, info = step(state, image(WALKED + 5), 0.5, config)
    assert info.status in TRACKED
    assert error(info.belief, true_pose(WALKED + 5))[0] < 0.02
    back_on_the_walk(state, WALKED + 6)


@pytest.mark.parametrize(("what", "frames"), [("black", 10), ("no depth", 10), ("no depth", 1)])
def test_images_without_a_reading(what: str, frames: int) -> None:
    """The status reports it; map and pose are unchanged, and the pose's covariance grows."""
    state, infos = walked(WALKED)
    before, stood, spread = copy(state).map, np.asarray(infos[-1].belief.mean.T_world_body), 0.0
    for k in range(WALKED + 1, WALKED + 1 + frames):
        state, info = step(state, black() if what == "black" else without_depth(image(k)))
        assert info.status == NO_READING
        np.testing.assert_array_equal(np.asarray(info.belief.mean.T_world_body), stood)
        assert spread < (spread := float(jnp.trace(info.belief.covariance[:3, :3])))
    assert same_map(state.map, before)
    back_on_the_walk(state, WALKED + 1 + frames)


@pytest.mark.parametrize("pixels", [1, 10, 100])
def test_too_little_depth_counts_as_no_reading(pixels: int) -> None:
    """A few readings fit at any pose, so that they change neither pose nor map."""
    state, infos = walked(WALKED)
    before, stood = copy(state).map, np.asarray(infos[-1].belief.mean.T_world_body)
    few = np.zeros(60 * 80, bool)
    few[np.random.default_rng(0).permutation(60 * 80)[:pixels]] = True
    kept = jnp.asarray(few.reshape(60, 80))
    for k in range(WALKED + 1, WALKED + 6):
        seen = image(k)
        state, info = step(state, RGBD(seen.depth * kept, seen.rgb, seen.hit & kept, seen.known & kept))
        assert info.status == NO_READING
        np.testing.assert_array_equal(np.asarray(info.belief.mean.T_world_body), stood)
    assert same_map(state.map, before)
    back_on_the_walk(state, WALKED + 6)


@pytest.mark.parametrize("gain", [0.3, 0.5, 1.7, 2.2])
def test_a_camera_that_changes_its_exposure(gain: float) -> None:
    """After a sudden large change the camera is tracked, and the map keeps its brightness."""
    state, _ = walked(WALKED)
    for k in range(WALKED + 1, WALKED + 6):
        seen = image(k)
        state, info = step(state, RGBD(seen.depth, jnp.clip(gain * seen.rgb, 0.0, 1.0), seen.hit, seen.known))
        assert info.status == OK
        assert error(info.belief, true_pose(k))[0] < 0.02
    T = jnp.asarray(np.linalg.inv(true_pose(0)) @ true_pose(WALKED), jnp.float32)
    seen = render(state.map, T, CAMERA, CONFIG.update.max_depth)
    known = np.asarray(seen.known)
    bright = np.asarray(seen.rgb)[known].mean() / np.asarray(image(WALKED).rgb)[known].mean()
    assert bright == pytest.approx(1.0, abs=0.12)
    back_on_the_walk(state, WALKED + 6)


@pytest.mark.parametrize(("frames", "dt"), [(50, 0.02), (10, 0.1), (2, 0.5)])
def test_the_spread_of_a_lost_camera_grows_with_time_not_with_images(frames: int, dt: float) -> None:
    """A second of darkness at an unknown speed of 0.5 m/s gives 0.5 m, at every rate of images."""
    state, _ = walked(WALKED)
    for _ in range(frames):
        state, info = step(state, black(), dt)
    sigma = np.sqrt(np.diag(np.asarray(info.belief.covariance, float))[:3])
    assert (sigma > 0.3).all() and (sigma < 0.65).all()


def test_a_map_cannot_start_from_an_image_without_depth() -> None:
    for unreadable in (black(), without_depth(image(0))):
        with pytest.raises(InputError, match="depth at 5%"):
            start(first=unreadable)


@pytest.mark.parametrize(
    ("value", "share"), [(np.nan, 0.3), (np.inf, 0.3), (-1.0, 0.3), (0.0, 0.7), (1e9, 0.1), (1e-9, 0.1)]
)
def test_invalid_depths_are_no_reading(value: float, share: float) -> None:
    """An invalid number in a depth image is no reading there; the others count."""
    state, _ = walked(WALKED)
    rng = np.random.default_rng(0)
    for k in range(WALKED + 1, WALKED + 4):
        depth = ROOM.depth(true_pose(k), CAMERA).astype(np.float32)
        depth[rng.uniform(size=depth.shape) < share] = value
        rgb = np.rint(255.0 * np.asarray(image(k).rgb)).astype(np.uint8)
        state, info = step(state, RGBD.from_camera(rgb, depth))
        assert info.status == OK
        assert error(info.belief, true_pose(k))[0] < 0.015
    assert all(np.isfinite(np.asarray(a)).all() for a in (state.map.occupancy, state.map.colour))
    back_on_the_walk(state, WALKED + 4)


def test_a_depth_image_of_nan_alone() -> None:
    state, _ = walked(WALKED)
    before = copy(state).map
    state, info = step(
        state, RGBD.from_camera(np.full((60, 80, 3), 90, np.uint8), np.full((60, 80), np.nan, np.float32))
    )
    assert info.status == NO_READING
    assert same_map(state.map, before)
    back_on_the_walk(state, WALKED + 2)


@pytest.mark.parametrize("to", [0, 4])
def test_a_camera_moved_to_a_mapped_place_is_relocalised(to: int) -> None:
    """One step moves the camera by 35 cm and 15 degrees."""
    state, _ = walked(14)
    state, info = step(state, image(to))
    assert info.status in TRACKED
    assert error(info.belief, true_pose(to))[0] < 0.02
    back_on_the_walk(state, to + 1)


def test_a_camera_moved_to_an_unmapped_place_is_lost() -> None:
    """While it is there the status is lost and the map unchanged; back in the room it is relocalised."""
    state, _ = walked(WALKED)
    before = copy(state).map
    for _ in range(5):
        state, info = step(state, ROOM.image(BEHIND, CAMERA))
        assert info.status == LOST
        assert same_map(state.map, before)
    back_on_the_walk(state, WALKED - 2)


def test_noise_in_place_of_an_image() -> None:
    """Colours and depths are random, as from a broken cable."""
    state, _ = walked(WALKED)
    before = copy(state).map
    rng = np.random.default_rng(1)
    for _ in range(3):
        depth = rng.uniform(0.3, 6.0, (60, 80)).astype(np.float32)
        state, info = step(state, RGBD.from_camera(rng.integers(0, 256, (60, 80, 3)).astype(np.uint8), depth))
        assert info.status == LOST
        assert same_map(state.map, before)
    back_on_the_walk(state, WALKED + 4)


def test_a_repeated_depth_image() -> None:
    """A moving camera whose image hangs measures nothing new: it is reported, and the pose's spread grows."""
    state, _ = walked(WALKED)
    before, spread = copy(state).map, 0.0
    for _ in range(5):
        state, info = step(state, image(WALKED))
        assert info.status == REPEATED
        assert spread < (spread := float(jnp.trace(info.belief.covariance[:3, :3])))
    assert same_map(state.map, before)
    back_on_the_walk(state, WALKED + 1)


def delivered(k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return frame ``k`` as a camera delivers it."""
    return np.rint(255.0 * np.asarray(image(k).rgb)).astype(np.uint8), np.asarray(image(k).depth)


def check_not_believed(fault: ImageFault, frames: int) -> None:
    """Assert that no image of a fault is accepted, none enters the map, and tracking continues after it."""
    state, _ = walked(WALKED)
    before, rng = copy(state).map, np.random.default_rng(0)
    images = [delivered(k) for k in range(WALKED + 1)]
    for k in range(WALKED + 1, WALKED + 1 + frames):
        images.append(delivered(k))
        state, info = step(state, RGBD.from_camera(*fault(images, WALKED + 1, rng)))
        assert info.status == LOST, f"frame {k}: {info.status.message}"
    assert same_map(state.map, before)
    back_on_the_walk(state, WALKED + 1 + frames)


def test_a_grey_card_before_the_lens_is_relocalised_nowhere() -> None:
    """It is flat and of one colour: it fits many walls, and fixes the pose at none of them."""
    check_not_believed(IMAGE_FAULTS["grey card"], 4)


@pytest.mark.parametrize("scale", [0.83, 1.2])
def test_depth_of_a_wrong_scale_does_not_move_the_camera(scale: float) -> None:
    check_not_believed(lambda images, before, rng: (images[-1][0], np.float32(scale) * images[-1][1]), 4)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["grey card", "scaled depth", "swapped depth", "mirrored"])
def test_a_false_image_is_not_believed(name: str) -> None:
    check_not_believed(IMAGE_FAULTS[name], 12)
