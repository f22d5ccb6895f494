"""Keep what an environment observed, was told and answered in one episode."""

import copy
from collections.abc import Callable
from typing import Any, TypeAlias

import gymnasium as gym
import numpy as np

Wrap: TypeAlias = Callable[[gym.Env], gym.Env]


def unwrapped(env: gym.Env) -> gym.Env:
    """Return the environment as it is."""
    return env


class RecordedEnv(gym.Wrapper):
    """Pass everything on, and keep it until the next reset.

    Attributes:
        seed: of the last reset.
        options: of the last reset.
        observations: T + 1 of them, each a copy.
        actions: T, as they were given, before the environment clips them.
        rewards: T.
        terminations: T.
        truncations: T.
        infos: T + 1, each a copy.
    """

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode, and forget the one before."""
        observation, info = self.env.reset(seed=seed, options=options)
        self.seed, self.options = seed, options
        self.observations, self.infos = [_copied(observation)], [copy.deepcopy(info)]
        self.actions: list[np.ndarray] = []
        self.rewards: list[float] = []
        self.terminations: list[bool] = []
        self.truncations: list[bool] = []
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Carry out an action."""
        given = np.array(action)
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.actions.append(given)
        self.rewards.append(float(reward))
        self.terminations.append(bool(terminated))
        self.truncations.append(bool(truncated))
        self.observations.append(_copied(observation))
        self.infos.append(copy.deepcopy(info))
        return observation, reward, terminated, truncated, info


def _copied(observation: dict[str, Any]) -> dict[str, np.ndarray]:
    return {name: np.array(value) for name, value in observation.items()}
