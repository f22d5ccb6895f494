"""Implement ``gym.make("vssm_gym/WorldModelNav-v0", map="oak.npz")``: a vector environment of one imagined robot."""

import inspect
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from vssm_gym.envs.phased import signature_of
from vssm_gym.envs.rendering.frames import Frames
from vssm_gym.envs.validation import check_options
from vssm_gym.envs.world_model.config import SOURCE, Imagination
from vssm_gym.envs.world_model.vector import WorldModelVectorEnv
from vssm_gym.errors import InputError


class WorldModelNavEnv(gym.Env[dict[str, Any], np.ndarray]):
    """Imagine one robot in the belief of a learned map.

    Registered as ``vssm_gym/WorldModelNav-v0``, truncated after 500 steps.

    Args:
        map: a map file's path, ``oak``, which comes with the package, or a :class:`~vssm_gym.maps.voxel_map.VoxelMap`.
        render_mode: ``rgb_array``, ``human`` (a window) or None.
        captions: if True, a strip of text lies below each picture; a window always shows it.
        keywords: all further keywords: those of :class:`~vssm_gym.envs.world_model.config.Imagination`.
    """

    passes_to = Imagination
    __signature__: ClassVar[inspect.Signature]
    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 5}  # noqa: RUF012  (Gymnasium's own declaration)

    def __init__(
        self, map: Any = None, render_mode: str | None = None, captions: bool = False, **keywords: Any
    ) -> None:
        self.frames, self.render_mode = Frames(SOURCE, render_mode, captions), render_mode
        self.vector = WorldModelVectorEnv(map, 1, -1, render_mode and "rgb_array", **keywords)
        self.action_space = self.vector.single_action_space
        self.observation_space = self.vector.single_observation_space
        self.success_radius, self.robot = self.vector.success_radius, self.vector.robot
        self._running = False

    @property
    def planar(self) -> np.ndarray:
        """Return the true pose of the imagined robot: x, y (m), heading (rad); not for agents."""
        return self.vector.planar[0]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode with ``options["task"]``, the number of a task of the pool, or with one that is drawn."""
        super().reset(seed=seed)
        observation, infos = self.vector.reset(seed=seed, options=check_options(options, "task"))
        self._running = True
        if self.render_mode == "human":
            self.render()
        return _first(observation), _info(infos) | _still(self.vector)

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Carry out ``action``; raise ``ResetNeeded`` where no episode is under way."""
        if not self._running:
            raise gym.error.ResetNeeded("call reset before step: no episode has begun, or the last one has ended")
        try:
            batch = np.asarray(action)[None]
        except ValueError:  # a ragged list
            raise InputError(
                "step", "action", f"numbers of shape {self.action_space.shape}; found {action!r:.80}"
            ) from None
        observation, reward, terminated, truncated, infos = self.vector.step(batch)
        self._running = not (terminated[0] or truncated[0])
        if self.render_mode == "human":
            self.render()
        return _first(observation), float(reward[0]), bool(terminated[0]), bool(truncated[0]), _info(infos)

    def close(self) -> None:
        """Free the batch; the environment cannot be reset or stepped afterwards."""
        self.vector.close()
        self.frames.close()

    def render(self) -> np.ndarray | None:
        """Draw the robot on the belief's floor plan, uint8 ``(height, width, 3)``; in mode ``human`` show it instead.

        Returns None before the first reset and without ``render_mode``.
        """
        plans = [] if self.render_mode is None else self.vector.plans()
        if not plans:
            return None
        ((plan, captions),) = plans
        try:
            return self.frames.render([plan], captions, SOURCE, self.metadata["render_fps"])
        except SystemExit:  # the user has closed the window
            self.close()
            raise


WorldModelNavEnv.__signature__ = signature_of(WorldModelNavEnv)


def _first(observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return copies of the first robot's observations."""
    return {key: np.array(value[0]) for key, value in observation.items()}


def _info(infos: dict[str, Any]) -> dict[str, Any]:
    return {key: _plain(values[0]) for key, values in infos.items() if not key.startswith("_") and infos[f"_{key}"][0]}


def _plain(value: Any) -> Any:
    return value.item() if np.ndim(value) == 0 else np.array(value)


def _still(vector: WorldModelVectorEnv) -> dict[str, Any]:
    """Return the fields that every info holds, for a robot that has not moved."""
    return {"collision": False, "control": np.zeros(len(vector.world.low), np.float32)}
