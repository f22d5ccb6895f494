"""Express a goal of the map by distance and bearing from the robot.

    point (x, y)             (d, cos b, sin b)                            d in m; b counter-clockwise from ahead
    pose  (x, y, heading)    (d, cos b, sin b, cos h, sin h)              h = heading - the robot's heading

The robot's pose comes from its own sensors: an observed pose, else GPS and compass from the known start, else the
commands, as if they had been executed exactly.
"""

from typing import Any, Literal

import gymnasium as gym
import numpy as np
from jaxtyping import Float

from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.robots.base import Robot
from vssm_gym.envs.scenes.apartment_parts import MAX_COORDINATE
from vssm_gym.errors import InputError
from vssm_gym.geometry.axes import PlanarPose
from vssm_gym.geometry.transforms import wrap_angle

MAX_GOAL_DISTANCE = 2.0 * MAX_COORDINATE * np.sqrt(2.0)  # m
GoalForm = Literal["map", "sensed", "true"]
GOAL_FORMS = ("map", "sensed", "true")
_HOLONOMIC = HolonomicRobot()

Observation = dict[str, np.ndarray]


def relative_goal(observation: Observation, pose: Float[np.ndarray, "*batch 3"]) -> Observation:
    """Return the observation with ``goal (*batch, 3)`` of a point, or ``(*batch, 5)`` of a pose, seen from ``pose``."""
    goal = observation["goal"].astype(np.float64)
    away = goal[..., :2] - pose[..., :2]
    bearing = np.arctan2(away[..., 1], away[..., 0]) - pose[..., 2]
    parts = [np.linalg.norm(away, axis=-1), np.cos(bearing), np.sin(bearing)]
    if goal.shape[-1] == 3:
        turn = goal[..., 2] - pose[..., 2]
        parts += [np.cos(turn), np.sin(turn)]
    return observation | {"goal": np.stack(parts, axis=-1).astype(np.float32)}


def sensed_pose(
    observation: Observation, start: Float[np.ndarray, "*batch 3"], reckoned: Float[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 3"]:
    """Return the pose that the robot senses: the observed one, that of GPS and compass, or else the ``reckoned`` one.

    Args:
        observation: ``pose``, or ``gps`` (forward, left) and ``compass`` relative to ``start``, or neither.
        start: the pose at the episode's start, which the robot knows.
        reckoned: the pose after its commands (:func:`reckoned`).
    """
    if "pose" in observation:
        return np.asarray(observation["pose"], dtype=np.float64)
    if "gps" not in observation:
        return reckoned
    (forward, left), turned = np.moveaxis(observation["gps"].astype(np.float64), -1, 0), observation["compass"][..., 0]
    c, s = np.cos(start[..., 2]), np.sin(start[..., 2])
    x, y = start[..., 0] + c * forward - s * left, start[..., 1] + s * forward + c * left
    return np.stack([x, y, wrap_angle(start[..., 2] + turned.astype(np.float64))], axis=-1)


def is_reckoned(space: gym.spaces.Dict) -> bool:
    """Return True if :func:`sensed_pose` of these observations is the reckoned pose."""
    return "pose" not in space.spaces and "gps" not in space.spaces


def reckoned(believed: PlanarPose, control: np.ndarray, robot: Robot = _HOLONOMIC) -> PlanarPose:
    """Return the pose after the robot's command ``control`` from ``believed`` without noise and obstacles."""
    return robot.execute(believed, control, robot.parse_noise("none"), np.random.default_rng(0))


def with_relative_goal(space: gym.Space[Any]) -> gym.spaces.Dict:
    """Return the space of :func:`relative_goal`; raise :class:`InputError` where there is no goal in the map."""
    if not isinstance(space, gym.spaces.Dict) or "goal" not in space.spaces:
        raise InputError("RelativeGoal", "env", f"an environment that observes 'goal'; this one observes {space!s:.80}")
    goal = space["goal"]
    # A goal that is relative already has the sines of angles; one in the map has coordinates
    if goal.shape not in ((2,), (3,)) or goal.high[0] > MAX_COORDINATE:  # type: ignore[attr-defined]
        raise InputError("RelativeGoal", "goal", f"a point (x, y) or a pose (x, y, heading) of the map; found {goal}")
    angles = 2 * (int(goal.shape[0]) - 1)
    low = np.array([0.0] + [-1.0] * angles, np.float32)
    high = np.array([MAX_GOAL_DISTANCE] + [1.0] * angles, np.float32)
    return gym.spaces.Dict(dict(space.spaces) | {"goal": gym.spaces.Box(low, high)})
