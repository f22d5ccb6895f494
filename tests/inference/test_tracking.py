"""Test tracking of a planar robot in a known map: accuracy, loss of track and relocalisation."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from tests.helpers.localisation_room import CAMERA, GRID, ROOM, known_map
from vssm_gym.envs.robots import ExecutionNoise, HolonomicRobot, execute
from vssm_gym.geometry.transforms import planar_to_matrix, wrap_angle
from vssm_gym.inference.alignment import reference_view
from vssm_gym.inference.filter import Filter, FilterInfo, Rig
from vssm_gym.inference.mapping import map_update
from vssm_gym.inference.status import Status
from vssm_gym.inference.tracking import camera_filter
from vssm_gym.inference.tracking.map_tracker import ROBOT_TRACKING, FrameTracker, MapTracker, TrackerState
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD
from vssm_gym.model.posterior import Posterior
from vssm_gym.model.transition import MotionNoise, Planar, planar_belief, world_covariance

ROBOT = HolonomicRobot()
RIG = Rig.of(CAMERA, ROBOT.T_body_cam)
EXECUTION = ExecutionNoise(np.radians(3.0), 0.02)  # "low"
MOTION = Planar(MotionNoise(EXECUTION.turn, EXECUTION.step))
IN_MAP, BY_FRAMES = MapTracker(RIG, MOTION), FrameTracker(RIG, MOTION)
OK, LOST = Status.OK, Status.LOST
START = np.array([-0.5, -0.4, 2.9])  # turning left from here wraps the heading


def see(planar: np.ndarray) -> RGBD:
    """Take the camera image of a robot at a pose, quantised to bytes."""
    image = ROOM.image(planar_to_matrix(planar) @ ROBOT.T_body_cam, CAMERA)
    return RGBD.from_camera(np.rint(np.asarray(image.rgb) * 255).astype(np.uint8), np.asarray(image.depth))


def drive(steps: int, seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return commands of a tight noisy circle in the middle of the room, and the true pose after each."""
    rng, planar, result = np.random.default_rng(seed), START, []
    for _ in range(steps):
        command = np.array([0.18, rng.uniform(-0.08, 0.08), 0.08])
        planar = execute(planar, command, EXECUTION, rng)
        result.append((command, planar))
    return result


def error(state: TrackerState, planar: np.ndarray) -> tuple[float, float]:
    """Return metres and radians."""
    delta = np.asarray(state.past.belief.mean, float) - planar
    return float(np.hypot(delta[0], delta[1])), abs(float(wrap_angle(delta[2:])[0]))


def step(
    state: TrackerState, control: np.ndarray, image: RGBD, tracker: Filter = IN_MAP
) -> tuple[TrackerState, FilterInfo]:
    return tracker.step(state, jnp.asarray(control, jnp.float32), image, ROBOT.dt)


def start(tracker: Filter = IN_MAP, m: VoxelMap | None = None, std: float = 1e-3) -> TrackerState:
    known = planar_belief(jnp.asarray(START, jnp.float32), std**2 * jnp.eye(3))
    return tracker.init(Posterior(known, m or known_map()), see(START), jax.random.key(0))


def dead_reckoning_error(drive: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """Return metres at the end, from the commands alone."""
    planar, still = START, np.random.default_rng(0)
    for command, _ in drive:
        planar = execute(planar, command, ExecutionNoise(0.0, 0.0), still)
    return float(np.hypot(*(planar - drive[-1][1])[:2]))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_the_robot_is_tracked_in_its_map(seed: int) -> None:
    """In 30 steps round the room the error is below 1 cm and half a degree; that of commands alone is far larger."""
    state, path = start(), drive(30, seed)
    for command, planar in path:
        state, info = step(state, command, see(planar))
        off, turned = error(state, planar)
        assert info.status is OK
        assert off < 0.01
        assert turned < np.radians(0.5)
        assert -np.pi - 1e-6 <= float(state.past.belief.mean[2]) <= np.pi + 1e-6
    assert dead_reckoning_error(path) > 0.1


def test_a_map_made_from_images_serves_as_well() -> None:
    """The map is made by closed-form updates at known poses, and another drive is tracked in it."""
    m = VoxelMap.prior(*GRID)
    for heading in np.arange(0.0, 2 * np.pi, np.pi / 5):
        for xy in ((-0.5, -0.4), (0.2, 0.3)):
            T = planar_to_matrix(np.array([*xy, heading])) @ ROBOT.T_body_cam
            image = ROOM.image(T, CAMERA)
            m = map_update.update(m, image.depth, image.rgb, jnp.asarray(T, jnp.float32), CAMERA)
    state, path, offs = start(m=m), drive(20, 3), []
    for command, planar in path:
        state, info = step(state, command, see(planar))
        assert info.status is OK
        offs.append(error(state, planar)[0])
    assert max(offs) < 0.04
    assert np.sqrt(np.mean(np.square(offs))) < 0.02


def test_frame_to_frame_tracking_drifts_within_its_covariance() -> None:
    """Without a map the error is smaller than by commands alone, and the covariance grows with every step."""
    state, path, spread = start(BY_FRAMES), drive(30, 0), []
    for command, planar in path:
        state, info = step(state, command, see(planar), BY_FRAMES)
        assert info.status is OK
        spread.append(np.linalg.slogdet(np.asarray(world_covariance(state.past.belief), float))[1])
    assert error(state, path[-1][1])[0] < 0.3 * dead_reckoning_error(path)
    assert spread == sorted(spread)  # the volume of the belief; its extent in one direction may fall on the way back
    assert float(state.past.belief.covariance[2, 2]) > 10 * 1e-6  # of the heading, known to 1 mrad at the start


@pytest.mark.parametrize("slide", [0.0, 0.5])
def test_a_blocked_robot_is_uncertain_by_its_commanded_step(slide: float) -> None:
    """Commanded on by 12 cm, a robot stands, or slides to its side by half of that: its pose stays in its region."""
    state, planar, command = start(), START, np.array([0.0, 0.0, 0.12])
    for k in range(4):
        free = k == 0
        heading = planar[2] if free else planar[2] + np.pi / 2
        planar = planar + (0.12 if free else 0.12 * slide) * np.array([np.cos(heading), np.sin(heading), 0.0])
        state, info = step(state, command, see(planar))
        assert info.status is OK
        P = np.asarray(info.belief.covariance, float)
        off = np.asarray(info.belief.manifold.error(info.belief.mean, jnp.asarray(planar, jnp.float32)), float)
        assert off @ np.linalg.solve(P, off) <= chi2.ppf(0.95, 3)
        assert np.sqrt(P[:2, :2].trace()) < 0.03  # the image still fixes the pose


def test_an_obstacle_is_remembered_until_a_step_is_seen_that_is_as_commanded() -> None:
    """A robot that was blocked and then sees nothing may have made each step, or none of it."""
    state, command = start(), np.array([0.0, 0.0, 0.12])
    state, _ = step(state, command, see(START))
    assert bool(state.past.obstructed)
    unseen, dark = state, RGBD.from_camera(np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64)))
    for k in range(1, 9):
        unseen, _ = step(unseen, command, dark)
        assert bool(unseen.past.obstructed)
        std = np.sqrt(np.diag(unseen.past.belief.covariance)[:2])
        assert std.min() > 0.12 * np.sqrt(k) and std.max() < 0.12 * np.sqrt(k) + 0.05
    turned, _ = step(state, np.array([0.1, 0.0, 0.0]), see(START + np.array([0.0, 0.0, 0.1])))
    assert bool(turned.past.obstructed)  # a turn shows nothing
    free, _ = step(state, command, see(START + 0.12 * np.array([np.cos(START[2]), np.sin(START[2]), 0.0])))
    assert not bool(free.past.obstructed)
    assert np.sqrt(np.diag(free.past.belief.covariance)[:2]).max() < 0.03


def test_an_image_that_fits_nowhere_may_show_what_stopped_the_robot() -> None:
    """A dark image says nothing: the robot has moved as commanded."""
    command, dark = np.array([0.0, 0.0, 0.12]), RGBD.from_camera(np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64)))
    card = RGBD.from_camera(np.full((48, 64, 3), 90, np.uint8), np.full((48, 64), 0.2))
    stds = {}
    for name, image in (("dark", dark), ("card", card)):
        state, info = step(start(), command, image)
        assert info.status is LOST
        stds[name] = np.sqrt(np.diag(state.past.belief.covariance)[:2])
    assert stds["dark"].max() < 0.05
    np.testing.assert_allclose(stds["card"] ** 2 - stds["dark"] ** 2, 0.12**2, rtol=0.01)


def test_the_published_posterior_adds_information() -> None:
    """``Sigma^-1 = 2 J^T J + P`` (PRISM, step 3) is at least the prediction's precision in every direction."""
    published = MapTracker(RIG, MOTION, replace(ROBOT_TRACKING, surface_error=None))
    state = start(published)
    for command, planar in drive(5, 4):
        predicted = MOTION.predict(state.past.belief, jnp.asarray(command, jnp.float32), ROBOT.dt)
        spread = np.asarray(predicted.covariance, float)
        state, info = step(state, command, see(planar), published)
        posterior = np.asarray(state.past.belief.covariance, float)
        information = 2.0 * np.asarray(info.fit_quality.information, float) + np.linalg.inv(spread)
        np.testing.assert_allclose(posterior @ information, np.eye(3), atol=2e-2)
        np.testing.assert_allclose(posterior, posterior.T, rtol=1e-3, atol=1e-9)
        assert np.linalg.eigvalsh(posterior).min() > 0.0
        assert np.linalg.eigvalsh(spread - posterior).min() > -1e-9


def test_an_image_without_a_reading_leaves_the_prediction() -> None:
    """``Sigma^-1 = 2 J^T J + P`` with ``J = 0``: mean and covariance are those of the prediction."""
    state, blind = start(std=0.03), RGBD.from_camera(np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64)))
    reference = reference_view.from_map(known_map(), state.past.T_world_cam, CAMERA, IN_MAP.max_depth)
    control, dt = jnp.asarray([0.1, 0.05, 0.08], jnp.float32), jnp.float32(ROBOT.dt)
    tracked = camera_filter.track(
        camera_filter.TrackingInput(state.past, MOTION, control, dt, reference, blind, RIG, state.key, False),
        IN_MAP.config,
    )
    np.testing.assert_allclose(np.asarray(tracked.belief.mean), np.asarray(tracked.predicted.mean), atol=1e-5)
    spread = np.asarray(tracked.predicted.covariance)
    np.testing.assert_allclose(np.asarray(tracked.belief.covariance), spread, rtol=1e-3, atol=1e-3 * spread.max())


def test_a_robot_at_rest_does_not_drift() -> None:
    """The estimate of a standing robot stays within a millimetre."""
    state = start()
    for _ in range(5):
        state, info = step(state, np.zeros(3), see(START))
        assert info.status is OK
    off, turned = error(state, START)
    assert off < 3e-3
    assert turned < np.radians(0.2)


ELSEWHERE = np.array([0.5, 0.0, -0.6])


@pytest.mark.parametrize("kind", ["another place", "no depth", "black"])
def test_images_that_do_not_fit_are_rejected(kind: str) -> None:
    """The status reports it, the belief follows the prediction and widens, and the next good image corrects it.

    One that shows something may show what stopped the robot: anywhere within its commanded step.
    """
    (first_command, first_pose), (second_command, second_pose), (_, third_pose) = drive(3, 5)
    state, info = step(start(), first_command, see(first_pose))
    assert info.status is OK
    bad = {
        "another place": see(ELSEWHERE),
        "no depth": RGBD.from_camera(np.full((48, 64, 3), 128, np.uint8), np.zeros((48, 64))),
        "black": RGBD.from_camera(np.zeros((48, 64, 3), np.uint8), np.full((48, 64), 0.3)),
    }[kind]
    predicted = MOTION.predict(state.past.belief, jnp.asarray(second_command, jnp.float32), ROBOT.dt)
    x, y, _ = np.asarray(predicted.mean - state.past.belief.mean, float)
    turn = second_command[0]
    stopped = 0.0 if kind == "no depth" else np.diag([x * x + y * y, x * x + y * y, turn * turn])
    lost, info = step(state, second_command, bad)
    assert info.status is LOST
    assert "lost" in info.status.message and lost.lost
    np.testing.assert_allclose(np.asarray(lost.past.belief.mean), np.asarray(predicted.mean), atol=1e-6)
    np.testing.assert_allclose(
        np.asarray(info.belief.covariance), np.asarray(predicted.covariance) + stopped, rtol=0.01, atol=1e-8
    )
    still_lost, _ = step(lost, np.zeros(3), bad)
    assert still_lost.lost
    found, info = step(lost, np.zeros(3), see(second_pose))
    assert info.status is OK
    assert not found.lost
    assert error(found, second_pose)[0] < 0.02
    assert third_pose.shape == (3,)


def test_readings_that_are_not_finite_are_ignored() -> None:
    """NaN or infinity in an image counts as no reading."""
    (command, planar) = drive(1, 6)[0]
    image = see(planar)
    depth = np.array(image.depth)
    depth[5:9, 10:20] = np.nan
    depth[20:24, 30:40] = np.inf
    spoiled = RGBD.from_camera(np.rint(np.asarray(image.rgb) * 255).astype(np.uint8), depth)
    state, info = step(start(), command, spoiled)
    assert info.status is OK
    assert error(state, planar)[0] < 0.015


def test_covariance_in_world_axes_by_hand() -> None:
    """For a body that faces world y, stds 0.1 ahead and 0.3 to the left are 0.3 in x and 0.1 in y."""
    belief = planar_belief(jnp.array([1.0, 2.0, np.pi / 2]), jnp.diag(jnp.array([0.01, 0.09, 0.04])))
    np.testing.assert_allclose(np.asarray(world_covariance(belief)), np.diag([0.09, 0.01, 0.04]), atol=1e-7)


def test_the_first_state_is_the_known_start() -> None:
    state = start(std=0.02)
    belief = IN_MAP.posterior(state).belief
    np.testing.assert_allclose(np.asarray(belief.mean), START, rtol=1e-6)
    np.testing.assert_allclose(np.asarray(belief.covariance), np.diag([4e-4] * 3), rtol=1e-5)
    assert not state.lost


def test_an_observation_holds_the_cameras_image() -> None:
    rgb, depth = np.full((48, 64, 3), 51, np.uint8), np.ones((48, 64), np.float32)
    depth[0, 0] = 0.0
    image = RGBD.from_camera(rgb, depth)
    np.testing.assert_allclose(np.asarray(image.rgb), 0.2, rtol=1e-6)
    np.testing.assert_array_equal(np.asarray(image.depth), depth)
    np.testing.assert_array_equal(np.asarray(image.hit), depth > 0)


def test_every_status_has_a_message() -> None:
    assert len({status.message for status in Status}) == len(Status)
    assert [status for status in Status if status.accepted] == [Status.OK, Status.RECOVERED, Status.TURNED]


def test_tracking_compiles_once() -> None:
    """Poses, commands, maps and images, lost or not, need no second compilation."""
    before = camera_filter.track._cache_size()
    for m in (known_map(), VoxelMap.prior(*GRID)):
        state, frames = start(m=m), start(BY_FRAMES)
        for command, planar in drive(3, 8):
            state, _ = step(state, command, see(planar))
            frames, _ = step(frames, command, see(planar), BY_FRAMES)
    assert camera_filter.track._cache_size() - before <= 1


def test_steps_are_deterministic() -> None:
    (command, planar) = drive(1, 9)[0]
    a, b = (step(start(), command, see(planar))[0].past for _ in range(2))
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(np.asarray(x), np.asarray(y))


def test_the_rig_takes_any_camera() -> None:
    """The camera's mounting is part of the rig: a camera that faces backwards tracks as well."""
    T_body_cam = planar_to_matrix(np.array([-0.05, 0.02, np.pi])) @ ROBOT.T_body_cam
    tracker = MapTracker(Rig.of(CAMERA, T_body_cam), MOTION)

    def see_back(planar: np.ndarray) -> RGBD:
        image = ROOM.image(planar_to_matrix(planar) @ T_body_cam, CAMERA)
        return RGBD.from_camera(np.rint(np.asarray(image.rgb) * 255).astype(np.uint8), np.asarray(image.depth))

    known = planar_belief(jnp.asarray(START, jnp.float32), 1e-6 * jnp.eye(3))
    state = tracker.init(Posterior(known, known_map()), see_back(START), jax.random.key(0))
    for command, planar in drive(10, 2):
        state, info = step(state, command, see_back(planar), tracker)
        assert info.status is OK
        assert error(state, planar)[0] < 0.015
