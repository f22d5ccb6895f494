"""Tracking a planar robot in a known map: it stays on track where odometry drifts, says so when lost, and recovers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from localisation_room import CAMERA, GRID, ROOM

from vssm_gym.camera import Camera
from vssm_gym.emission import RGBD
from vssm_gym.envs.robots import ExecutionNoise, HolonomicRobot, execute
from vssm_gym.geometry import planar_to_matrix, wrap_angle
from vssm_gym.inference import map_update, tracking
from vssm_gym.inference.tracking import LOST, OK, STATUS, RobotRig, TrackerConfig, TrackerInfo, TrackerState
from vssm_gym.transition import MotionNoise, PlanarBelief, planar_predict
from vssm_gym.voxel_map import VoxelMap

ROBOT = HolonomicRobot()
RIG = RobotRig(CAMERA, jnp.asarray(ROBOT.T_body_cam, jnp.float32))
EXECUTION = ExecutionNoise(np.radians(3.0), 0.02)  # "low" (SPEC 6)
NOISE = MotionNoise(EXECUTION.turn, EXECUTION.step)
MAP = ROOM.to_map(*GRID)
START = np.array([-0.5, -0.4, 2.9])  # turning left from here wraps the heading


def see(planar: np.ndarray) -> RGBD:
    """The camera image of a robot at a pose, through the bytes that a camera delivers."""
    image = ROOM.image(planar_to_matrix(planar) @ ROBOT.T_body_cam, CAMERA)
    return tracking.observe(np.rint(np.asarray(image.rgb) * 255).astype(np.uint8), np.asarray(image.depth))


def drive(steps: int, seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Commands of a tight noisy circle in the middle of the room, and the true pose after each."""
    rng, planar, result = np.random.default_rng(seed), START, []
    for _ in range(steps):
        command = np.array([0.18, rng.uniform(-0.08, 0.08), 0.08])
        planar = execute(planar, command, EXECUTION, rng)
        result.append((command, planar))
    return result


def error(state: TrackerState, planar: np.ndarray) -> tuple[float, float]:
    """Metres and radians."""
    delta = np.asarray(state.planar, float) - planar
    return float(np.hypot(delta[0], delta[1])), abs(float(wrap_angle(delta[2:])[0]))


def step_map(
    state: TrackerState, control: np.ndarray, image: RGBD, m: VoxelMap = MAP
) -> tuple[TrackerState, TrackerInfo]:
    return tracking.step_map(state, jnp.asarray(control, jnp.float32), image, m, RIG, NOISE)


def start() -> TrackerState:
    return tracking.first(jnp.asarray(START, jnp.float32), see(START))


def dead_reckoning_error(drive: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """Metres at the end, from the commands alone."""
    planar, still = START, np.random.default_rng(0)
    for command, _ in drive:
        planar = execute(planar, command, ExecutionNoise(0.0, 0.0), still)
    return float(np.hypot(*(planar - drive[-1][1])[:2]))


@pytest.mark.parametrize("seed", [0, 1])
def test_the_robot_is_tracked_in_its_map(seed: int) -> None:
    """30 steps round the room: within 1 cm and half a degree, never lost, while commands alone are off by far more."""
    state, path = start(), drive(30, seed)
    for command, planar in path:
        state, info = step_map(state, command, see(planar))
        off, turned = error(state, planar)
        assert int(info.status) == OK
        assert off < 0.01
        assert turned < np.radians(0.5)
        assert -np.pi - 1e-6 <= float(state.planar[2]) <= np.pi + 1e-6
    assert dead_reckoning_error(path) > 0.1


def test_a_map_made_from_images_serves_as_well() -> None:
    """Closed-form updates at known poses, then another drive: the whole path from images to location."""
    m = VoxelMap.prior(*GRID)
    for heading in np.arange(0.0, 2 * np.pi, np.pi / 5):
        for xy in ((-0.5, -0.4), (0.2, 0.3)):
            T = planar_to_matrix(np.array([*xy, heading])) @ ROBOT.T_body_cam
            image = ROOM.image(T, CAMERA)
            m = map_update.update(m, image.depth, image.rgb, jnp.asarray(T, jnp.float32), CAMERA)
    state, path, offs = start(), drive(20, 3), []
    for command, planar in path:
        state, info = step_map(state, command, see(planar), m)
        assert int(info.status) == OK
        offs.append(error(state, planar)[0])
    assert max(offs) < 0.04
    assert np.sqrt(np.mean(np.square(offs))) < 0.02


def test_frame_to_frame_tracking_drifts_but_holds() -> None:
    """The "no map" baseline: better than commands alone. Its errors add up, and its covariance says so."""
    state, path, spread = start(), drive(30, 0), []
    for command, planar in path:
        state, info = tracking.step_frames(state, jnp.asarray(command, jnp.float32), see(planar), RIG, NOISE)
        assert int(info.status) == OK
        spread.append(np.linalg.slogdet(np.asarray(state.covariance, float))[1])
    assert error(state, path[-1][1])[0] < 0.3 * dead_reckoning_error(path)
    assert spread == sorted(spread)  # the volume of the belief; its extent in one direction may fall on the way back
    assert float(state.covariance[2, 2]) > 10 * 1e-6  # of the heading, known to 1 mrad at the start


def test_images_only_add_information() -> None:
    """``Sigma^-1 = 2 J^T J + P`` (SPEC 3, step 3): never less certain than the prediction, in any direction."""
    state = start()
    for command, planar in drive(5, 4):
        predicted = planar_predict(state.belief, jnp.asarray(command, jnp.float32), NOISE).covariance
        spread = np.asarray(predicted, float) + np.diag(np.square(TrackerConfig().process_std))
        state, info = step_map(state, command, see(planar))
        posterior = np.asarray(state.belief.covariance, float)
        information = 2.0 * np.asarray(info.agreement.information, float) + np.linalg.inv(spread)
        np.testing.assert_allclose(posterior @ information, np.eye(3), atol=2e-2)
        np.testing.assert_allclose(posterior, posterior.T, rtol=1e-3, atol=1e-9)
        assert np.linalg.eigvalsh(posterior).min() > 0.0
        assert np.linalg.eigvalsh(spread - posterior).min() > -1e-9


def test_a_robot_at_rest_does_not_creep() -> None:
    """A robot that stands still in front of what it sees stays where it is, to a millimetre."""
    state = start()
    for _ in range(5):
        state, info = step_map(state, np.zeros(3), see(START))
        assert int(info.status) == OK
    off, turned = error(state, START)
    assert off < 3e-3
    assert turned < np.radians(0.2)


ELSEWHERE = np.array([0.5, 0.0, -0.6])


@pytest.mark.parametrize("kind", ["another place", "no depth", "black"])
def test_images_that_do_not_fit_are_not_believed(kind: str) -> None:
    """The status says so, the belief follows the dynamics and widens, and the next good image brings it back."""
    (first_command, first_pose), (second_command, second_pose), (_, third_pose) = drive(3, 5)
    state, info = step_map(start(), first_command, see(first_pose))
    assert int(info.status) == OK
    bad = {
        "another place": see(ELSEWHERE),
        "no depth": tracking.observe(np.full((48, 64, 3), 128, np.uint8), np.zeros((48, 64))),
        "black": tracking.observe(np.zeros((48, 64, 3), np.uint8), np.full((48, 64), 0.3)),
    }[kind]
    predicted = planar_predict(state.belief, jnp.asarray(second_command, jnp.float32), NOISE)
    lost, info = step_map(state, second_command, bad)
    assert int(info.status) == LOST
    assert "lost" in STATUS[int(info.status)]
    assert int(lost.lost) == 1
    np.testing.assert_allclose(np.asarray(lost.planar), np.asarray(predicted.planar), atol=1e-6)
    widened = np.asarray(lost.belief.covariance - predicted.covariance, float)
    np.testing.assert_allclose(widened, np.diag(np.square(TrackerConfig().process_std)), atol=1e-8)
    still_lost, _ = step_map(lost, np.zeros(3), bad)
    assert int(still_lost.lost) == 2
    found, info = step_map(lost, np.zeros(3), see(second_pose))
    assert int(info.status) == OK
    assert int(found.lost) == 0
    assert error(found, second_pose)[0] < 0.02
    assert third_pose.shape == (3,)


def test_readings_that_are_no_numbers_are_none() -> None:
    """A sensor's NaN or infinity is a hole in the image, not a hole in the estimate."""
    (command, planar) = drive(1, 6)[0]
    image = see(planar)
    depth = np.array(image.depth)
    depth[5:9, 10:20] = np.nan
    depth[20:24, 30:40] = np.inf
    spoiled = tracking.observe(np.rint(np.asarray(image.rgb) * 255).astype(np.uint8), depth)
    state, info = step_map(start(), command, spoiled)
    assert int(info.status) == OK
    assert error(state, planar)[0] < 0.015


def test_covariance_in_world_axes_by_hand() -> None:
    """Facing world y, what the body calls ahead is y: std 0.1 ahead and 0.3 to the left are 0.3 in x and 0.1 in y."""
    belief = PlanarBelief(jnp.array([1.0, 2.0, np.pi / 2]), jnp.diag(jnp.array([0.01, 0.09, 0.04])))
    state = TrackerState(belief, see(START), jnp.int32(0))
    np.testing.assert_allclose(np.asarray(state.covariance), np.diag([0.09, 0.01, 0.04]), atol=1e-7)


def test_the_first_state_is_the_known_start() -> None:
    state = tracking.first(jnp.asarray(START, jnp.float32), see(START), (0.01, 0.02, 0.03))
    np.testing.assert_allclose(np.asarray(state.planar), START, rtol=1e-6)
    np.testing.assert_allclose(np.asarray(state.belief.covariance), np.diag([1e-4, 4e-4, 9e-4]), rtol=1e-5)
    assert int(state.lost) == 0


def test_an_observation_is_what_the_camera_delivered() -> None:
    rgb, depth = np.full((48, 64, 3), 51, np.uint8), np.ones((48, 64), np.float32)
    depth[0, 0] = 0.0
    image = tracking.observe(rgb, depth)
    np.testing.assert_allclose(np.asarray(image.rgb), 0.2, rtol=1e-6)
    np.testing.assert_array_equal(np.asarray(image.depth), depth)
    np.testing.assert_array_equal(np.asarray(image.hit), depth > 0)


def test_every_status_has_words() -> None:
    assert set(STATUS) == {OK, LOST}
    assert all(isinstance(text, str) and text for text in STATUS.values())


def test_tracking_compiles_once() -> None:
    """Whatever the poses, commands, maps and images, lost or not."""
    before = tracking.correct._cache_size(), tracking.step_frames._cache_size()
    state = start()
    for command, planar in drive(3, 8):
        for m in (MAP, VoxelMap.prior(*GRID)):
            state, _ = step_map(state, command, see(planar), m)
        state, _ = tracking.step_frames(state, jnp.asarray(command, jnp.float32), see(planar), RIG, NOISE)
    assert tracking.correct._cache_size() - before[0] <= 1
    assert tracking.step_frames._cache_size() - before[1] <= 1


def test_steps_are_deterministic() -> None:
    (command, planar) = drive(1, 9)[0]
    a, b = (step_map(start(), command, see(planar))[0] for _ in range(2))
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(np.asarray(x), np.asarray(y))


def test_the_rig_takes_any_camera() -> None:
    """The camera's place on the body is the rig's, not the tracker's: one that looks back tracks as well."""
    T_body_cam = planar_to_matrix(np.array([-0.05, 0.02, np.pi])) @ ROBOT.T_body_cam
    rig = RobotRig(CAMERA, jnp.asarray(T_body_cam, jnp.float32))
    assert isinstance(rig.camera, Camera)

    def see_back(planar: np.ndarray) -> RGBD:
        image = ROOM.image(planar_to_matrix(planar) @ T_body_cam, CAMERA)
        return tracking.observe(np.rint(np.asarray(image.rgb) * 255).astype(np.uint8), np.asarray(image.depth))

    state = tracking.first(jnp.asarray(START, jnp.float32), see_back(START))
    for command, planar in drive(10, 2):
        state, info = tracking.step_map(state, jnp.asarray(command, jnp.float32), see_back(planar), MAP, rig, NOISE)
        assert int(info.status) == OK
        assert error(state, planar)[0] < 0.015
