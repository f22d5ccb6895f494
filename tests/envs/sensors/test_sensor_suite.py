"""Test every sensor of the registry on every environment that takes sensors, and the list of them."""

import gc
import pickle
import warnings
import weakref
from importlib import import_module
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from tests.helpers.box_rooms import two_rooms
from tests.helpers.car_worlds import yard
from vssm_gym.envs.phased import keywords_of
from vssm_gym.envs.registration import ENVIRONMENTS
from vssm_gym.envs.sensors.registry import SENSORS, parse_sensors
from vssm_gym.envs.sensors.suite import SensorSuite
from vssm_gym.envs.sensors.task_observation import TaskObservation
from vssm_gym.errors import InputError

SMALL = {"camera": {"width": 32, "height": 24}, "noise": "mid", "sensor_noise": "kinect"}
SCENES = {"CarNav": yard(3.0, 3.0)}
ROOMS = two_rooms()


def loaded(path: str) -> Any:
    """Import the object at ``module:name``."""
    module, name = path.split(":")
    return getattr(import_module(module), name)


TAKE_SENSORS = [
    name
    for name, spec in ENVIRONMENTS.items()
    if hasattr(loaded(spec.env), "passes_to") and "sensors" in keywords_of(loaded(spec.env)) and not spec.keywords
]
WORLDS = [(name, {}) for name in TAKE_SENSORS] + [("vssm_gym/CarNav-v0", {"physics": "bullet"})]
IDS = ["-".join([name.split("/")[1], *more.values()]) for name, more in WORLDS]
each_world = pytest.mark.parametrize(("name", "more"), WORLDS, ids=IDS)
each_sensor = pytest.mark.parametrize("sensor", SENSORS)


def settings(name: str, more: dict, **keywords) -> dict:
    if more.get("physics") == "bullet":
        pytest.importorskip("pybullet", reason="the bullet extra is not installed")
    scene = SCENES.get(name.removeprefix("vssm_gym/").removesuffix("-v0"), ROOMS)
    return {"scene": scene, **SMALL, **more, **keywords}


def rollout(env: gym.Env, seed: int = 3, steps: int = 12) -> list[dict[str, bytes]]:
    """Return every reading of an episode at full speed ahead, which soon ends at a wall; each is in its space."""
    action = env.action_space.high.copy()
    action[:-1] *= [0.05, 0.0, 1.0] if len(action) == 4 else [1.0]
    action[-1] = 0.0
    said = []
    for step in range(steps):
        observation = env.reset(seed=seed)[0] if step == 0 else env.step(action)[0]
        assert env.observation_space.contains(observation)
        said.append({key: value.tobytes() for key, value in observation.items()})
    return said


def test_the_environments_that_take_sensors_are_those_of_robots_on_the_ground():
    assert {"vssm_gym/PointNav-v0", "vssm_gym/ImageNav-v0", "vssm_gym/Explore-v0", "vssm_gym/CarNav-v0"} == set(
        TAKE_SENSORS
    )


@each_world
@each_sensor
def test_a_sensor_adds_its_keys_and_changes_no_byte_of_the_others(name, more, sensor):
    plain, env = (gym.make(name, **settings(name, more, sensors=sensors)) for sensors in ([], [sensor]))
    without, said = rollout(plain), rollout(env)
    added = set(said[0]) - set(without[0])
    assert added and added == set(env.observation_space.spaces) - set(plain.observation_space.spaces)
    assert [{key: value for key, value in one.items() if key not in added} for one in said] == without
    plain.close()
    env.close()


@each_world
@each_sensor
def test_readings_do_not_depend_on_the_other_sensors(name, more, sensor):
    one, all_of_them = (gym.make(name, **settings(name, more, sensors=s)) for s in ([sensor], [*reversed(SENSORS)]))
    said = rollout(one)
    assert rollout(one) == said  # again, in the same environment
    among_others = rollout(all_of_them)
    assert [{key: value for key, value in step.items() if key in said[0]} for step in among_others] == said
    one.close()
    all_of_them.close()


@each_world
def test_both_checkers_accept_all_sensors_at_once(name, more):
    keywords = settings(name, more, sensors=list(SENSORS), observe_pose=True)
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason="the rl extra is not installed")
    env = gym.make(name, **keywords)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*")  # advice for networks, not a fault
        check_env(env.unwrapped, skip_render_check=True)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=UserWarning)  # it would rather have square images and other actions
        checker.check_env(env)
    env.close()


@each_world
def test_a_vector_environment_reads_like_single_ones_and_a_pickled_one_goes_on(name, more):
    keywords = settings(name, more, sensors=list(SENSORS))
    vector, alone = gym.make_vec(name, num_envs=2, **keywords), gym.make(name, **keywords).unwrapped
    action = 0.5 * alone.action_space.high
    action[-1] = 0.0
    batches = [vector.reset(seed=5)[0], vector.step(np.tile(action, (2, 1)).astype(np.float32))[0]]
    for i in range(2):
        readings = [alone.reset(seed=5 + i)[0], alone.step(action)[0]]
        for batch, reading in zip(batches, readings, strict=True):
            for key, value in reading.items():
                np.testing.assert_array_equal(batch[key][i], value)
    if more.get("physics") != "bullet":  # Bullet's solver keeps caches to itself
        twin = pickle.loads(pickle.dumps(alone))
        for ours, theirs in ((alone.step(action)[0], twin.step(action)[0]) for _ in range(2)):
            for key, value in ours.items():
                np.testing.assert_array_equal(theirs[key], value)
    vector.close()
    alone.close()


@pytest.mark.parametrize("sensor", SENSORS)
def test_names_configurations_and_mappings_ask_for_the_same(sensor):
    config = SENSORS[sensor]()
    assert [config] == parse_sensors("test", [sensor]) == parse_sensors("test", (config,))
    assert parse_sensors("test", [{"sensor": sensor, **vars(config)}]) == [config]


@pytest.mark.parametrize("value", ["lidar", 3, None, {"sensor": "lidar"}, ["radar"], [3], [None], [{"beams": 3}]])
def test_an_invalid_list_names_the_known_sensors(value):
    with pytest.raises(InputError) as error:
        parse_sensors("Explore", value)
    assert (error.value.source, error.value.field) == ("Explore", "sensors")
    assert all(sensor in error.value.expected for sensor in SENSORS)


@each_sensor
def test_an_unknown_field_and_a_sensor_that_is_listed_twice_are_refused(sensor):
    with pytest.raises(InputError, match=f"sensors: {sensor}: expected .*{SENSORS[sensor].__name__}.*colour"):
        parse_sensors("test", [{"sensor": sensor, "colour": "red"}])
    with pytest.raises(InputError, match=f"each sensor once; '{sensor}' occurs twice"):
        parse_sensors("test", [sensor, SENSORS[sensor]()])


class CallCounter:
    """Measure how many times the measurement was called."""

    def __init__(self) -> None:
        self.asked = 0

    def tell(self) -> np.ndarray:
        self.asked += 1
        return np.full(1, float(self.asked), np.float32)


def test_two_sensors_of_one_key_are_refused():
    space, tell = gym.spaces.Box(0.0, 1.0, (1,), np.float32), CallCounter().tell
    with pytest.raises(InputError, match="'a' would be measured twice"):
        SensorSuite("test", [TaskObservation(key, space, tell) for key in "aba"])


def test_a_suite_measures_once_per_pose_and_returns_copies():
    teller, space = CallCounter(), gym.spaces.Box(0.0, 9.0, (1,), np.float32)
    suite: SensorSuite[None] = SensorSuite("test", [TaskObservation("a", space, teller.tell)])
    suite.begin(None)
    for _ in range(3):
        suite.sense(None)
    suite.observation()["a"][:] = 7.0
    assert suite.observation()["a"] == suite.reading("a") == 1.0
    suite.moved()
    suite.sense(None)
    assert suite.reading("a") == 2.0


def test_sensors_keep_no_closed_environment_in_memory():
    """A closed environment is freed with its last reference, without the garbage collector."""
    gc.collect()
    gc.disable()
    try:
        for name, more in WORLDS:
            env = gym.make(name, **settings(name, more, sensors=[*SENSORS]))
            env.reset(seed=0)
            gone = weakref.ref(env.unwrapped)
            env.close()
            del env
            assert gone() is None, name
    finally:
        gc.enable()
