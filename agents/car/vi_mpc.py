"""Drive a car by value iteration as critic and model-predictive control as actor, on the learned map.

The cost-to-go of the target is computed once; every step of ``vi_mpc`` then solves a short-horizon problem with it as
terminal cost (thesis, section 5.6.1). The solver is random search refined by an augmented Lagrangian, as published. The
true pose is read, so the problem is a Markov decision process. Described in ``docs/agents/car.md``.
"""

import numpy as np

from vssm_gym.agents.shared.car.critic import Critic
from vssm_gym.agents.shared.car.driver import CarCommand, Driver
from vssm_gym.agents.shared.localization import TruePose
from vssm_gym.geometry.car import Car
from vssm_gym.planning.car.footprint import Arena
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.mpc import safety
from vssm_gym.planning.mpc.problem import MpcConfig, MpcProblem, MpcSolver
from vssm_gym.planning.mpc.random_search import RandomSearch
from vssm_gym.planning.value_iteration import CostToGo

# No deadline: latencies are reported, and the simulation waits, so that runs repeat exactly. The margin covers the
# error of learned surfaces, up to 2 cm, and what the car strays from its plan in a second or two, about as much.
PROBLEM = MpcProblem(Car(), MpcConfig(margin=0.03, comfort=0.08, deadline=np.inf))


class SafeMpc:
    """Plan over a short horizon whose terminal cost is a cost-to-go; command what is safe where there is no plan."""

    def __init__(self, solver: MpcSolver) -> None:
        self._solver = solver
        self._memory = safety.init(np.zeros(2))
        safety.prepare(solver.problem)

    def begin(self, control: np.ndarray) -> None:
        """Forget the plan; the car executes ``control``."""
        self._memory = safety.init(control)

    def step(self, planar: np.ndarray, value: CostToGo, clearance: ClearanceMap) -> CarCommand:
        """Return the command of this step."""
        problem, memory = self._solver.problem, self._memory
        result = self._solver.plan(planar, value, clearance, memory.resume, memory.control)
        self._memory, action = safety.step(problem, memory, result, planar, clearance)
        status = action.kind.message if result.usable else f"{action.kind.message} ({result.status.message})"
        return CarCommand(action.control, status, result.states[:, :2])


class ValueMpc:
    """Control the car by a short-horizon solver whose terminal cost is the cost-to-go of the target."""

    def __init__(self, arena: Arena, car: Car, solver: MpcSolver) -> None:
        self._arena, self._critic, self._mpc = arena, Critic(arena, car), SafeMpc(solver)
        self._value: CostToGo

    def begin(self, planar: np.ndarray, goal: np.ndarray, control: np.ndarray) -> str | None:
        """Run value iteration to the target; return the reason where the car cannot get there."""
        self._mpc.begin(control)
        result = self._critic.aim(planar, goal)
        if result.cost_to_go is None:
            return result.status.message
        self._value = result.cost_to_go
        return None

    def step(self, planar: np.ndarray) -> CarCommand:
        """Plan over the horizon; return a safe command where there is no plan."""
        return self._mpc.step(planar, self._value, self._arena.clearance)


class ViMpcAgent:
    """Drive by value iteration and random search with an augmented Lagrangian; the pose is observed."""

    name = "vi_mpc"
    robot = "car"
    task = "pointgoal"
    needs_pose = True
    needs_map = True

    def __init__(self) -> None:
        solver = RandomSearch(PROBLEM)
        driver = Driver(TruePose(), lambda arena, car: ValueMpc(arena, car, solver))
        self.reset, self.act = driver.reset, driver.act
