"""Wrap one environment so that it observes what policies need (:mod:`.vector_wrappers` wraps many).

``depth_only``, ``normalized_depth`` and ``relative_goal`` below transform an observation. They act on the last axes, so
that the classes of this module (for ``gym.make``) and those for ``gym.make_vec`` share them.
"""

from typing import Any

import gymnasium as gym
import numpy as np

from vssm_gym.envs.robots import ExecutionNoise, execute
from vssm_gym.envs.scenes.apartment_parts import MAX_COORDINATE
from vssm_gym.errors import InputError
from vssm_gym.geometry.axes import PlanarPose

POLICY_MAX_DEPTH = 5.0  # m: across most rooms; a policy needs no distinction beyond
MAX_GOAL_DISTANCE = 2.0 * MAX_COORDINATE * np.sqrt(2.0)  # m
_EXACT = ExecutionNoise(0.0, 0.0)  # no execution noise

Observation = dict[str, np.ndarray]


class DepthOnly(gym.ObservationWrapper[Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Remove the colour image from the observation: ``depth`` and ``goal`` (and ``pose``) stay as they are."""

    def __init__(self, env: gym.Env) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        super().__init__(env)
        self.observation_space = without_colour(env.observation_space)

    def observation(self, observation: Observation) -> Observation:
        """Return the observation without colour."""
        return depth_only(observation)


class NormalizedDepth(gym.ObservationWrapper[Any, Any, Any], gym.utils.RecordConstructorArgs):
    """``depth' = min(depth / max_depth, 1)``: 0 remains no reading, and no reading but that becomes 0.

    Args:
        env: an environment that observes ``depth``, m.
        max_depth: m; larger depths become 1.
    """

    def __init__(self, env: gym.Env, max_depth: float = POLICY_MAX_DEPTH) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, max_depth=max_depth)
        super().__init__(env)
        self.max_depth = checked_max_depth(max_depth)
        self.observation_space = with_normalized_depth(env.observation_space)

    def observation(self, observation: Observation) -> Observation:
        """Return the observation with normalised depth."""
        return normalized_depth(observation, self.max_depth)


class RelativeGoal(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Observe ``goal`` as ``(distance, cos(bearing), sin(bearing))``, m, relative to the robot's pose estimate.

    The estimate is the observed pose, if there is one (``observe_pose=True``). Otherwise it is dead reckoning: the
    known start and the robot's own commands, as if they had been executed exactly. It drifts; the true pose is never
    used.

    Args:
        env: an environment that observes ``goal``, and either observes ``pose`` or takes PointNav's ``(turn, o, s,
            stop)``.
    """

    def __init__(self, env: gym.Env) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        super().__init__(env)
        self.observation_space = with_relative_goal(env.observation_space, env.action_space)
        self._believed = np.zeros(3)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; the estimate is the known start."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._believed = np.asarray(info["start_pose"], dtype=np.float64)
        return relative_goal(observation, self._believed), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Carry out ``action`` and update the estimate by it."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        if "pose" not in observation:
            self._believed = reckoned(self._believed, info["control"])
        return relative_goal(observation, self._believed), reward, terminated, truncated, info


def depth_only(observation: Observation) -> Observation:
    """Return the observation without ``rgb``."""
    return {key: value for key, value in observation.items() if key != "rgb"}


def normalized_depth(observation: Observation, max_depth: float) -> Observation:
    """Return the observation with ``depth`` in [0, 1], 0 = no reading, in images ``(*batch, height, width)``."""
    return observation | {"depth": np.minimum(observation["depth"] / np.float32(max_depth), np.float32(1.0))}


def relative_goal(observation: Observation, believed: np.ndarray) -> Observation:
    """Return the observation with ``goal (*batch, 3)`` relative to the observed pose, or to ``believed``."""
    pose = np.asarray(observation.get("pose", believed), dtype=np.float64)
    away = observation["goal"].astype(np.float64) - pose[..., :2]
    bearing = np.arctan2(away[..., 1], away[..., 0]) - pose[..., 2]
    goal = np.stack([np.linalg.norm(away, axis=-1), np.cos(bearing), np.sin(bearing)], axis=-1)
    return observation | {"goal": goal.astype(np.float32)}


def reckoned(believed: PlanarPose, control: np.ndarray) -> PlanarPose:
    """Return the pose after ``control`` (turn, o, s) from ``believed`` without noise and obstacles."""
    return execute(believed, control, _EXACT, np.random.default_rng(0))


def without_colour(space: gym.Space) -> gym.spaces.Dict:
    """Return the space of :func:`depth_only`."""
    found = _observed(space, "depth", "DepthOnly")
    return gym.spaces.Dict({key: item for key, item in found.items() if key != "rgb"})


def with_normalized_depth(space: gym.Space) -> gym.spaces.Dict:
    """Return the space of :func:`normalized_depth`."""
    found = _observed(space, "depth", "NormalizedDepth")
    return gym.spaces.Dict(dict(found) | {"depth": gym.spaces.Box(0.0, 1.0, found["depth"].shape, np.float32)})


def with_relative_goal(space: gym.Space, action_space: gym.Space) -> gym.spaces.Dict:
    """Return the space of :func:`relative_goal`; raise InputError for commands that cannot be dead-reckoned."""
    found = _observed(space, "goal", "RelativeGoal")
    if found["goal"].shape != (2,):
        raise InputError("RelativeGoal", "goal", f"a point (x, y); found shape {found['goal'].shape}")
    if "pose" not in found.spaces and action_space.shape != (4,):
        expected = f"an observed pose, or commands (turn, o, s, stop) to reckon with; found actions {action_space}"
        raise InputError("RelativeGoal", "env", expected)
    low, high = np.array([0.0, -1.0, -1.0], np.float32), np.array([MAX_GOAL_DISTANCE, 1.0, 1.0], np.float32)
    return gym.spaces.Dict(dict(found) | {"goal": gym.spaces.Box(low, high)})


def checked_max_depth(max_depth: float) -> float:
    """Return ``max_depth`` as a float; raise :class:`InputError` unless it is positive and finite."""
    if not (isinstance(max_depth, int | float) and np.isfinite(max_depth) and max_depth > 0.0):
        raise InputError("NormalizedDepth", "max_depth", f"a positive number of metres; found {max_depth!r}")
    return float(max_depth)


def _observed(space: gym.Space, key: str, wrapper: str) -> gym.spaces.Dict:
    if not isinstance(space, gym.spaces.Dict) or key not in space.spaces:
        raise InputError(wrapper, "env", f"an environment that observes {key!r}; this one observes {space!s:.80}")
    return space
