"""Make small suites of the benchmark, and programs of strangers that enter them."""

from pathlib import Path

from tests.helpers.box_rooms import two_rooms
from vssm_gym.envs.scenes.scene import save_scene
from vssm_gym.eval.benchmark.suite import freeze

ROOMS = """name: rooms
tracks:
  mapping:
    kind: driving
    about: Drive to a point of two rooms that nobody has mapped.
    score: spl
    unmapped: true
    seconds: 20
    sweep: {scenes: rooms.json, noise: low, tasks: 2}
  car:
    kind: driving
    about: Park in the arena.
    score: timely
    pose: observed
    seconds: 20
    sweep: {env: vssm_gym/CarNav-v1, robot: car, scenes: arena, tasks: 1}
"""
AGENT = '''"""An agent of a stranger."""

import os

import numpy as np
import vssm_gym as vg
from strangers_help import STEP


class Straight:
    """Turn towards the goal, drive straight at it, and stop."""

    name, robot, task, needs_pose, needs_map = "strangers_straight", "holonomic", "pointgoal", False, False

    def reset(self, context, observation, seed):
        self.context, self.pose = context, np.array(context.start_pose, float)

    def act(self, observation):
        offset = observation["goal"] - self.pose[:2]
        distance, bearing = np.hypot(*offset), np.arctan2(offset[1], offset[0]) - self.pose[2]
        bearing = (bearing + np.pi) % (2.0 * np.pi) - np.pi
        turn = float(np.clip(bearing, -self.context.limits[0], self.context.limits[0]))
        arrived = distance < 0.5 * self.context.success_radius
        step = 0.0 if arrived or abs(bearing) > 0.01 else min(STEP, float(distance))
        self.pose[:2] += step * np.array([np.cos(self.pose[2]), np.sin(self.pose[2])])
        self.pose[2] += turn
        action = np.array([turn, 0.0, step, float(arrived)], np.float32)
        return vg.Decision(action, self.pose.copy(), "driving")


class Crashing(Straight):
    """Fail at the third step of an episode."""

    name = "strangers_crash"

    def reset(self, context, observation, seed):
        super().reset(context, observation, seed)
        self.steps = 0

    def act(self, observation):
        self.steps += 1
        if self.steps == 3:
            raise ArithmeticError("no answer")
        return super().act(observation)


class Dying(Straight):
    """End the process at the first step of an episode."""

    name = "strangers_death"

    def act(self, observation):
        os._exit(3)


class Remembering(Straight):
    """Fail where it has driven before."""

    name = "strangers_memory"

    def reset(self, context, observation, seed):
        super().reset(context, observation, seed)
        self.episodes = getattr(self, "episodes", 0) + 1
        assert self.episodes == 1, "it remembers"
'''


def write_suite(folder: Path, text: str = ROOMS) -> Path:
    """Write the scene and the frozen suite of it; return the suite's file."""
    save_scene(two_rooms(), folder / "rooms.json")
    path = folder / "suite.yaml"
    path.write_text(text)
    freeze(path)
    return path


def write_agents(folder: Path, name: str = "strangers_agents") -> Path:
    """Write a stranger's file, which imports another one beside it."""
    (folder / "strangers_help.py").write_text("STEP = 0.15  # m\n")
    path = folder / f"{name}.py"
    path.write_text(AGENT)
    return path
