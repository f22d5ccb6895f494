"""Test the smoother that starts from nothing: it follows a camera, skips what it cannot see, and corrects drift."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.analytic_room import camera_pose
from tests.helpers.prism_room import CAMERA, DT, ROOM, image, true_pose
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import se3_log
from vssm_gym.inference.filter import Filter, Rig
from vssm_gym.inference.prism.config import HAND
from vssm_gym.inference.smoothing.gauss_newton import SmoothingConfig
from vssm_gym.inference.smoothing.online import OnlineConfig, OnlineSmoother
from vssm_gym.inference.status import Status
from vssm_gym.inference.tracking.camera_filter import at_rest
from vssm_gym.maps.voxel_map import OBSERVED_PRECISION, VoxelMap
from vssm_gym.model.emission import RGBD
from vssm_gym.model.posterior import Posterior
from vssm_gym.model.transition import RIGID, MotionNoise, Planar

CONFIG = OnlineConfig(smoothing=SmoothingConfig(elements=1500, gates=(0.1, 0.05)), free=4, held=3, spacing=0.05)
SMOOTHER = OnlineSmoother(Rig.of(CAMERA), HAND, CONFIG)
DARK = RGBD.from_camera(np.zeros((60, 80, 3), np.uint8), np.zeros((60, 80), np.float32))
FRAMES = 12


def prior() -> Posterior:
    start = at_rest(RIGID, jnp.asarray(true_pose(0), jnp.float32), 1e-8 * jnp.eye(6), (1.0, 1.0))
    return Posterior(start, VoxelMap.cube((0.0, 0.0, 0.0), 6.0, 0.1))


def followed(
    images: dict[int, RGBD] | None = None, smoother: OnlineSmoother = SMOOTHER, seed: int = 0, frames: int = FRAMES
):
    """Return state, report and observed cells after each image of the path; ``images`` replaces some."""
    state = smoother.init(prior(), image(0), jax.random.key(seed))
    every = []
    for k in range(1, frames):
        state, info = smoother.step(state, jnp.zeros(6), (images or {}).get(k, image(k)), DT)
        observed = int((np.asarray(state.map.occupancy_precision) > OBSERVED_PRECISION).sum())
        every.append((state, info, observed))  # the next step consumes the state's map
    return every


def error(info, k: int) -> np.ndarray:
    T = jnp.asarray(np.linalg.inv(true_pose(k)), jnp.float32) @ info.belief.mean.T_world_body
    return np.asarray(se3_log(T), float)


@pytest.fixture(scope="module")
def run():
    return followed()


def test_it_is_a_filter():
    assert isinstance(SMOOTHER, Filter)


@pytest.mark.slow
def test_it_follows_the_camera_from_nothing(run):
    assert all(info.status is Status.OK for _, info, _ in run)
    errors = np.stack([error(info, k) for k, (_, info, _) in enumerate(run, 1)])
    moved = np.linalg.norm(true_pose(FRAMES - 1)[:3, 3] - true_pose(0)[:3, 3])
    assert moved > 0.1
    assert np.abs(errors[:, :3]).max() < 0.004
    assert np.abs(errors[:, 3:]).max() < 0.004


def test_velocities_are_found(run):
    velocity = np.asarray(run[-1][1].belief.mean.velocity)
    true = (true_pose(FRAMES - 1) - true_pose(FRAMES - 2))[:3, 3] / DT
    assert np.abs(velocity[:3] - true).max() < 0.1


def test_its_errors_are_within_what_it_states(run):
    for k, (_, info, _) in enumerate(run, 1):
        covariance = np.asarray(info.belief.covariance, float)
        assert np.linalg.eigvalsh(covariance).min() > 0.0
        xi = error(info, k)
        assert xi @ np.linalg.solve(covariance[:6, :6], xi) / 6.0 < 5.0


def test_what_the_start_does_not_know_stays_unknown():
    """All images together do not tell where the first one was taken."""
    unsure = replace(prior().belief, covariance=prior().belief.covariance.at[:3, :3].set(0.01 * jnp.eye(3)))
    state = SMOOTHER.init(replace(prior(), belief=unsure), image(0), jax.random.key(0))
    for k in range(1, 2 * CONFIG.free + 1):
        state, info = SMOOTHER.step(state, jnp.zeros(6), image(k), DT)
        std = float(np.sqrt(np.trace(info.belief.covariance[:3, :3]) / 3.0))
        assert 0.09 < std < 0.12


def test_an_image_enters_the_map_when_its_step_leaves_the_window(run):
    observed = [seen for *_, seen in run]
    assert observed[CONFIG.free - 2] == 0 < observed[CONFIG.free - 1] <= observed[-1]
    assert all(len(state.window) <= CONFIG.free for state, *_ in run)
    assert len(run[-1][0].earlier) > 1


def test_a_dark_image_is_skipped_and_the_next_one_is_found():
    every = followed({5: DARK, 6: DARK})
    assert [info.status for _, info, _ in every[3:7]] == [Status.OK, Status.NO_READING, Status.NO_READING, Status.OK]
    std = [float(np.sqrt(np.trace(info.belief.covariance[:3, :3]))) for _, info, _ in every]
    assert std[5] > 2.0 * std[3] and std[6] < 0.5 * std[5]
    assert np.abs(error(every[-1][1], FRAMES - 1)).max() < 0.006


def test_a_blackout_longer_than_the_window_leaves_no_doubt_behind():
    """While it lasts, the covariance is that of the transition alone; afterwards earlier images hold the window."""
    dark = range(4, 4 + CONFIG.free + 2)
    every = followed(dict.fromkeys(dark, DARK), frames=dark.stop + 4)
    std = lambda k: float(np.sqrt(np.trace(every[k - 1][1].belief.covariance[:3, :3])))
    alone = every[dark.start - 2][0].belief
    for _ in dark:
        alone = HAND.predict(alone, jnp.zeros(6), jnp.float32(DT))
    assert std(dark.stop - 1) == pytest.approx(float(np.sqrt(np.trace(alone.covariance[:3, :3]))), rel=0.1)
    assert every[dark.stop - 1][1].status is Status.OK
    assert std(dark.stop + 3) < 3.0 * std(dark.start - 1)
    assert np.abs(error(every[-1][1], dark.stop + 3)).max() < 0.006


@pytest.mark.parametrize("other", ["a near wall", "the other end of the room"])
def test_an_image_of_another_place_is_not_accepted(other):
    """The former shares no surface; of the latter the floor and walls lie where those of the last image do."""
    near = RGBD.from_camera(np.full((60, 80, 3), 128, np.uint8), np.full((60, 80), 0.3, np.float32))
    behind = ROOM.image(camera_pose((0.3, 0.0, 1.2), 2.8, 0.4), CAMERA)
    every = followed({5: near if other == "a near wall" else behind})
    assert every[4][1].status is Status.LOST
    assert every[5][1].status is Status.OK
    assert np.abs(error(every[-1][1], FRAMES - 1)).max() < 0.006


def test_the_same_key_gives_the_same_poses(run):
    again, other = followed(), followed(seed=1)
    pose = lambda every: np.asarray(every[-1][1].belief.mean.T_world_body)
    np.testing.assert_array_equal(pose(run), pose(again))
    assert not np.array_equal(pose(run), pose(other))


def test_earlier_images_are_thinned_beyond_their_most():
    few = replace(SMOOTHER, config=replace(CONFIG, most_kept=2, spacing=0.01))
    assert len(followed(smoother=few)[-1][0].earlier) <= 2


def test_only_a_rigid_body_is_taken():
    with pytest.raises(InputError, match="rigid body"):
        OnlineSmoother(Rig.of(CAMERA), Planar(MotionNoise(0.1, 0.1)))


def test_bad_input_is_named():
    with pytest.raises(InputError, match="depth"):
        SMOOTHER.init(prior(), DARK, jax.random.key(0))
    with pytest.raises(InputError, match="map"):
        SMOOTHER.init(replace(prior(), map=None), image(0), jax.random.key(0))
    state = SMOOTHER.init(prior(), image(0), jax.random.key(0))
    with pytest.raises(InputError, match="dt"):
        SMOOTHER.step(state, jnp.zeros(6), image(1), 0.0)
    with pytest.raises(InputError, match="control"):
        SMOOTHER.step(state, jnp.zeros(3), image(1), DT)
