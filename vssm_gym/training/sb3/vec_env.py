"""Adapt Gymnasium's vector environments to stable-baselines3."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from stable_baselines3.common.vec_env import VecEnv

from vssm_gym.errors import InputError


class SB3VecEnv(VecEnv):
    """Adapt a Gymnasium vector environment to stable-baselines3, which resets ended episodes within the same step.

    Gymnasium's next-step autoreset returns the first observation of the next episode one step later, in a step that
    ignores its action. stable-baselines3 has no such step: it expects that observation at once, and the last one of the
    old episode in ``info["terminal_observation"]``, with ``info["TimeLimit.truncated"]`` where the episode
    was truncated (PPO adds the value of the last state). So ended episodes are reset here, by
    ``reset(options={"reset_mask": ended})``, before the vector environment would do it in its next step.

    Args:
        env: a vector environment with next-step autoreset or none; ``SyncVectorEnv``, ``AsyncVectorEnv`` with shared
            memory, or one of this package's own.
    """

    def __init__(self, env: VectorEnv) -> None:
        mode = env.metadata.get("autoreset_mode")
        if mode not in (AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED):
            expected = "one that resets in the next step, or not by itself (metadata['autoreset_mode'])"
            raise InputError("SB3VecEnv", "env", f"{expected}; found {mode}")
        self.env: Any = env  # Gymnasium declares neither seeds for each environment nor get_attr, set_attr and call
        self._actions: np.ndarray | None = None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> Any:
        """Begin episodes and return their first observations; seeds and options set before are used once."""
        seeds = None if all(seed is None for seed in self._seeds) else list(self._seeds)
        if any(options != self._options[0] for options in self._options):
            raise InputError("SB3VecEnv", "set_options", "the same options for all environments")
        observations, infos = self.env.reset(seed=seeds, options=dict(self._options[0]) or None)
        self.reset_infos = _rows(infos, self.num_envs)
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions ``(num_envs, ...)``; :meth:`step_wait` carries them out."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Execute the step; return observations (of new episodes where one ended), rewards, ends, and one info each."""
        observations, rewards, terminated, truncated, infos = self.env.step(self._actions)
        ended = np.asarray(terminated | truncated, dtype=bool)
        rows = _rows(infos, self.num_envs)
        for i, row in enumerate(rows):
            row["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
            if ended[i]:
                row["terminal_observation"] = _row(observations, i)
        if ended.any():
            observations, infos = self.env.reset(options={"reset_mask": ended.copy()})
            for i, row in enumerate(_rows(infos, self.num_envs)):
                if ended[i]:
                    self.reset_infos[i] = row
        return observations, np.asarray(rewards, dtype=np.float32), ended, rows

    def close(self) -> None:
        """Close the vector environment."""
        self.env.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Render each environment."""
        return list(self.env.render() or [None] * self.num_envs)

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return the vector environment's own attribute, the same for all, or that of each of its environments."""
        if hasattr(self.env, attr_name):
            values: Sequence[Any] = [getattr(self.env, attr_name)] * self.num_envs
        else:
            values = self.env.unwrapped.get_attr(attr_name)
        return [values[i] for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of every environment."""
        self._of_all(indices, "set_attr")
        self.env.unwrapped.set_attr(attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of every environment."""
        self._of_all(indices, "env_method")
        return list(self.env.unwrapped.call(method_name, *method_args, **method_kwargs))

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: Any = None) -> list[bool]:
        """Return False: vector environments are wrapped as a whole, by wrappers of their own."""
        return [False for _ in self._get_indices(indices)]

    def _of_all(self, indices: Any, method: str) -> None:
        if len(set(self._get_indices(indices))) != self.num_envs:
            raise InputError("SB3VecEnv", method, "all environments: vector environments cannot address some of them")


def _rows(infos: dict[str, Any], n: int) -> list[dict[str, Any]]:
    """Convert Gymnasium's dictionary of arrays, with masks ``_key`` for each ``key``, to one dictionary each."""
    rows: list[dict[str, Any]] = [{} for _ in range(n)]
    for key, values in infos.items():
        if key.startswith("_"):
            continue
        items = _rows(values, n) if isinstance(values, dict) else values
        for i in np.flatnonzero(infos.get(f"_{key}", np.ones(n, bool))):
            rows[i][key] = items[i]
    return rows


def _row(observations: Any, i: int) -> Any:
    """Copy one environment's observation."""
    if isinstance(observations, dict):
        return {key: _row(value, i) for key, value in observations.items()}
    return np.array(observations[i])
