"""Simulate robots on a line, where a training of a few steps takes no time."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from vssm_gym.geometry.scan import BEAMS


class Corridor(VectorEnv):
    """Simulate robots on a line: the goal is ``left`` m ahead, and within 0.4 m of it the episode ends."""

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012
    single_observation_space = gym.spaces.Dict(
        {
            "scan": gym.spaces.Box(0.0, 8.0, (BEAMS,), np.float32),
            "goal": gym.spaces.Box(-9.0, 9.0, (3,), np.float32),
            "pose": gym.spaces.Box(-9.0, 9.0, (3,), np.float32),
        }
    )
    single_action_space = gym.spaces.Box(-1.0, 1.0, (4,), np.float32)

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.left, self.steps = np.zeros(num_envs), np.zeros(num_envs, int)
        self.sent: list[np.ndarray] = []

    def _observe(self) -> dict[str, np.ndarray]:
        one, zero = np.ones(self.num_envs), np.zeros(self.num_envs)
        scan = np.tile(self.left[:, None], (1, BEAMS))
        found = {
            "scan": scan,
            "goal": np.stack([self.left, one, zero], -1),
            "pose": np.stack([-self.left, zero, zero], -1),
        }
        return {key: value.astype(np.float32) for key, value in found.items()}

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs, bool))
        self.left[mask], self.steps[mask] = 1.0, 0
        return self._observe(), {}

    def step(self, actions: np.ndarray) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        self.sent.append(actions)
        self.left, self.steps = self.left - actions[:, 2], self.steps + 1
        arrived, late = self.left <= 0.4, self.steps >= 12
        infos = {"success": arrived, "_success": arrived, "collision": np.arange(self.num_envs) == 1}
        return self._observe(), actions[:, 2].astype(np.float64), arrived, late & ~arrived, infos
