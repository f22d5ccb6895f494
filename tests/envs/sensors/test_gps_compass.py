"""Test GPS and compass: the pose relative to the start, the stated law of errors, and Habitat's axes."""

import math

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import vssm_gym  # noqa: F401  (registers the environments)
from tests.helpers.box_rooms import two_rooms
from tests.helpers.car_worlds import yard
from vssm_gym.envs.sensors.base import GroundBody
from vssm_gym.envs.sensors.gps_compass import (
    PRESETS,
    GpsCompassConfig,
    GpsCompassNoise,
    GpsCompassSensor,
    HabitatGps,
    VectorHabitatGps,
    habitat_order,
)
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import matrix_to_planar, planar_to_matrix, wrap_angle

poses = st.tuples(st.floats(-50.0, 50.0), st.floats(-50.0, 50.0), st.floats(-math.pi, math.pi)).map(np.array)


def body(planar: np.ndarray) -> GroundBody:
    return GroundBody.at(np.asarray(planar, float), np.eye(4), 0.2)


def measured(start: np.ndarray, now: np.ndarray, noise: str | GpsCompassNoise = "none", seed: int = 0) -> np.ndarray:
    """Return forward, left and heading in one array."""
    sensor = GpsCompassSensor(GpsCompassConfig(noise))
    sensor.seed(np.random.default_rng(seed))
    sensor.begin(body(start))
    readings = sensor.measure(body(now))
    assert all(sensor.spaces[key].contains(reading) for key, reading in readings.items())
    return np.concatenate([readings["gps"], readings["compass"]])


def test_by_hand() -> None:
    """From a start that faces north, a metre north is forward, a metre west is left, and east is a quarter right."""
    start = np.array([2.0, 3.0, math.pi / 2])
    np.testing.assert_allclose(measured(start, start), 0.0)
    np.testing.assert_allclose(measured(start, [2.0, 4.0, math.pi / 2]), [1.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(measured(start, [1.0, 3.0, math.pi / 2]), [0.0, 1.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(measured(start, [2.0, 3.0, 0.0]), [0.0, 0.0, -math.pi / 2], atol=1e-6)


@given(poses, poses)
def test_it_is_the_relative_pose(start: np.ndarray, now: np.ndarray) -> None:
    """``T_start_now = T_world_start^-1 T_world_now``, by matrices."""
    T_start_now = np.linalg.inv(planar_to_matrix(start)) @ planar_to_matrix(now)
    expected, found = np.asarray(matrix_to_planar(T_start_now)), measured(start, now)
    np.testing.assert_allclose(found[:2], expected[:2], atol=1e-4)
    assert abs(wrap_angle(float(found[2] - expected[2]))) < 1e-5


def habitat(start: np.ndarray, now: np.ndarray) -> tuple[np.ndarray, float]:
    """Return ``gps`` and ``compass`` as habitat-lab computes them, of poses in its frame: x right, y up, -z forward.

    World x, y, z here are its -z, -x, y there; a heading turns about y there by the same angle.
    """

    def position(planar: np.ndarray) -> np.ndarray:
        return np.array([-planar[1], 0.0, -planar[0]])

    def rotation(planar: np.ndarray) -> Rotation:
        return Rotation.from_rotvec([0.0, planar[2], 0.0])

    local = rotation(start).inv().apply(position(now) - position(start))
    ahead = (rotation(now).inv() * rotation(start)).apply([0.0, 0.0, -1.0])
    return np.array([-local[2], local[0]]), math.atan2(ahead[0], -ahead[2])


@given(poses, poses)
def test_the_wrapper_gives_habitats_numbers(start: np.ndarray, now: np.ndarray) -> None:
    found, (gps, compass) = measured(start, now), habitat(start, now)
    np.testing.assert_allclose(habitat_order({"gps": found[:2]})["gps"], gps, atol=1e-4)
    assert abs(wrap_angle(float(found[2] - compass))) < 1e-5


@pytest.mark.parametrize("level", PRESETS)
def test_errors_follow_their_law(level: str) -> None:
    """Independent normals of the stated widths, from step to step and between the coordinates."""
    noise, start = PRESETS[level], np.array([1.0, -2.0, 3.0])
    sensor = GpsCompassSensor(GpsCompassConfig(level))
    sensor.seed(np.random.default_rng(1))
    sensor.begin(body(start))
    readings = [sensor.measure(body(start)) for _ in range(4000)]
    errors = np.array([[*r["gps"], *r["compass"]] for r in readings])
    wide = np.array([noise.position, noise.position, noise.heading])
    np.testing.assert_allclose(errors.std(axis=0), wide, rtol=0.05)
    np.testing.assert_allclose(errors.mean(axis=0), 0.0, atol=4.0 * wide.max() / math.sqrt(4000.0) + 1e-12)
    if level != "none":
        both = np.corrcoef(np.concatenate([errors[1:], errors[:-1]], axis=1), rowvar=False)
        np.testing.assert_allclose(both, np.eye(6), atol=0.07)


@pytest.mark.parametrize("change", [{"position": -1.0}, {"heading": math.nan}, {"position": math.inf}])
def test_impossible_noise_is_refused(change: dict) -> None:
    with pytest.raises(InputError, match="GpsCompassNoise"):
        GpsCompassNoise(**change)


@pytest.mark.parametrize("name", ["PointNav", "ImageNav", "Explore", "CarNav"])
def test_every_environment_measures_from_the_start_of_its_episode(name: str) -> None:
    """The measurement equals the true relative pose in every episode; at its start a robot measures zero."""
    scene = yard(3.0, 3.0) if name == "CarNav" else two_rooms()
    env = gym.make(f"vssm_gym/{name}-v0", scene=scene, camera={"width": 32, "height": 24}, sensors=["gps_compass"])
    for seed in (0, None):
        observation, info = env.reset(seed=seed)
        start = np.asarray(info["start_pose"])
        np.testing.assert_array_equal(observation["gps"], 0.0)
        action = 0.5 * env.action_space.high
        action[-1] = 0.0
        for _ in range(5):
            observation = env.step(action.astype(np.float32))[0]
        robot = env.unwrapped if name == "CarNav" else env.unwrapped.simulation
        now = robot.planar
        found = np.concatenate([observation["gps"], observation["compass"]])
        np.testing.assert_allclose(found, measured(start, now), atol=1e-6)
        assert np.hypot(*found[:2]) > 0.05
    env.close()


def test_a_chained_episode_measures_from_where_it_begins() -> None:
    env = gym.make("vssm_gym/CarNav-v0", scene=yard(4.0, 4.0), images=False, chain=True, sensors=["gps_compass"])
    env.reset(seed=0)
    for _ in range(10):
        observation = env.step(np.array([0.5, 0.0], np.float32))[0]
    assert observation["gps"][0] > 0.1
    np.testing.assert_array_equal(env.reset()[0]["gps"], 0.0)


def test_single_and_vector_wrappers_agree() -> None:
    keywords = {"scene": two_rooms(), "camera": {"width": 32, "height": 24}, "sensors": ["gps_compass"]}
    plain = gym.make("vssm_gym/PointNav-v0", **keywords)
    alone = HabitatGps(gym.make("vssm_gym/PointNav-v0", **keywords))
    many = VectorHabitatGps(gym.make_vec("vssm_gym/PointNav-v0", num_envs=2, **keywords))
    many.reset(seed=3), alone.reset(seed=3), plain.reset(seed=3)
    action = np.array([0.1, 0.08, 0.16, 0.0], np.float32)
    for _ in range(3):
        ours, one, batch = plain.step(action)[0], alone.step(action)[0], many.step(np.tile(action, (2, 1)))[0]
    np.testing.assert_array_equal(one["gps"], ours["gps"] * [1.0, -1.0])
    np.testing.assert_array_equal(batch["gps"][0], one["gps"])
    np.testing.assert_array_equal(batch["compass"][0], one["compass"])
    assert ours["gps"][1] != 0.0
    for wrapper, env in (
        (HabitatGps, gym.make("vssm_gym/PointNav-v0")),
        (VectorHabitatGps, gym.make_vec("vssm_gym/PointNav-v0")),
    ):
        with pytest.raises(InputError, match="gps_compass"):
            wrapper(env)
