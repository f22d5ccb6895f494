"""Choose a safe command with or without a plan: ``step(memory, result, pose, clearance) -> (memory, action)``.

    usable plan                 its first command                                             PLANNED
    late, infeasible            what is left of the last usable plan, if it is still free     CONTINUED
                                otherwise as little motion as the rates allow                 BRAKED, HELD
    inside an obstacle          the path it came, backwards, if that leads no deeper           BACKED_OFF
                                otherwise the solver's path out of it, if it leads no deeper  ESCAPED
                                otherwise as little motion as the rates allow                 BRAKED, HELD

Free means: from the pose where the car is now, with a standstill at the end, at least the clearance that a plan needs.
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.mpc.objective import rollout, within_rates
from vssm_gym.planning.mpc.problem import MpcProblem, MpcResult, MpcStatus, checked_pose
from vssm_gym.planning.result import Outcome

UNDO_STEPS = 50  # executed commands that can be undone: 5 s
STANDING = 1e-3  # m/s
ALTERNATIVES = 4  # control sequences that a step without a plan compares


class SafeKind(Outcome):
    """Name why a command was chosen; the value is the message that reports print."""

    PLANNED = "drives the new plan"
    CONTINUED = "continues the last plan, which is still free"
    BACKED_OFF = "backs off along the path it came"
    ESCAPED = "leaves the obstacle on the solver's path"
    BRAKED = "brakes: no motion is known to be free"
    HELD = "stands: no motion is known to be free"


@dataclass(frozen=True)
class SafeAction:
    """Hold a command that may be executed, and why it was chosen."""

    kind: SafeKind
    control: np.ndarray  # (2,) speed m/s, steering rad; within limits and rates


@dataclass(frozen=True)
class SafeMemory:
    """Hold what the next step needs of those before it."""

    control: np.ndarray  # (2,) executed last
    plan: np.ndarray  # (n, 2) what is left of the last usable plan
    came: np.ndarray  # (n, 2) executed commands, the newest last, without those that were undone
    resume: MpcResult | None = None  # the last result, for the solver's warm start; None after a break


def init(control: np.ndarray) -> SafeMemory:
    """Return the memory of a car without a plan that executes ``(speed m/s, steering rad)``, zeros if it stands."""
    return SafeMemory(control, np.zeros((0, 2)), np.zeros((0, 2)))


def prepare(problem: MpcProblem) -> None:
    """Compile what :func:`step` needs where there is no plan: an emergency must not wait for the compiler."""
    drives = jnp.zeros((ALTERNATIVES, problem.config.horizon, 2))
    jax.block_until_ready(_drive(problem, jnp.zeros(3), jnp.zeros(2), drives))


def step(
    problem: MpcProblem, memory: SafeMemory, result: MpcResult, state: np.ndarray, clearance: ClearanceMap
) -> tuple[SafeMemory, SafeAction]:
    """Return the command of this step.

    Args:
        problem: What the plan was made for.
        memory: From the step before, or :func:`init`.
        result: The solver's answer for this step, from ``memory.resume`` and ``memory.control``.
        state: ``(3,)`` pose from which the command will be executed.
        clearance: Of the floor plan.
    """
    plan, came = memory.plan[1:], memory.came
    if result.usable:
        plan, kind = result.controls, SafeKind.PLANNED
        control = result.controls[0]
    else:
        kind, control = _without_plan(problem, memory, result, checked_pose(state), clearance)
    if kind is SafeKind.BACKED_OFF:
        came = came[:-1]
    elif abs(control[0]) > STANDING:
        came = np.concatenate([came, control[None]])[-UNDO_STEPS:]
    if kind not in (SafeKind.PLANNED, SafeKind.CONTINUED):
        plan = np.zeros((0, 2))
    # A plan that was not driven is no warm start, except that of a step whose plan came late and was continued.
    resume = result if kind in (SafeKind.PLANNED, SafeKind.CONTINUED) else None
    return SafeMemory(control, plan, came, resume), SafeAction(kind, control)


def _without_plan(
    problem: MpcProblem, memory: SafeMemory, result: MpcResult, state: np.ndarray, clearance: ClearanceMap
) -> tuple[SafeKind, np.ndarray]:
    """Return the first alternative that keeps the clearance of a plan, or a stop."""
    blocked = result.status is MpcStatus.BLOCKED
    alternatives = {
        SafeKind.CONTINUED: memory.plan[1:],
        SafeKind.BACKED_OFF: memory.came[::-1] * np.array([-1.0, 1.0]),
        SafeKind.ESCAPED: result.controls,
        SafeKind.BRAKED: np.zeros((0, 2)),
    }
    steering = memory.control[1]
    drives = np.stack([_to_a_standstill(plan, problem.config.horizon, steering) for plan in alternatives.values()])
    driven = _drive(problem, *(jnp.asarray(a, jnp.float32) for a in (state, memory.control, drives)))
    controls, states = (np.asarray(a, np.float64) for a in driven)
    nearest = _footprint_clearance(problem, states, clearance).min(axis=(1, 2))
    now = _footprint_clearance(problem, state, clearance).min()
    free = nearest >= min(now, problem.config.margin) - problem.config.tolerance
    for index, (kind, plan) in enumerate(alternatives.items()):
        fitting = kind is SafeKind.CONTINUED if not blocked else kind in (SafeKind.BACKED_OFF, SafeKind.ESCAPED)
        if fitting and len(plan) and free[index]:
            return kind, controls[index, 0]
    stop = controls[-1, 0]
    standing = abs(memory.control[0]) <= STANDING and abs(stop[0]) <= STANDING
    return (SafeKind.HELD if standing else SafeKind.BRAKED), stop


def _to_a_standstill(controls: np.ndarray, horizon: int, steering: float) -> np.ndarray:
    """Return the first of ``controls``, then as much of the horizon standing as there is: at least its last third."""
    drive = controls[: horizon - horizon // 3]
    steering = drive[-1, 1] if len(drive) else steering
    return np.concatenate([drive, np.tile([0.0, steering], (horizon - len(drive), 1))])


@partial(jax.jit, static_argnums=0)
def _drive(problem: MpcProblem, state: Array, last: Array, controls: Array) -> tuple[Array, Array]:
    """Return ``controls`` within limits and rates, and where they lead, ``(n, time, 2)`` and ``(n, time, 3)``."""
    controls = within_rates(problem, last, controls)
    return controls, rollout(problem, state, controls)


def _footprint_clearance(problem: MpcProblem, states: np.ndarray, clearance: ClearanceMap) -> np.ndarray:
    """Return the clearance of every disc, ``(*batch, discs)`` m, from the map itself, without a device."""
    centres, radius = problem.discs
    x, y = centres.T
    c, s = np.cos(states[..., 2:]), np.sin(states[..., 2:])
    points = np.stack([states[..., :1] + c * x - s * y, states[..., 1:2] + s * x + c * y], axis=-1)
    return clearance.at(points) - radius
