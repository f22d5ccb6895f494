"""Split a batch of imagined robots into equal slices, each stepped by a thread of its own.

XLA rarely distributes the loops of one program over the cores of a CPU, and robots do not interact. So where robots see
images each slice is stepped by a program for one core. Scans are so fast that two calls cost more than sharing gains,
and an accelerator steps all robots at once.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vssm_gym.envs.world_model.step import BatchState, Programs, empty_state, observe, programs
from vssm_gym.envs.world_model.world import ImaginedWorld, Robot

MIN_SLICE = 8  # robots: smaller slices cost more in calls than another core gains
MIN_RESTART = 8  # robots: up to so many, or an eighth of a slice, are restarted by a small call, more by one for all


class BatchSlices:
    """Step and restart ``n`` robots; returned arrays are NumPy's, read-only."""

    def __init__(self, robot: Robot, world: ImaginedWorld, n: int) -> None:
        self._robot, self._world = robot, world
        slices = _slice_count(n) if world.view.scan_table is None else 1
        self._states = [empty_state(world, n // slices) for _ in range(slices)]
        self._shown: list[dict[str, Any]] = []
        self._compiled = False

    @property
    def state(self) -> BatchState:
        """Return the state of all robots."""
        return _joined(self._states)

    def seed(self, keys: np.ndarray, mask: np.ndarray) -> None:
        """Give the robots of ``mask`` new random streams, ``keys (n, 2)`` uint32, from their first draw on."""
        slices = len(self._states)
        for i, (key, some) in enumerate(zip(np.split(keys, slices), np.split(mask, slices), strict=True)):
            state = self._states[i]
            streams = jnp.where(some[:, None], jnp.asarray(key, jnp.uint32), state.key)
            draws = jnp.where(some, 0, state.draws)
            self._states[i] = eqx.tree_at(lambda s: (s.key, s.draws), state, (streams, draws))

    def restart(self, mask: np.ndarray, task: np.ndarray) -> dict[str, np.ndarray]:
        """Begin an episode of the robots of ``mask`` and return the observations of all robots.

        ``task`` ``(n,)`` holds numbers of tasks; -1 draws one.
        """
        restart, n, slices = self.programs.restart, len(self._states[0].steps), len(self._states)
        few = min(n, max(MIN_RESTART, n // 8))
        if not self._shown:
            like = jax.eval_shape(observe, self._world, self._states[0])
            shown = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), like)
            self._shown = [shown] * slices
            if few < n:  # compiled now, not in the middle of an episode
                nobody = jnp.full(few, n, jnp.int32)
                restart(self._robot, self._world, self._states[0], shown, nobody, jnp.zeros_like(nobody))

        def one(i: int, mask: np.ndarray, task: np.ndarray) -> None:
            chosen = np.flatnonzero(mask)
            if len(chosen) == 0:
                return
            width = few if len(chosen) <= few else n
            index, tasks = np.full(width, n, np.int32), np.full(width, -1, np.int32)
            index[: len(chosen)], tasks[: len(chosen)] = chosen, task[chosen]
            self._states[i], self._shown[i] = jax.block_until_ready(
                restart(
                    self._robot, self._world, self._states[i], self._shown[i], jnp.asarray(index), jnp.asarray(tasks)
                )
            )

        self._everywhere(one, np.split(mask, slices), np.split(task, slices))
        return _joined(self._shown)

    def step(self, action: np.ndarray) -> Any:
        """Carry out ``action (n, command)`` and return the :class:`~vssm_gym.envs.world_model.step.Outcome`."""
        outcomes: list[Any] = [None] * len(self._states)

        def one(i: int, action: np.ndarray) -> None:
            self._states[i], outcomes[i] = jax.block_until_ready(
                self.programs.step(self._robot, self._world, self._states[i], jnp.asarray(action, jnp.float32))
            )
            self._shown[i] = outcomes[i].observation

        self._everywhere(one, np.split(action, len(self._states)))
        self._compiled = True
        return _joined(outcomes)

    @property
    def programs(self) -> Programs:
        """Return the compiled programs that step and restart the robots."""
        return programs(one_core=len(self._states) > 1)

    def _everywhere(self, one: Callable[..., None], *parts: list[np.ndarray]) -> None:
        work = list(zip(range(len(self._states)), *parts, strict=True))
        if len(work) == 1 or not self._compiled:  # one after the other at first: the second finds it compiled
            for args in work:
                one(*args)
        else:
            list(_threads(len(work)).map(lambda args: one(*args), work))


@cache
def _threads(slices: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(slices)


def _slice_count(n: int) -> int:
    """Return the number of slices of n robots: one a core, as far as slices are equal and hold at least MIN_SLICE."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if jax.default_backend() != "cpu":
        return 1
    return max((slices for slices in range(1, cores + 1) if n % slices == 0 and n // slices >= MIN_SLICE), default=1)


def _joined(parts: list[Any]) -> Any:
    def join(*arrays: Any) -> np.ndarray:
        whole = np.asarray(arrays[0]) if len(arrays) == 1 else np.concatenate(arrays)
        whole.flags.writeable = False
        return whole

    return jax.tree.map(join, *parts)
