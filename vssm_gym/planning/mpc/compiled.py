"""Call a solver that is one compiled function: tables, warm start and key in, :class:`MpcResult` out."""

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.mpc.fields import FieldCache, Fields
from vssm_gym.planning.mpc.problem import MpcProblem, MpcResult, checked_pose, last_control
from vssm_gym.planning.mpc.selection import Selection, to_result
from vssm_gym.planning.value_iteration import CostToGo

Search = Callable[
    [Fields, Float[Array, "3"], Float[Array, "2"], Float[Array, "time 2"], PRNGKeyArray], tuple[Selection, Array]
]
"""``(tables, state, last command, last plan, key) -> (chosen plan, whether the solver converged to it)``."""


class CompiledSearch:
    """Call a :data:`Search`: compiled for each shape of map, never for another pose, goal or map of that shape."""

    def __init__(self, problem: MpcProblem, search: Search, iterations: int) -> None:
        self.problem, self.iterations = problem, iterations
        key = jax.random.key(problem.config.seed)
        numbered = lambda fields, state, last, plan, step: search(
            fields, state, last, plan, jax.random.fold_in(key, step)
        )
        self.search: Any = jax.jit(numbered)
        self._fields = FieldCache(problem.car)
        self._compiled: set[tuple[tuple[int, ...], tuple[int, ...]]] = set()

    def plan(
        self,
        state: np.ndarray,
        value: CostToGo,
        clearance: ClearanceMap,
        warm: MpcResult | None,
        control: np.ndarray | None,
    ) -> MpcResult:
        """See :meth:`~vssm_gym.planning.mpc.problem.MpcSolver.plan`. Compilation does not count as solution time."""
        pose, last = checked_pose(state), last_control(self.problem, warm, control)
        fields = self._fields.of(value, clearance)
        step = 0 if warm is None else warm.step + 1
        plan = np.zeros((self.problem.config.horizon, 2)) if warm is None else warm.controls
        inputs = (fields, *(jnp.asarray(a, jnp.float32) for a in (pose, last, plan)), np.int32(step))
        if fields.shapes not in self._compiled:
            jax.block_until_ready(self.search(*inputs))
            self._compiled.add(fields.shapes)
        began = time.perf_counter()
        selection, converged = jax.device_get(self.search(*inputs))
        seconds = time.perf_counter() - began
        return to_result(self.problem, selection, bool(converged), seconds, self.iterations, step)
