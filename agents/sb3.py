"""For policies trained with stable-baselines3 (the extra ``vssm-gym[rl]``): what they see with, and what they step.

    env = SB3VecEnv(gym.make_vec("vssm_gym/PointNav-v0", num_envs=8, observe_pose=True, end_on="reach"))
    PPO("MultiInputPolicy", env, policy_kwargs={"features_extractor_class": RGBDExtractor}).learn(1_000_000)

This module alone imports torch. Docs: ``docs/rl.md``.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from vssm_gym.errors import InputError

METRES = 10.0  # lengths of goals and poses are divided by this: of the order of one inside an apartment


class RGBDExtractor(BaseFeaturesExtractor):
    """``features = MLP([CNN(rgb, clip(depth / max_depth), depth > 0), MLP(goal[, pose])])``.

    The image has five channels, or two without ``rgb``: colour in [0, 1] as stable-baselines3 hands it over, depth in
    [0, 1], and whether there was a reading at all, so that "nothing measured" is not mistaken for "touching". Four
    convolutions of stride two take images of any size. The goal is ``(x, y)`` in m, or the ``(distance, cos, sin)`` of
    :class:`vssm_gym.envs.wrappers.RelativeGoal`; a pose enters as ``(x, y, cos, sin)``.

    Args:
        observation_space: ``Dict(depth[, rgb][, goal][, pose])``; ``rgb`` with channels first, as stable-baselines3's
            policies have it after their own transposition.
        features_dim: length of the feature vector.
        max_depth: m, shown as 1 and beyond; 1 for depth that :class:`vssm_gym.envs.wrappers.NormalizedDepth` scaled.
    """

    def __init__(self, observation_space: gym.spaces.Dict, features_dim: int = 256, max_depth: float = 5.0) -> None:
        super().__init__(observation_space, features_dim)
        shapes = _checked(observation_space)
        if not max_depth > 0.0:
            raise InputError("RGBDExtractor", "max_depth", f"a positive number of metres; found {max_depth!r}")
        self.max_depth = max_depth
        first = channels = 5 if "rgb" in shapes else 2
        layers: list[nn.Module] = []
        for width in (32, 64, 64, 64):
            layers += [nn.Conv2d(channels, width, kernel_size=3, stride=2, padding=1), nn.ReLU()]
            channels = width
        self.cnn = nn.Sequential(*layers, nn.Flatten())
        with torch.no_grad():
            seen = self.cnn(torch.zeros(1, first, *shapes["depth"])).shape[1]
        numbers = shapes.get("goal", (0,))[0] + (4 if "pose" in shapes else 0)
        self.mlp = nn.Sequential(nn.Linear(numbers, 64), nn.ReLU()) if numbers else None
        self.join = nn.Sequential(nn.Linear(seen + (64 if numbers else 0), features_dim), nn.ReLU())

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """Features ``(batch, features_dim)`` of preprocessed observations."""
        parts = [self.cnn(self.image(observations))]
        if self.mlp is not None:
            parts.append(self.mlp(self.numbers(observations)))
        return self.join(torch.cat(parts, dim=1))

    def image(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """``(batch, 5 or 2, height, width)``: colour where there is one, scaled depth, whether depth was read."""
        depth = observations["depth"][:, None]
        channels = [torch.clamp(depth / self.max_depth, 0.0, 1.0), (depth > 0.0).to(depth.dtype)]
        if "rgb" in observations:
            channels.insert(0, observations["rgb"])
        return torch.cat(channels, dim=1)

    @staticmethod
    def numbers(observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """``(batch, n)``: goal and pose, lengths over :data:`METRES`, the heading as a point of the unit circle."""
        parts = []
        if "goal" in observations:
            goal = observations["goal"]
            lengths = 2 if goal.shape[1] == 2 else 1  # (x, y), or (distance, cos, sin)
            parts += [goal[:, :lengths] / METRES, goal[:, lengths:]]
        if "pose" in observations:
            pose = observations["pose"]
            parts += [pose[:, :2] / METRES, torch.cos(pose[:, 2:]), torch.sin(pose[:, 2:])]
        return torch.cat(parts, dim=1)


def _checked(space: gym.spaces.Dict) -> dict[str, tuple[int, ...]]:
    """The shapes of an observation's parts, where :class:`RGBDExtractor` can read all of them."""
    parts = space.spaces if isinstance(space, gym.spaces.Dict) else {}
    shapes = {key: part.shape or () for key, part in parts.items()}
    if len(shapes.get("depth", ())) != 2:
        raise InputError("RGBDExtractor", "depth", f"an image (height, width) among the observations; found {space}")
    if "rgb" in shapes and shapes["rgb"] != (3, *shapes["depth"]):
        expected = f"channels first, of the depth image's size, {(3, *shapes['depth'])}; found {shapes['rgb']}"
        raise InputError("RGBDExtractor", "rgb", expected)
    if unknown := set(shapes) - {"depth", "rgb", "goal", "pose"}:
        raise InputError("RGBDExtractor", "observation_space", f"depth, rgb, goal, pose; found {sorted(unknown)} too")
    return shapes


class SB3VecEnv(VecEnv):
    """A Gymnasium vector environment as stable-baselines3 expects one: an episode that ends starts anew in that step.

    Gymnasium's next-step autoreset hands out the first observation of the next episode one step later, in a step whose
    action counts for nothing. stable-baselines3 has no such step: it expects that observation at once, and the last
    one of the old episode in ``info["terminal_observation"]``, with ``info["TimeLimit.truncated"]`` where the episode
    was cut off rather than finished (PPO adds the value of what was cut off). So what has ended is reset here, by
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
        """First observations of new episodes; seeds and options set before are used once."""
        seeds = None if all(seed is None for seed in self._seeds) else list(self._seeds)
        if any(options != self._options[0] for options in self._options):
            raise InputError("SB3VecEnv", "set_options", "the same options for all environments")
        observations, infos = self.env.reset(seed=seeds, options=dict(self._options[0]) or None)
        self.reset_infos = _rows(infos, self.num_envs)
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Remember the actions ``(num_envs, ...)``; :meth:`step_wait` carries them out."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Observations (of new episodes where one ended), rewards, which ended, and an info for each environment."""
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
        """What each environment renders."""
        return list(self.env.render() or [None] * self.num_envs)

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The vector environment's own attribute, the same for all, or that of each of its environments."""
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
        """False: vector environments are wrapped as a whole, by wrappers of their own."""
        return [False for _ in self._get_indices(indices)]

    def _of_all(self, indices: Any, method: str) -> None:
        if len(set(self._get_indices(indices))) != self.num_envs:
            raise InputError("SB3VecEnv", method, "all environments: vector environments cannot address some of them")


def _rows(infos: dict[str, Any], n: int) -> list[dict[str, Any]]:
    """Gymnasium's dictionary of arrays, with a mask ``_key`` beside each ``key``, as a dictionary an environment."""
    rows: list[dict[str, Any]] = [{} for _ in range(n)]
    for key, values in infos.items():
        if key.startswith("_"):
            continue
        items = _rows(values, n) if isinstance(values, dict) else values
        for i in np.flatnonzero(infos.get(f"_{key}", np.ones(n, bool))):
            rows[i][key] = items[i]
    return rows


def _row(observations: Any, i: int) -> Any:
    """A copy of one environment's observation."""
    if isinstance(observations, dict):
        return {key: _row(value, i) for key, value in observations.items()}
    return np.array(observations[i])
