"""Wrap vector environments as :mod:`vssm_gym.envs.wrappers` wraps one, under the same names, as Gymnasium does.

The vector environment must reset in the next step or not at all; one that resets in the same step is refused.
"""

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv, VectorObservationWrapper, VectorWrapper
from gymnasium.vector.utils import batch_space

from vssm_gym.envs.conventions.relative_goal import Observation, is_reckoned, reckoned, relative_goal, sensed_pose
from vssm_gym.envs.sensors.depth_image import POLICY_MAX_DEPTH
from vssm_gym.envs.wrappers import (
    checked_max_depth,
    depth_only,
    normalized_depth,
    with_normalized_depth,
    with_sensed_goal,
    without_colour,
)
from vssm_gym.errors import InputError


class DepthOnly(VectorObservationWrapper):
    """Remove the colour images from the observations."""

    def __init__(self, env: VectorEnv) -> None:
        super().__init__(env)
        self.single_observation_space = without_colour(env.single_observation_space)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    def observations(self, observations: Observation) -> Observation:
        """Return the observations without colour."""
        return depth_only(observations)


class NormalizedDepth(VectorObservationWrapper):
    """``depth' = min(depth / max_depth, 1)``; 0 = no reading."""

    def __init__(self, env: VectorEnv, max_depth: float = POLICY_MAX_DEPTH) -> None:
        super().__init__(env)
        self.max_depth = checked_max_depth(max_depth)
        self.single_observation_space = with_normalized_depth(env.single_observation_space)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    def observations(self, observations: Observation) -> Observation:
        """Return the observations with normalised depth."""
        return normalized_depth(observations, self.max_depth)


class RelativeGoal(VectorWrapper):
    """Observe ``goal`` by distance and bearing from the observed, sensed or dead-reckoned poses."""

    def __init__(self, env: VectorEnv) -> None:
        super().__init__(env)
        if env.metadata.get("autoreset_mode") not in (AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED):
            found = f"found {env.metadata.get('autoreset_mode')}"
            raise InputError("RelativeGoal", "env", f"one that resets in the next step, or not by itself; {found}")
        self.single_observation_space = with_sensed_goal(env.single_observation_space, env.single_action_space)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._reckons = is_reckoned(self.single_observation_space)
        self._start, self._believed = np.zeros((2, self.num_envs, 3))

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Start episodes: of all environments, or of those in ``options["reset_mask"]``."""
        observations, infos = self.env.reset(seed=seed, options=options)
        self._begin(infos)
        return self._shown(observations), infos

    def step(self, actions: Any) -> tuple[Observation, Any, Any, Any, dict[str, Any]]:
        """Carry out ``actions``; environments whose episode had ended begin at their new start."""
        observations, rewards, terminations, truncations, infos = self.env.step(actions)
        begun = self._begin(infos)
        if self._reckons:
            for i in np.flatnonzero(~begun):
                self._believed[i] = reckoned(self._believed[i], infos["control"][i])
        return self._shown(observations), rewards, terminations, truncations, infos

    def _shown(self, observations: Observation) -> Observation:
        return relative_goal(observations, sensed_pose(observations, self._start, self._believed))

    def _begin(self, infos: dict[str, Any]) -> np.ndarray:
        """Set the pose estimates of the environments that have just been reset to their known starts.

        Return which, a mask.
        """
        begun = infos.get("_start_pose", np.zeros(self.num_envs, bool))
        if begun.any():
            self._start[begun] = self._believed[begun] = np.asarray(infos["start_pose"], np.float64)[begun]
        return begun
