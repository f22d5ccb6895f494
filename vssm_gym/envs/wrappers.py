"""Wrap one environment so that it observes what policies need (:mod:`.vector_wrappers` wraps many).

``depth_only``, ``normalized_depth`` and ``relative_goal`` transform an observation. They act on the last axes, so that
the classes of this module (for ``gym.make``), those for ``gym.make_vec`` and the environments' own keywords share them.
"""

from typing import Any

import gymnasium as gym
import numpy as np

from vssm_gym.envs.conventions.relative_goal import (
    Observation,
    is_reckoned,
    reckoned,
    relative_goal,
    sensed_pose,
    with_relative_goal,
)
from vssm_gym.envs.sensors.depth_image import POLICY_MAX_DEPTH, normalized
from vssm_gym.errors import InputError


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
    """Observe ``goal`` by distance and bearing from the robot (:mod:`vssm_gym.envs.conventions.relative_goal`).

    The robot's pose is the observed one, if there is one (``observe_pose=True``), else that of GPS and compass, if it
    carries them. Otherwise it is dead reckoning: the known start and the robot's own commands, as if they had been
    executed exactly. It drifts; the true pose is never used.

    Args:
        env: an environment that observes ``goal`` in the map, and observes ``pose``, observes ``gps`` and ``compass``,
            or takes PointNav's ``(turn, o, s, stop)``.
    """

    def __init__(self, env: gym.Env) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        super().__init__(env)
        self.observation_space = with_sensed_goal(env.observation_space, env.action_space)
        self._reckons = is_reckoned(self.observation_space)
        self._start = self._believed = np.zeros(3)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; the estimate is the known start."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._start = self._believed = np.asarray(info["start_pose"], dtype=np.float64)
        return self._shown(observation), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Carry out ``action`` and update the estimate by it."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        if self._reckons:
            self._believed = reckoned(self._believed, info["control"])
        return self._shown(observation), reward, terminated, truncated, info

    def _shown(self, observation: Observation) -> Observation:
        return relative_goal(observation, sensed_pose(observation, self._start, self._believed))


def depth_only(observation: Observation) -> Observation:
    """Return the observation without ``rgb``."""
    return {key: value for key, value in observation.items() if key != "rgb"}


def normalized_depth(observation: Observation, max_depth: float) -> Observation:
    """Return the observation with ``depth`` in [0, 1], 0 = no reading, in images ``(*batch, height, width)``."""
    return observation | {"depth": normalized(observation["depth"], max_depth)}


def without_colour(space: gym.Space) -> gym.spaces.Dict:
    """Return the space of :func:`depth_only`."""
    found = _observed(space, "depth", "DepthOnly")
    return gym.spaces.Dict({key: item for key, item in found.items() if key != "rgb"})


def with_normalized_depth(space: gym.Space) -> gym.spaces.Dict:
    """Return the space of :func:`normalized_depth`."""
    found = _observed(space, "depth", "NormalizedDepth")
    return gym.spaces.Dict(dict(found) | {"depth": gym.spaces.Box(0.0, 1.0, found["depth"].shape, np.float32)})


def with_sensed_goal(space: gym.Space, action_space: gym.Space) -> gym.spaces.Dict:
    """Return the space of :class:`RelativeGoal`; raise InputError for commands that cannot be dead-reckoned."""
    found = with_relative_goal(space)
    if is_reckoned(found) and action_space.shape != (4,):
        expected = f"an observed pose, GPS, or commands (turn, o, s, stop) to reckon with; found actions {action_space}"
        raise InputError("RelativeGoal", "env", expected)
    return found


def checked_max_depth(max_depth: float) -> float:
    """Return ``max_depth`` as a float; raise :class:`InputError` unless it is positive and finite."""
    if not (isinstance(max_depth, int | float) and np.isfinite(max_depth) and max_depth > 0.0):
        raise InputError("NormalizedDepth", "max_depth", f"a positive number of metres; found {max_depth!r}")
    return float(max_depth)


def _observed(space: gym.Space, key: str, wrapper: str) -> gym.spaces.Dict:
    if not isinstance(space, gym.spaces.Dict) or key not in space.spaces:
        raise InputError(wrapper, "env", f"an environment that observes {key!r}; this one observes {space!s:.80}")
    return space
