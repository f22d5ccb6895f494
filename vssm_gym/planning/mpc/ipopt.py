"""Solve by multiple shooting: CasADi differentiates, IPOPT solves, in float64 (eq. P31). The only importer of CasADi.

    min over z_1..z_T, u_0..u_{T-1} of C(u, z)   s.t.  z_{t+1} = z_t + R(heading_t) arc(u_t),  clearance, limits, rates

The tables enter as parameters: uniform cubic B-splines (C2, as IPOPT's Hessian needs) over windows of the cost-to-go
round the place where the plan is expected to end, and of the clearance as far as the car can get. Their values are
looked up by indices computed in the graph, so the solver is built once and no step, goal or map rebuilds it.

Two smooth stand-ins: the spline takes the cost-to-go's table as coefficients, which blurs it by half a cell and cannot
overshoot where it jumps, and ``min(s, J)`` is rounded over a tenth of ``s``. The clearance's spline interpolates. The
resulting plan is evaluated by the same tables as those of the other solvers.
"""

import math
import time
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vssm_gym.errors import InputError
from vssm_gym.model.transition import Bicycle
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.mpc.candidates import ProposalConfig, propose
from vssm_gym.planning.mpc.fields import FieldCache, Fields
from vssm_gym.planning.mpc.lagrangian import RefineConfig, refine
from vssm_gym.planning.mpc.objective import required_clearance, rollout, within_rates
from vssm_gym.planning.mpc.problem import MpcProblem, MpcResult, MpcStatus, checked_pose, last_control
from vssm_gym.planning.mpc.ranking import ranked
from vssm_gym.planning.mpc.selection import Selection, select, to_result
from vssm_gym.planning.mpc.symbols import bicycle_step, spline
from vssm_gym.planning.mpc.windows import ClearanceTable, ValueTable
from vssm_gym.planning.value_iteration import CostToGo

# Of IPOPT itself: tolerances of a plan that is driven for one step, a warm start from the last multipliers, no output.
OPTIONS = {
    "tol": 1e-3,
    "constr_viol_tol": 1e-5,
    "acceptable_tol": 1e-2,
    "acceptable_iter": 3,
    "max_iter": 10,  # a count, not a time: runs repeat exactly, and a step stays within 100 ms on two cores
    "mu_init": 1e-2,
    "warm_start_init_point": "yes",
    "warm_start_bound_push": 1e-4,
    "warm_start_mult_bound_push": 1e-4,
    "print_level": 0,
    "sb": "yes",
}


@dataclass(frozen=True)
class IpoptConfig:
    """Configure where IPOPT starts, and the problem that it is given.

    Args:
        candidates: to find a start among.
        starts: the last plan and the best of the candidates, of which IPOPT gets one.
        mend: refinement of the starts: noise has moved the car.
        rounding: of ``min(s, J)``, share of ``s``.
        reach: distance from where the start ends to where the plan may end, m: half the window of the cost-to-go.
        share: of the deadline for IPOPT: the start takes time too, and its clock is read between iterations.
        proposals: of the candidates.
    """

    candidates: int = 88
    starts: int = 3
    mend: RefineConfig = field(default_factory=lambda: RefineConfig(outer=2, inner=10))
    rounding: float = 0.1
    reach: float = 0.6
    share: float = 0.5
    proposals: ProposalConfig = field(default_factory=ProposalConfig)


class Ipopt:
    """Solve with exact Hessians from one start, the last plan or a better one.

    ``SOLVED``: IPOPT converged; ``ACCEPTABLE``: it stopped early on a plan that keeps the margin, or its start does.
    """

    def __init__(self, problem: MpcProblem | None = None, config: IpoptConfig | None = None) -> None:
        self.problem, self.config = problem or MpcProblem(), config or IpoptConfig()
        _bicycle(self.problem)  # an error now rather than at the first step
        self._fields = FieldCache(self.problem.car)
        self._tables: tuple[Fields, ValueTable, ClearanceTable] | None = None
        self._solvers: dict[tuple[Any, ...], Any] = {}
        self._begin, self._end = jax.jit(self._start), jax.jit(self._select)

    def plan(
        self,
        state: np.ndarray,
        value: CostToGo,
        clearance: ClearanceMap,
        warm: MpcResult | None = None,
        control: np.ndarray | None = None,
    ) -> MpcResult:
        """See :meth:`~vssm_gym.planning.mpc.problem.MpcSolver.plan`. Building and compiling do not count as time."""
        problem, horizon = self.problem, self.problem.config.horizon
        pose, last = checked_pose(state), last_control(problem, warm, control)
        fields = self._fields.of(value, clearance)
        if self._tables is None or self._tables[0] is not fields:
            reach = horizon * problem.car.dt * problem.car.max_speed + problem.car.length
            self._tables = fields, ValueTable(fields.value, self.config.reach), ClearanceTable(clearance, reach)
        values, clearances = self._tables[1:]
        step = 0 if warm is None else warm.step + 1
        plan = np.zeros((horizon, 2)) if warm is None else warm.controls
        inputs = [jnp.asarray(a, jnp.float32) for a in (pose, last, plan)]
        solver = self._prepared(fields, values, clearances, inputs)

        began = time.perf_counter()
        start, states, is_warm, least = jax.device_get(self._begin(fields, *inputs, np.int32(step)))
        table, value_origin = values.window(states[-1, :2])
        distances, clearance_origin = clearances.window(pose[:2])
        units = [float(fields.discount), float(fields.step_cost)]
        lower, upper = _bounds(problem, value_origin + values.inner[0], value_origin + values.inner[1])
        fits = warm is not None and is_warm and len(warm.multipliers) == 2
        found = solver(
            x0=np.clip(np.concatenate([states, start], axis=1).ravel(), lower, upper),
            p=np.concatenate([pose, last, units, value_origin, clearance_origin, table, distances]),
            lbx=lower,
            ubx=upper,
            lbg=_least(problem, float(least)),
            ubg=_most(problem),
            **({"lam_x0": warm.multipliers[0], "lam_g0": warm.multipliers[1]} if fits and warm is not None else {}),
        )
        statistics = solver.stats()
        answer = np.asarray(found["x"]).reshape(horizon, 5)[:, 3:]
        answer = answer if np.isfinite(answer).all() else start
        both = jnp.asarray(np.stack([answer, start]), jnp.float32)
        selection = jax.device_get(self._end(fields, inputs[0], inputs[1], both))
        seconds = time.perf_counter() - began

        own = int(selection.chosen) == 0
        kept = tuple(_a_step_later(found[name], horizon) for name in ("lam_x", "lam_g")) if own else ()
        converged = own and bool(statistics["success"])
        result = to_result(problem, selection, converged, seconds, int(statistics["iter_count"]), step, kept)
        if result.status is MpcStatus.INFEASIBLE and statistics["return_status"] == "Maximum_WallTime_Exceeded":
            return replace(result, status=MpcStatus.LATE)  # nothing is known of what more time would have found
        return result

    def _start(self, fields: Fields, state: Array, last: Array, plan: Array, step: Array) -> tuple[Array, ...]:
        """Return IPOPT's start: controls, poses ``z_1 .. z_T``, True for the last plan, and the least clearance."""
        problem, config = self.problem, self.config
        key = jax.random.fold_in(jax.random.key(problem.config.seed), step)
        candidates = propose(problem, config.proposals, key, last, plan, config.candidates)
        best, _ = ranked(problem, fields, state, last, candidates, config.starts - 1)
        starts = jnp.concatenate([candidates[:1], best])
        least = required_clearance(problem, fields, state)
        mended = refine(problem, config.mend, fields, state, last, least, starts)
        selection = select(problem, fields, state, last, jnp.concatenate([mended, starts]), config.starts)
        is_warm = selection.chosen % config.starts == 0
        return selection.controls, rollout(problem, state, selection.controls), is_warm, least

    def _select(self, fields: Fields, state: Array, last: Array, plans: Array) -> Selection:
        return select(self.problem, fields, state, last, within_rates(self.problem, last, plans), 1)

    def _prepared(self, fields: Fields, values: ValueTable, clearances: ClearanceTable, inputs: list[Array]) -> Any:
        """Return the solver for tables of these sizes; build and compile what is seen for the first time."""
        key = (fields.shapes, values.resolution, clearances.resolution)
        if key not in self._solvers:
            self._solvers[key] = build(self.problem, values, clearances, self.config)
            plan = self._begin(fields, *inputs, np.int32(0))[0]
            jax.block_until_ready(self._end(fields, *inputs[:2], jnp.stack([plan, plan])))
        return self._solvers[key]


def build(problem: MpcProblem, values: ValueTable, clearances: ClearanceTable, ipopt: IpoptConfig) -> Any:
    """Build the NLP as a CasADi function of ``x`` (z_1, u_0, z_2, u_1, ...) and ``p`` of :meth:`Ipopt.plan`."""
    import casadi as ca

    config, car, horizon = problem.config, problem.car, problem.config.horizon
    x = ca.MX.sym("x", 5, horizon)
    sizes = (3, 2, 1, 1, 2, 2, values.cells**2 * (values.headings + 3), clearances.cells**2)
    p = ca.MX.sym("p", sum(sizes))
    pose, last, discount, step_cost, value_origin, clearance_origin, table, distances = ca.vertsplit(
        p, np.concatenate([[0], np.cumsum(sizes)]).tolist()
    )
    z, u = x[:3, :], x[3:, :]
    before = ca.horzcat(pose, z[:, :-1])
    change = u - ca.horzcat(last, u[:, :-1])

    gaps = z - bicycle_step(ca, before, u, car.dt, float(_bicycle(problem).wheelbase))

    centres, radius = problem.discs
    heading_x, heading_y = ca.cos(z[2, :]), ca.sin(z[2, :])
    px = ca.horzcat(*[z[0, :] + a * heading_x - b * heading_y for a, b in centres])
    py = ca.horzcat(*[z[1, :] + a * heading_y + b * heading_x for a, b in centres])
    flat = spline(
        ca,
        distances,
        (clearances.cells, clearances.cells),
        [(px - clearance_origin[0]) / clearances.resolution, (py - clearance_origin[1]) / clearances.resolution],
    )
    clearance = ca.reshape(flat, horizon, len(centres)).T - radius

    turns = z[2, :] * (values.headings / (2.0 * math.pi))
    turns -= values.headings * ca.floor(turns / values.headings)
    value = spline(
        ca,
        table,
        (values.cells, values.cells, values.headings + 3),
        [
            (z[0, :] - value_origin[0]) / values.resolution,
            (z[1, :] - value_origin[1]) / values.resolution,
            turns + 1.0,
        ],
    )
    width = ipopt.rounding * step_cost
    stage = step_cost - width * ca.log1p(ca.exp((step_cost - value) / width))
    limits = ca.DM(car.limits)
    extra = (
        config.haste * value
        + config.effort * (u[0, :] / car.max_speed) ** 2
        + config.smoothness * ca.sum1((change / ca.repmat(limits, 1, horizon)) ** 2)
        + config.proximity * ca.sum1(ca.fmax(0.0, 1.0 - clearance / config.comfort) ** 2) / len(centres)
    )
    weights = discount ** ca.DM(np.arange(horizon)).T
    cost = ca.sum2(weights * (stage + step_cost * extra)) + discount**horizon * value[-1]
    options: dict[str, Any] = dict(OPTIONS)
    if math.isfinite(config.deadline):
        options["max_wall_time"] = ipopt.share * config.deadline
    program: Any = {"x": ca.vec(x), "p": p, "f": cost, "g": ca.vec(ca.vertcat(gaps, change, clearance))}
    settings: Any = {"ipopt": options, "print_time": False, "calc_lam_p": False, "error_on_fail": False}
    return ca.nlpsol("car", "ipopt", program, settings)


def _bicycle(problem: MpcProblem) -> Bicycle:
    """Return the problem's transition, the only law that is written in CasADi here; an error for another one."""
    if not isinstance(problem.motion, Bicycle):
        raise InputError("Ipopt", "problem.transition", f"a Bicycle; found {type(problem.motion).__name__}")
    return problem.motion


def _bounds(problem: MpcProblem, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return bounds of ``x``: controls within the limits; the last pose within the window of the cost-to-go."""
    upper = np.full((problem.config.horizon, 5), np.inf)
    upper[:, 3:] = problem.car.limits
    lower = -upper
    lower[-1, :2], upper[-1, :2] = low, high
    return lower.ravel(), upper.ravel()


def _least(problem: MpcProblem, clearance: float) -> np.ndarray:
    """Return lower bounds of gaps, changes and clearances, step by step."""
    one = np.concatenate([np.zeros(3), -problem.rates, np.full(len(problem.discs[0]), clearance)])
    return np.tile(one, problem.config.horizon)


def _most(problem: MpcProblem) -> np.ndarray:
    """Return upper bounds of the same."""
    one = np.concatenate([np.zeros(3), problem.rates, np.full(len(problem.discs[0]), np.inf)])
    return np.tile(one, problem.config.horizon)


def _a_step_later(multipliers: Any, horizon: int) -> np.ndarray:
    """Shift multipliers by a step, as :func:`~vssm_gym.planning.mpc.objective.shifted` shifts the plan."""
    steps = np.asarray(multipliers).reshape(horizon, -1)
    return np.concatenate([steps[1:], steps[-1:]]).ravel()
