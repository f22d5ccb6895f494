"""Test drives: which drivers receive the true pose, and which goals count as reached."""

import math

import numpy as np
import pytest
import shapely

from tests.helpers.box_rooms import two_rooms
from tests.helpers.planning_worlds import voxel_map
from vssm_gym.agents.base import Decision
from vssm_gym.agents.shared.localization import Localization
from vssm_gym.envs.pointnav import PointNavEnv
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.envs.tasks.navigation import TaskSampler
from vssm_gym.eval.bench.drive import drive
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.inference.status import Status

STEPS = 120


class Homing:
    """Drive straight at the goal by the observed pose; stop there, or give up after ``patience`` steps."""

    name, needs_pose, needs_map = "homing", True, False

    def __init__(self, patience=15):
        self.patience, self.driven, self.stops = patience, 0, []

    def reset(self, context, observation, seed):
        assert "pose" in observation

    def act(self, observation):
        x, y, heading = (float(v) for v in observation["pose"])
        ahead = observation["goal"] - np.array([x, y])
        away = math.hypot(*ahead)
        if away < 0.3 or self.driven >= self.patience:
            self.stops.append(away)
            self.driven = 0
            return Decision(np.array([0.0, 0.0, 0.0, 1.0], np.float32), None, "stop")
        self.driven += 1
        turn = float(wrap_angle(math.atan2(ahead[1], ahead[0]) - heading))
        step = 0.16 if abs(turn) < 0.2 else 0.0
        return Decision(np.array([np.clip(turn, -0.2, 0.2), 0.0, step, 0.0], np.float32), None, "driving")


class Wandering:
    """Drive without a pose, and keep all observations."""

    name, needs_pose, needs_map = "wandering", False, False

    def __init__(self):
        self.seen = []

    def reset(self, context, observation, seed):
        self.seen.append(set(observation))

    def act(self, observation):
        self.seen.append(set(observation))
        return Decision(np.array([0.1, 0.0, 0.05, float(len(self.seen) % 4 == 0)], np.float32), None, "")


class Rider:
    """Localise, and keep all observations."""

    def __init__(self):
        self.seen = []

    def reset(self, context, observation):
        return self.update(None, observation)

    def update(self, command, observation):
        self.seen.append(set(observation))
        return Localization(np.zeros(3), np.zeros(3), Status.OK)


@pytest.fixture(scope="module")
def world():
    camera = CameraConfig(width=32, height=24)
    env = PointNavEnv(scene=two_rooms(), noise="none", camera=camera, observe_pose=True, reward="sparse")
    yield env, TaskSampler(env.apartment, env.robot), voxel_map(shapely.box(0.0, 0.0, 6.0, 4.0), [])
    env.close()


@pytest.mark.parametrize("driver", [Homing(), Wandering()])
def test_the_true_pose_is_for_a_driver_that_needs_it(world, driver):
    env, sampler, learned = world
    rider = Rider()
    done = drive(env, sampler, driver, {"rider": rider}, learned, seed=1, steps=20)
    images = {"rgb", "depth", "goal"}
    assert len(rider.seen) == len(done.true) == 21
    assert all(names == images for names in [*rider.seen, *getattr(driver, "seen", [])])


def test_a_goal_given_up_is_not_a_goal_reached(world):
    env, sampler, learned = world
    driver = Homing()
    done = drive(env, sampler, driver, {}, learned, seed=2, steps=STEPS)
    reached = sum(away <= env.success_radius for away in driver.stops)
    assert 0 < reached < len(driver.stops)
    assert done.goals == reached
