"""Convert depth images to the scans of :mod:`vssm_gym.geometry.scan`, in one environment and in vector environments."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv, VectorObservationWrapper
from gymnasium.vector.utils import batch_space

from vssm_gym.envs.conventions.relative_goal import Observation
from vssm_gym.errors import InputError
from vssm_gym.geometry.scan import BEAMS, MAX_DEPTH, scan_of


class ScanObservation(gym.ObservationWrapper[Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Observe ``scan (64,)`` in place of ``rgb`` and ``depth``; the rest of the observation stays.

    ``ScanObservation(RelativeGoal(env))`` of a PointNav that observes its pose has the spaces of WorldModelNav.

    Args:
        env: an environment that observes ``depth``, at least 64 pixels wide.
        max_depth: m.
    """

    def __init__(self, env: gym.Env, max_depth: float = MAX_DEPTH) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, max_depth=max_depth)
        super().__init__(env)
        self.max_depth = max_depth
        self.observation_space = with_scan(env.observation_space, max_depth)

    def observation(self, observation: Observation) -> Observation:
        """Return the observation with a scan."""
        return scanned(observation, self.max_depth)


class VectorScanObservation(VectorObservationWrapper):
    """Observe ``scan (n, 64)`` in place of ``rgb`` and ``depth``, for vector environments."""

    def __init__(self, env: VectorEnv, max_depth: float = MAX_DEPTH) -> None:
        super().__init__(env)
        self.max_depth = max_depth
        self.single_observation_space = with_scan(env.single_observation_space, max_depth)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    def observations(self, observations: Observation) -> Observation:
        """Return the observations with scans."""
        return scanned(observations, self.max_depth)


def scanned(observation: Observation, max_depth: float) -> Observation:
    """Return the observation with ``scan`` in place of the images."""
    kept = {key: value for key, value in observation.items() if key not in ("rgb", "depth")}
    return kept | {"scan": scan_of(observation["depth"], max_depth)}


def with_scan(space: gym.Space, max_depth: float) -> gym.spaces.Dict:
    """Return the space of :func:`scanned`."""
    if not isinstance(space, gym.spaces.Dict) or "depth" not in space.spaces:
        raise InputError("ScanObservation", "env", f"an environment that observes 'depth'; found {space!s:.80}")
    if (shape := space["depth"].shape or (0, 0))[1] < BEAMS:
        raise InputError("ScanObservation", "env", f"depth images at least {BEAMS} pixels wide; found {shape}")
    if isinstance(max_depth, bool) or not (isinstance(max_depth, int | float) and 0.0 < max_depth < np.inf):
        raise InputError("ScanObservation", "max_depth", f"a positive number of metres; found {max_depth!r:.80}")
    kept = {key: item for key, item in space.items() if key not in ("rgb", "depth")}
    return gym.spaces.Dict(kept | {"scan": gym.spaces.Box(0.0, max_depth, (BEAMS,), np.float32)})
