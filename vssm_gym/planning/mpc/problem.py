"""Define the car's control problem over a short horizon, and what its solvers return (thesis, section 5.6.1; eq. P23).

    min_u  sum_{t<T} gamma^t c(z_t, u_t) + gamma^T J(z_T)      z_{t+1} = mean of p(z' | z_t, u_t)
    s.t.   d(p_i(z_t)) - r >= m  for t = 1..T and every disc i of the footprint,
           |speed| and |steering| within the car's limits, and their changes within a rate

``J`` is the cost-to-go of value iteration, ``d`` the clearance of the floor plan, ``p_i`` the centres of the discs that
cover the footprint and ``r`` their radius. ``c`` is the step cost of value iteration until ``J`` is zero, and four
small terms: see :mod:`vssm_gym.planning.mpc.objective`. The transition is the car's bicycle unless another is given.
"""

import math
from dataclasses import dataclass, field, fields, replace
from typing import Protocol

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.geometry.car import Car
from vssm_gym.model.transition import Bicycle, Transition
from vssm_gym.model.transition.manifold import PLANAR
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.mpc.cover import cover
from vssm_gym.planning.result import Outcome
from vssm_gym.planning.value_iteration import CostToGo


@dataclass(frozen=True)
class MpcConfig:
    """Configure the constraints and the costs of the controller; costs are in step costs of the cost-to-go.

    Attributes:
        horizon: T, steps of the car's ``dt``.
        margin: m, the least distance between the footprint's discs and an obstacle, m.
        comfort: distance below which closeness is charged, m; above ``margin``, so that noise meets a slope first.
        discs: rows and columns of the discs that cover the footprint.
        speed_rate: largest change of speed, m/s^2.
        steering_rate: largest change of the steering angle, rad/s.
        effort: cost of a step at full speed, in addition to time; it makes the car stand still at the goal.
        smoothness: cost of changing speed or steering by its whole limit from one step to the next.
        proximity: cost of a step with one disc at clearance zero, falling to zero at ``comfort`` by a parabola.
        haste: cost of a step for each unit of the cost-to-go where it ends. Without it, two plans that end at one place
            short of the goal cost the same, and a car that can drive only a little way puts that off at every step.
        tolerance: violation of the clearance constraint that still counts as none, m.
        shortfall: cost of a metre of violation where candidates are ranked: large, yet finite, because the refinement
            repairs small violations.
        cheaper: by how much a start must be cheaper than the solver's answer to replace it: below it two plans are the
            same drive.
        deadline: seconds after which a plan is not used any more; infinite: none.
        seed: of everything random.
    """

    horizon: int = 25
    margin: float = 0.02
    comfort: float = 0.05
    discs: tuple[int, int] = (3, 6)
    speed_rate: float = 3.0
    steering_rate: float = 4.0
    effort: float = 0.02
    smoothness: float = 0.05
    proximity: float = 0.5
    haste: float = 0.0
    tolerance: float = 1e-3
    shortfall: float = 1e3
    cheaper: float = 0.02
    deadline: float = 0.1
    seed: int = 0

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.name == "discs":
                continue
            if not isinstance(value, int | float) or isinstance(value, bool) or math.isnan(value):
                raise InputError("MpcConfig", entry.name, f"a number; found {value!r:.80}")
        if not (len(self.discs) == 2 and all(isinstance(n, int) and n >= 1 for n in self.discs)):
            raise InputError("MpcConfig", "discs", f"rows and columns, whole numbers from 1; found {self.discs!r}")
        if not (isinstance(self.horizon, int) and self.horizon >= 2):
            raise InputError("MpcConfig", "horizon", f"a whole number, at least 2; found {self.horizon!r}")
        if not (isinstance(self.seed, int) and self.seed >= 0):
            raise InputError("MpcConfig", "seed", f"a whole number, at least 0; found {self.seed!r}")
        for name in ("speed_rate", "steering_rate", "tolerance", "deadline"):
            if not getattr(self, name) > 0.0:
                raise InputError("MpcConfig", name, f"a positive number; found {getattr(self, name)!r}")
        for name in ("margin", "effort", "smoothness", "proximity", "haste", "shortfall", "cheaper"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise InputError("MpcConfig", name, f"a finite number, at least 0; found {getattr(self, name)!r}")
        if not (math.isfinite(self.comfort) and self.comfort > self.margin):
            raise InputError("MpcConfig", "comfort", f"a length above margin = {self.margin!r}; found {self.comfort!r}")


@dataclass(frozen=True)
class MpcProblem:
    """Hold what is known before map, goal and pose: a car and a configuration. Hashable, so static in JAX.

    Attributes:
        car: footprint, limits of the two controls and length of a step.
        config: what the controller may do and what it is charged for.
        transition: of planar poses under those controls; None: the car's bicycle. Its fields are numbers.
    """

    car: Car = field(default_factory=Car)
    config: MpcConfig = field(default_factory=MpcConfig)
    transition: Transition | None = None

    def __post_init__(self) -> None:
        if self.motion.manifold != PLANAR:
            raise InputError("MpcProblem", "transition", f"one of planar poses; found {self.transition!r:.80}")
        try:
            hash(self.motion)
        except TypeError:
            expected = "a transition whose fields are numbers, not arrays: compiled code is kept for each"
            raise InputError("MpcProblem", "transition", expected) from None

    @property
    def motion(self) -> Transition:
        """Return the transition by which plans are rolled out."""
        return Bicycle(wheelbase=self.car.wheelbase) if self.transition is None else self.transition

    @property
    def discs(self) -> tuple[np.ndarray, float]:
        """Return the discs' centres in the body frame, ``(discs, 2)`` m, and the radius, m."""
        return cover(self.car, *self.config.discs)

    @property
    def rates(self) -> np.ndarray:
        """Return the largest change of ``(speed, steering)`` between two steps: m/s and rad; float64 ``(2,)``."""
        return self.car.dt * np.array([self.config.speed_rate, self.config.steering_rate])


class MpcStatus(Outcome):
    """Name the outcome of a solution; the value is the message that reports print."""

    SOLVED = "solved: every constraint holds, the solver converged"
    ACCEPTABLE = "acceptable: every constraint holds, the solver stopped before it converged"
    INFEASIBLE = "infeasible: no plan was found that keeps the margin"
    BLOCKED = "infeasible: the car is inside an obstacle of the map, or closer to it than the discs that cover it"
    LATE = "late: the answer came after the deadline"

    @property
    def usable(self) -> bool:
        """Return True where the first control may be executed."""
        return self in (MpcStatus.SOLVED, MpcStatus.ACCEPTABLE)


@dataclass(frozen=True)
class MpcResult:
    """Hold a plan, its outcome and its constraint violation.

    Attributes:
        status: how the solution ended; only a usable one may be driven.
        controls: ``(T, 2)`` float64 (speed m/s, steering rad), within limits and rates for every status.
        states: ``(T + 1, 3)`` float64 (x, y, heading) in the world frame, the present pose first, heading in [-pi, pi).
        cost: the objective at the plan, step costs.
        violation: largest shortfall of the clearance constraint over the plan, m; 0 where it holds.
        clearance_min: smallest distance of the footprint's discs to an obstacle over steps 1..T, m; negative: overlap.
        seconds: wall-clock time of the call, without compilation.
        iterations: of the solver's innermost loop.
        step: how many plans came before this one in the same chain of warm starts.
        multipliers: a solver's own data for its next warm start.
    """

    status: MpcStatus
    controls: np.ndarray
    states: np.ndarray
    cost: float
    violation: float
    clearance_min: float
    seconds: float
    iterations: int = 0
    step: int = 0
    multipliers: tuple[np.ndarray, ...] = ()

    @property
    def usable(self) -> bool:
        """Return True where the first control may be executed."""
        return self.status.usable

    def within_deadline(self, deadline: float) -> "MpcResult":
        """Return the result with the status :attr:`MpcStatus.LATE` where it took longer than ``deadline`` seconds."""
        return replace(self, status=MpcStatus.LATE) if self.seconds > deadline else self


class MpcSolver(Protocol):
    """Solve the problem: options are static, and everything that changes between two steps is an argument."""

    problem: MpcProblem

    def plan(
        self,
        state: np.ndarray,
        value: CostToGo,
        clearance: ClearanceMap,
        warm: MpcResult | None = None,
        control: np.ndarray | None = None,
    ) -> MpcResult:
        """Plan from a pose. The same arguments give the same plan, unless the deadline cuts it short.

        Args:
            state: ``(3,)`` x, y (m), heading (rad) of the rear axle in the world frame.
            value: Cost-to-go to the present goal.
            clearance: Of the floor plan, for a point.
            warm: The result of the step before, whose plan starts one step earlier; None after a break.
            control: ``(2,)`` the command executed last, from which the rates count; by default ``warm``'s first, or
                standing still with straight wheels.
        """
        ...


def last_control(problem: MpcProblem, warm: MpcResult | None, control: np.ndarray | None) -> np.ndarray:
    """Return the command from which the rates count, ``(2,)`` float64, within the limits."""
    if control is None:
        control = np.zeros(2) if warm is None else warm.controls[0]
    return problem.car.clip(control)


def checked_pose(state: np.ndarray) -> np.ndarray:
    """Return a pose as ``(3,)`` float64; raise :class:`InputError` where it is none."""
    state = np.asarray(state, dtype=np.float64)
    if state.shape != (3,) or not np.isfinite(state).all():
        raise InputError("plan", "state", f"three finite numbers (x, y, heading); found {state!r:.80}")
    return state
