"""Run many environments in one process: all move, then all sense in parallel, in as many threads as there are cores.

``gym.make_vec("vssm_gym/PointNav-v0", num_envs=16)`` returns this. Environments of one scene share its renderer and its
free space (:mod:`vssm_gym.envs.sensors.shared_renderer`, :mod:`vssm_gym.envs.tasks.scene_cache`). Episodes restart
as Gymnasium's ``AutoresetMode.NEXT_STEP`` says: the step after the last one of an episode ignores its action and
returns the next episode's first observation with reward 0.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib import import_module
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array

from vssm_gym.envs.phased import PhasedEnv
from vssm_gym.envs.registration import ENVIRONMENTS
from vssm_gym.envs.rendering.captions import Tally
from vssm_gym.envs.validation import vector_seeds
from vssm_gym.errors import InputError


class PhasedVectorEnv(VectorEnv):
    """Run ``num_envs`` environments of one class; see the module.

    Args:
        make: builds one environment from keywords.
        num_envs: number of environments.
        max_episode_steps: steps after which an episode is truncated; -1 for none.
        scene: one scene for all, or a sequence of scenes that the environments take in turn.
        threads: threads that sense; by default as many as there are cores.
        keywords: keywords of each environment.
    """

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012  (Gymnasium's own declaration)

    def __init__(
        self,
        make: Callable[..., PhasedEnv],
        num_envs: int = 1,
        max_episode_steps: int = -1,
        scene: Any = None,
        threads: int | None = None,
        **keywords: Any,
    ) -> None:
        if keywords.get("render_mode") == "human":
            expected = "'rgb_array' or None: a window shows one environment, of gym.make"
            raise InputError("make_vec", "render_mode", expected)
        if num_envs < 1:
            raise InputError("make_vec", "num_envs", f"at least 1; found {num_envs!r}")
        if max_episode_steps != -1 and not _whole(max_episode_steps):
            expected = f"a whole number, at least 1, or -1 for no limit; found {max_episode_steps!r}"
            raise InputError("make_vec", "max_episode_steps", expected)
        if threads is not None and not _whole(threads):
            raise InputError("make_vec", "threads", f"a whole number, at least 1, or None; found {threads!r}")
        scenes = list(scene) if isinstance(scene, Sequence) and not isinstance(scene, str) else [scene]
        if not scenes:
            raise InputError("make_vec", "scene", "at least one scene; found an empty list")
        chosen = [{} if scenes == [None] else {"scene": scenes[i % len(scenes)]} for i in range(num_envs)]
        self.envs = [make(**one, **keywords) for one in chosen]
        first = self.envs[0]
        self.metadata = {**first.metadata, **self.metadata}
        self.num_envs, self.render_mode = num_envs, first.render_mode
        self.single_action_space, self.single_observation_space = first.action_space, first.observation_space
        self.action_space = batch_space(first.action_space, num_envs)
        self.observation_space = batch_space(first.observation_space, num_envs)
        self.max_episode_steps = max_episode_steps
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self._threads = min(num_envs, cores if threads is None else threads) if first.parallel else 1
        self._pool = ThreadPoolExecutor(self._threads - 1, "sense") if self._threads > 1 else None
        self._steps = np.zeros(num_envs, dtype=np.int64)
        self._ended, self._begun = np.zeros(num_envs, dtype=bool), np.zeros(num_envs, dtype=bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode in every environment, or in those of ``options["reset_mask"]``.

        Args:
            seed: one for each environment, or the first of consecutive ones; None: their streams continue.
            options: options of every environment's reset, and ``reset_mask`` ``(num_envs,)`` bool.
        """
        self._check_open()
        seeds = vector_seeds(seed, self.num_envs)
        if options is not None and not isinstance(options, dict):
            raise InputError("reset", "options", f"a dictionary or None; found {options!r:.80}")
        options = dict(options or {})
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, dtype=bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            raise InputError("reset", "options['reset_mask']", f"{self.num_envs} booleans, one of them true")
        if not (self._begun | mask).all():
            raise gym.error.ResetNeeded("the first reset is one of all environments: reset_mask comes later")
        for i in np.flatnonzero(mask):
            self.envs[i].begin(seeds[i], options or None)
            self.envs[i].tally = None
            self._begun[i] = True
        self._steps[mask], self._ended[mask] = 0, False
        observation, _, _, _, infos = self._gather(mask)
        return observation, infos

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Carry out one action for each environment; those whose episode has ended start their next one instead.

        Raises :class:`InputError`, without any effect, for actions that are not ``num_envs`` finite ones of the right
        shape.
        """
        self._check_open()
        if not self._begun.all():
            raise gym.error.ResetNeeded("call reset before step")
        batch = self._checked(actions)
        restarted = self._ended.copy()
        for i, (env, action) in enumerate(zip(self.envs, batch, strict=True)):
            if restarted[i]:
                env.begin()
                self._steps[i], env.tally = 0, None
            else:
                env.advance(action)
                self._steps[i] += 1
        observation, rewards, terminated, truncated, infos = self._gather(np.ones(self.num_envs, dtype=bool))
        truncated |= (self._steps >= self.max_episode_steps) & (self.max_episode_steps > 0) & ~restarted
        self._ended = terminated | truncated
        return observation, rewards, terminated, truncated, infos

    def _checked(self, actions: Any) -> np.ndarray:
        batch, space = np.asarray(actions), self.single_action_space
        if isinstance(space, gym.spaces.Discrete):
            expected = f"whole numbers from 0 to {space.n - 1}"
            valid = batch.dtype.kind in "iu" and bool(((batch >= 0) & (batch < space.n)).all())
        else:
            expected, valid = "finite numbers", batch.dtype.kind in "fiu" and bool(np.isfinite(batch).all())
        if not valid or batch.shape != self.action_space.shape:
            found = f"found {batch.dtype} {batch.shape}, {actions!r:.80}"
            raise InputError("step", "actions", f"{expected} of shape {self.action_space.shape}; {found}")
        return batch

    def render(self) -> tuple[Any, ...] | None:
        """Return every environment's picture."""
        return None if self.render_mode is None else tuple(env.render() for env in self.envs)

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Return the attribute ``name`` of every environment, called with the arguments where it is a method."""
        values = (getattr(env, name) for env in self.envs)
        return tuple(value(*args, **kwargs) if callable(value) else value for value in values)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return the attribute ``name`` of every environment."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of every environment: one value for all, or a list of one each."""
        each = values if isinstance(values, list | tuple) else [values] * self.num_envs
        if len(each) != self.num_envs:
            raise InputError("set_attr", name, f"one value, or {self.num_envs} of them; found {len(each)}")
        for env, value in zip(self.envs, each, strict=True):
            setattr(env, name, value)

    def close_extras(self, **_: Any) -> None:
        """Stop the threads and close the environments."""
        if self._pool is not None:
            self._pool.shutdown()
        for env in self.envs:
            env.close()

    def _check_open(self) -> None:
        if self.closed:
            raise gym.error.ClosedEnvironmentError("the environments are closed: make new ones")

    def _gather(self, fresh: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Sense in all environments and stack the reports; infos are of the ``fresh`` environments."""
        self._sense()
        reports = [env.report() for env in self.envs]
        infos: dict[str, Any] = {}
        for i in np.flatnonzero(fresh):
            env, (_, reward, terminal, _, info) = self.envs[i], reports[i]
            env.tally = Tally() if env.tally is None else env.tally.after(reward, terminal, info)
            infos = self._add_info(infos, info, int(i))
        empty: Any = create_empty_array(self.single_observation_space, self.num_envs)
        observation = concatenate(self.single_observation_space, [report[0] for report in reports], empty)
        rewards = np.array([report[1] for report in reports], dtype=np.float64)
        terminated = np.array([report[2] for report in reports], dtype=bool)
        truncated = np.array([report[3] for report in reports], dtype=bool)
        return observation, rewards, terminated, truncated, infos

    def _sense(self) -> None:
        if self._pool is None:
            for env in self.envs:
                env.sense()
            return
        shares = [self._pool.submit(_sense_in_turn, self.envs[k :: self._threads]) for k in range(1, self._threads)]
        _sense_in_turn(self.envs[:: self._threads])
        for share in shares:
            share.result()


def _sense_in_turn(envs: list[PhasedEnv]) -> None:
    for env in envs:
        env.sense()


def _whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 1


def _of(path: str) -> Callable[..., PhasedVectorEnv]:
    """Return the vector entry point of the environment class at ``module:name``."""

    def make(**keywords: Any) -> PhasedEnv:
        module, name = path.split(":")
        return getattr(import_module(module), name)(**keywords)

    return partial(PhasedVectorEnv, make)


def __getattr__(name: str) -> Callable[..., PhasedVectorEnv]:
    """Return the vector entry point that a row of the environments' table calls ``name``."""
    for spec in ENVIRONMENTS.values():
        if spec.vector == f"{__name__}:{name}":
            return _of(spec.env)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
