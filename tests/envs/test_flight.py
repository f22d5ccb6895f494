"""Test Flight-v0: the body's dynamics, the IMU, the controller on its reference, and the contract of an environment."""

import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from tests.helpers.flight_hall import hall
from vssm_gym.envs.flight import HOVERING, STRAYED, FlightEnv
from vssm_gym.envs.flight_body import (
    FLIGHT_NOISE,
    FlightBody,
    FlightController,
    FlightNoise,
    FlightState,
    fly,
    rotation,
)
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.envs.tasks.reference_flights import CURVES, Placement, ReferenceFlight
from vssm_gym.errors import InputError
from vssm_gym.geometry.gravity import GRAVITY

ID = "vssm_gym:vssm_gym/Flight-v0"
SCENE = hall()
SMALL = CameraConfig(width=32, height=24)
BODY = FlightBody()


def make(**keywords) -> FlightEnv:
    given = {"scene": SCENE, "noise": "none", "imu_noise": "none", "camera": SMALL, "flight": "figure8"}
    return FlightEnv(**{**given, "speed": 3.0, **keywords})


def rollout(env: FlightEnv, seed: int, steps: int = 12) -> bytes:
    """Return all outputs of an episode of seeded actions, as bytes."""
    observation, info = env.reset(seed=seed)
    rng, shown = np.random.default_rng(7), []
    for _ in range(steps):
        shown += [observation[key].tobytes() for key in sorted(observation)] + [info["T_world_cam"].tobytes()]
        action = (HOVERING + rng.uniform(-1.0, 1.0, 6)).astype(np.float32)
        observation, reward, terminated, _, info = env.step(action)
        shown.append(np.float64(reward).tobytes())
        if terminated:
            observation, info = env.reset()
    return b"".join(shown)


def oracle(start: FlightState, command: np.ndarray, drag: float, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Integrate position and velocity adaptively in float64; the rotation is known in closed form."""

    def law(t, y):
        R = start.R_world_body @ Rotation.from_rotvec(t * command[3:]).as_matrix()
        return np.concatenate([y[3:], R @ command[:3] + GRAVITY - drag * y[3:]])

    end = solve_ivp(law, (0.0, seconds), np.concatenate([start.position, start.velocity]), rtol=1e-10, atol=1e-10)
    return end.y[:3, -1], end.y[3:, -1]


@pytest.mark.parametrize("seed", range(5))
def test_free_flight_is_the_integral_of_its_law(seed):
    rng = np.random.default_rng(seed)
    R = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    start = FlightState(np.zeros(3), rng.normal(size=3), R)
    command = np.concatenate([[1.0, -2.0, 11.0], rng.uniform(-2.0, 2.0, 3)])
    state = start
    for _ in range(200):
        state, _ = fly(state, command, np.zeros(6), BODY.drag, BODY.substep)
    position, velocity = oracle(start, command, BODY.drag, 1.0)
    np.testing.assert_allclose(state.position, position, atol=2e-4)
    np.testing.assert_allclose(state.velocity, velocity, atol=4e-4)
    np.testing.assert_allclose(state.R_world_body, R @ Rotation.from_rotvec(command[3:]).as_matrix(), atol=1e-12)


def test_the_environment_follows_the_law():
    """MuJoCo produces the same flight between the walls, and the reported state is its ball's position."""
    env = make()
    env.reset(seed=0)
    start, command = env.state, np.array([0.3, 0.2, 10.2, 0.1, -0.2, 0.3])
    for _ in range(10):
        env.step(command)
    position, velocity = oracle(start, command, BODY.drag, 10 * env.dt)
    np.testing.assert_allclose(env.state.position, position, atol=1e-3)
    np.testing.assert_allclose(env.world.position(), position, atol=1e-3)
    np.testing.assert_allclose(env.state.velocity, velocity, atol=1e-3)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 1e-4, 0.5, 3.0])
def test_rotation_is_rodrigues(angle):
    phi = angle * np.array([0.6, -0.48, 0.64])
    np.testing.assert_allclose(rotation(phi), Rotation.from_rotvec(phi).as_matrix(), atol=1e-14)


def test_the_imu_measures_all_forces_on_the_body():
    """Dead reckoning from exact readings reproduces the flight, drag and gusts included."""
    env = make(noise="high")
    env.reset(seed=3)
    pilot, state = FlightController(env.body), env.state
    h = env.dt / env.substeps
    for _ in range(80):
        observation, *_ = env.step(pilot(env.state, env.task, env.time, env.dt))
        for reading in observation["imu"].astype(np.float64):
            R_mid = state.R_world_body @ rotation(0.5 * h * reading[3:])
            after = state.velocity + h * (R_mid @ reading[:3] + GRAVITY)
            moved = state.position + 0.5 * h * (state.velocity + after)
            state = FlightState(moved, after, state.R_world_body @ rotation(h * reading[3:]))
    np.testing.assert_allclose(state.position, env.state.position, atol=2e-3)
    np.testing.assert_allclose(state.R_world_body, env.state.R_world_body, atol=1e-4)


def test_gusts_have_the_stated_deviation_for_every_time_step():
    for dt in (0.02, 0.1):
        rng, gust, seen = np.random.default_rng(0), np.zeros(6), []
        noise = FlightNoise(0.5, 0.05)
        for _ in range(20000):
            gust = noise.following(gust, dt, rng)
            seen.append(gust)
        spread = np.std(seen[1000:], axis=0)
        np.testing.assert_allclose(spread, [0.5] * 3 + [0.05] * 3, rtol=0.1)


@pytest.mark.parametrize("name", CURVES)
@pytest.mark.parametrize(("speed", "scale", "noise", "error"), [(1.0, 1.2, "none", 0.05), (4.0, 4.5, "low", 0.25)])
def test_the_controller_follows_the_reference(name, speed, scale, noise, error):
    """By the law alone, without images, the body's thrust suffices for every reference."""
    reference = ReferenceFlight(name, speed, Placement((0.0, 0.0), scale, 0.3), drag=BODY.drag)
    start = reference.at(np.zeros(1))
    state = FlightState(start.position[0], start.velocity[0], start.R_world_body[0])
    pilot, gust, dt = FlightController(BODY), np.zeros(6), 0.05
    rng, errors = np.random.default_rng(0), []
    for k in range(int(reference.duration / dt)):
        command = pilot(state, reference, k * dt, dt)
        gust = FLIGHT_NOISE[noise].following(gust, dt, rng)
        for _ in range(10):
            state, _ = fly(state, command, gust, BODY.drag, 0.005)
        errors.append(np.linalg.norm(state.position - reference.at(np.array([(k + 1) * dt])).position[0]))
    assert max(errors) < error


def test_a_flight_completed_is_a_success():
    env = make(speed=4.0, reward="sparse")
    env.reset(seed=0)
    pilot, terminated, earned = FlightController(env.body), False, 0.0
    while not terminated:
        _, reward, terminated, truncated, info = env.step(pilot(env.state, env.task, env.time, env.dt))
        earned += reward
    assert info["success"] and not info["collision"] and not truncated
    assert earned == 1.0
    assert env.time >= env.task.duration


def test_a_wall_ends_the_flight_and_is_not_passed():
    env = make()
    env.reset(seed=0)
    # Aimed along x by hand, and moved phase by phase: the episode ends at once, far from its reference.
    env.state = FlightState(np.array([4.0, 0.0, 1.8]), np.array([8.0, 0.0, 0.0]), np.eye(3))
    env.world.reset(env.state.position)
    for _ in range(20):
        env.advance(HOVERING)
        env.sense()
        _, _, terminated, _, info = env.report()
        if info["collision"]:
            break
    assert terminated and not info["success"]
    assert 5.9 - env.body.radius - 0.02 < env.state.position[0] < 5.9 - env.body.radius + 0.02


@pytest.mark.parametrize("rate", [5, 20.0, 30, 37.5, 60, 100.0])
def test_the_readings_fill_each_step_exactly(rate):
    env = make(rate=rate)
    assert env.imu_period * env.substeps == pytest.approx(1.0 / rate, rel=1e-12)
    assert abs(env.imu_period - 0.005) <= 0.005 / (2 * env.substeps - 1)
    observation, _ = env.reset(seed=0)
    assert observation["imu"].shape == (env.substeps, 6)
    before = env.state
    turning = HOVERING + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.5])
    observation, *_ = env.step(turning)
    turned = Rotation.from_matrix(before.R_world_body.T @ env.state.R_world_body).as_rotvec()
    np.testing.assert_allclose(observation["imu"][:, 3:].sum(axis=0) * env.imu_period, turned, atol=1e-6)
    assert env.time == pytest.approx(1.0 / rate)


def test_a_fast_rate_leaves_time_for_the_whole_flight():
    """A flight of more than 2000 steps, at 100 a second, is completed."""
    env = gym.make(ID, scene=SCENE, noise="none", imu_noise="none", camera=SMALL, flight="star", speed=0.5, rate=100)
    assert env.spec.max_episode_steps is None
    env.reset(seed=0)
    flying = env.unwrapped
    assert flying.task.duration / flying.dt > 2000
    flying.steps = int(np.ceil(flying.task.duration / flying.dt)) - 2
    end = flying.task.at(np.array([flying.time]))
    flying.state = FlightState(end.position[0], end.velocity[0], end.R_world_body[0])
    flying.world.reset(flying.state.position)
    ends = [env.step(HOVERING)[2:4] for _ in range(2)]
    assert ends == [(False, False), (True, False)]


def test_slow_flights_of_many_laps_are_refused():
    with pytest.raises(InputError, match="at most 600 s"):
        make().reset(options={"task": ReferenceFlight("star", 1.0, Placement((0.2, 0.1), 1.5, 0.0), laps=100)})


def test_the_camera_keeps_its_state_between_flights():
    env = make(sensor_noise="kinect")
    env.reset(seed=0)
    camera, imu, *_ = env.sensors
    sensor, readings = camera._sensor, imu._imu
    env.reset()
    assert camera._sensor is sensor and imu._imu is not readings
    env.reset(seed=0)
    assert camera._sensor is not sensor


def test_a_large_tracking_error_ends_the_flight():
    env = make()
    env.reset(seed=0)
    terminated, steps = False, 0
    while not terminated:
        _, _, terminated, _, info = env.step(HOVERING + np.array([0.0, 3.0, 0.0, 0.0, 0.0, 0.0]))
        steps += 1
    assert info["tracking_error"] > STRAYED and not info["success"] and steps > 5


def test_rewards_are_as_documented():
    env = make()
    env.reset(seed=0)
    _, reward, _, _, info = env.step(HOVERING)
    assert reward == pytest.approx(env.dt * (1.0 - info["tracking_error"]))


@pytest.mark.parametrize("keywords", [{}, {"observe_pose": True, "sensor_noise": "stereo", "noise": "high"}])
def test_gymnasiums_check_passes(keywords):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*")
        env = gym.make(ID, scene=SCENE, camera=SMALL, **keywords).unwrapped
        check_env(env, skip_render_check=True)
    env.close()


@pytest.mark.parametrize("sensor_noise", ["none", "stereo"])
def test_same_seed_same_bytes(sensor_noise):
    keywords = {"noise": "high", "imu_noise": "adis16448", "sensor_noise": sensor_noise, "flight": None, "speed": None}
    first, second = make(**keywords), make(**keywords)
    assert rollout(first, 5) == rollout(second, 5) == rollout(first, 5)
    assert rollout(first, 6) != rollout(second, 5)


def test_images_do_not_shift_the_motion():
    """Camera and gusts have separate streams, so that a noisier camera flies through the same gusts."""
    plain, noisy = make(noise="high"), make(noise="high", sensor_noise="stereo", imu_noise="realsense")
    for env in (plain, noisy):
        env.reset(seed=2)
        for _ in range(5):
            env.step(HOVERING)
    np.testing.assert_array_equal(plain.state.position, noisy.state.position)


def test_a_pickled_environment_continues_the_flight():
    env = make(noise="high", sensor_noise="stereo", imu_noise="adis16448")
    env.reset(seed=1)
    env.step(HOVERING)
    twin = pickle.loads(pickle.dumps(env))
    here, there = env.step(HOVERING), twin.step(HOVERING)
    for key in here[0]:
        np.testing.assert_array_equal(here[0][key], there[0][key])
    assert here[1:4] == there[1:4]


def test_the_pose_is_not_observed_by_default():
    assert set(make().observation_space.spaces) == {"rgb", "depth", "imu", "reference"}
    env = make(observe_pose=True)
    observation, info = env.reset(seed=0)
    np.testing.assert_allclose(observation["pose"][:3], info["T_world_cam"][:3, 3], atol=1e-6)
    R = Rotation.from_quat(observation["pose"][3:]).as_matrix()
    np.testing.assert_allclose(R[:, 0], info["T_world_cam"][:3, 2], atol=1e-6)  # the camera looks along body x
    np.testing.assert_allclose(observation["velocity"], 0.0, atol=1e-9)
    np.testing.assert_allclose(observation["imu"], np.tile(HOVERING, (env.substeps, 1)), atol=1e-5)


def test_a_given_task_is_flown():
    env = make()
    task = ReferenceFlight("star", 2.0, Placement((0.2, 0.1), 1.5, 0.0), "constant")
    _, info = env.reset(seed=0, options={"task": task})
    assert info["task"] is task
    np.testing.assert_allclose(info["start_pose"][:3, 3], task.at(np.zeros(1)).position[0])


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"noise": "loud"}, "noise"),
        ({"sensor_noise": "loud"}, "sensor_noise"),
        ({"imu_noise": "loud"}, "imu_noise"),
        ({"renderer": "paint"}, "renderer"),
        ({"flight": "loop"}, "flight"),
        ({"yaw": "up"}, "yaw"),
        ({"reward": "none"}, "reward"),
        ({"rate": 1.0}, "rate"),
        ({"rate": np.nan}, "rate"),
        ({"camera": 3}, "camera"),
        ({"speed": 15.0}, "speed"),
        ({"speed": -1.0}, "speed"),
        ({"speed": 0.01}, "speed"),
        ({"speed": 1e6}, "speed"),
        ({"speed": True}, "speed"),
        ({"speed": np.nan}, "speed"),
        ({"rate": True}, "rate"),
        ({"scene": hall(width=2.5)}, "space for the flight"),
    ],
)
def test_bad_keywords_are_refused(keywords, message):
    with pytest.raises(InputError, match=message):
        make(**keywords)


@pytest.mark.parametrize("action", [[0.0] * 5, [[0.0] * 6], [np.nan] + [0.0] * 5, ["a"] * 6, [[1.0], [1.0, 2.0]]])
def test_bad_actions_are_refused_and_change_nothing(action):
    env = make()
    env.reset(seed=0)
    before = env.state
    with pytest.raises(InputError, match=r"6 numbers|finite numbers"):
        env.step(action)
    assert env.state is before


def test_a_task_through_a_column_is_refused():
    env = make()
    with pytest.raises(InputError, match="it meets"):
        env.reset(options={"task": ReferenceFlight("figure8", 1.0, Placement((5.0, 5.0), 2.0, 0.0))})
    with pytest.raises(InputError, match="ReferenceFlight"):
        env.reset(options={"task": "star"})
    with pytest.raises(InputError, match="options"):
        env.reset(options={"flight": "star"})
    with pytest.raises(gym.error.ResetNeeded):
        make().step(HOVERING)
