"""Measure the robot car's planners, controllers and simulators: ``bench car``.

Value iteration and hybrid A* plan on the scene's own floor plan, so that no learned map enters the figures. Controllers
are timed in closed loop on a kinematic bicycle with small errors, from target to target of the scene's frozen chain.
"""

import importlib.util
import itertools
import os
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import shapely

import vssm_gym  # noqa: F401  (registers the environments)
from vssm_gym.agents.car.vi_mpc import PROBLEM
from vssm_gym.agents.shared.car.critic import Critic
from vssm_gym.envs.physics import obstacles
from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.scenes.solids import footprint
from vssm_gym.envs.tasks.car import CarTask
from vssm_gym.envs.tasks.car_sets import make_car_tasks
from vssm_gym.errors import InputError
from vssm_gym.eval.bench.envs import steps_a_second
from vssm_gym.eval.bench.speed import CompileCounter
from vssm_gym.geometry.arc import poses_after, turn_of
from vssm_gym.geometry.car import Car
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.planning.car.footprint import ARENA_CELL, Arena
from vssm_gym.planning.car.footprint_levels import FootprintLevels
from vssm_gym.planning.car.hybrid_astar import plan
from vssm_gym.planning.mpc import safety
from vssm_gym.planning.mpc.ipopt import Ipopt
from vssm_gym.planning.mpc.mppi import Mppi
from vssm_gym.planning.mpc.problem import MpcSolver
from vssm_gym.planning.mpc.random_search import RandomSearch
from vssm_gym.planning.value_iteration import CostToGo, PoseGrid, solve
from vssm_gym.progress import OnProgress

SCENE = "arena"
ARENA_MARGIN = (0.2, 0.14)  # m beyond the floor along x, y: the car's arenas, 5.2 x 4.2 m, make 160 x 128 cells
SEALED, THICK = 1.0, 0.05  # m: edge of the corner that is sealed off, and thickness of its fences
GOALS = 5  # of value iteration
WARM_START_SHIFT = 0.05  # m that a goal moves before a warm start
CONTROLLED_TARGETS = 40  # of controllers and hybrid A*
TARGET_STEPS = 600  # steps a target, one minute
SPEED_ERROR, STEERING_ERROR = 0.03, np.radians(0.5)  # standard deviations of a step: relative, rad
AIM_VALUE, AIM_CONTROL = 2.0, 100.0  # the project's own aims: s, and ms (one control period)
SOLVERS: tuple[type[MpcSolver], ...] = (RandomSearch, Ipopt, Mppi)

Row = dict[str, Any]


def measure(*, scene: str = SCENE, steps: int, seed: int, on_progress: OnProgress | None = None) -> dict[str, Any]:
    """Measure the times of all parts of the car's agents.

    Args:
        scene: an arena.
        steps: of closed loop for each controller.
        seed: of the bicycle's errors and of the environments.
        on_progress: called with ("measuring", parts done, total).

    Returns:
        ``rows`` with ``what, p50, p95`` (None for rates), ``unit, aim`` (of p95; of p50 where there is no p95), and
        ``facts`` by name (CPU time counts all threads, so it does not depend on other load); the machine and its load
        before; ``missing``: why a simulator was not measured, or None.

    Raises:
        InputError: an unknown scene, or one without room for a car.
    """
    apartment, car = load_scene(scene), PROBLEM.car
    tasks = make_car_tasks(apartment, CONTROLLED_TARGETS).tasks
    machine = {"cores": os.cpu_count(), "processor": platform.machine(), "load": round(os.getloadavg()[0], 1)}
    solid, low, high = floor_plan(apartment, car)
    arena = rasterised(solid, low, high)
    bullet = importlib.util.find_spec("pybullet") is not None
    simulators = ("mujoco", "bullet") if bullet else ("mujoco",)
    parts: list[Callable[[], list[Row]]] = [
        lambda: value_rows(sealed_off(solid, low, high), high - SEALED, tasks, car),
        *(lambda make=make: [control_row(make(PROBLEM), arena, solid, tasks, steps, seed)] for make in SOLVERS),
        lambda: [search_row(arena, tasks, car)],
        *(lambda physics=physics: rate_rows(scene, physics, seed) for physics in simulators),
    ]
    rows: list[Row] = []
    for i, part in enumerate(parts):
        rows += part()
        if on_progress:
            on_progress("measuring", i + 1, len(parts))
    missing = None if bullet else "PyBullet is not installed: pip install -c constraints.txt '.[bullet]'"
    return {"scene": scene, "steps": steps, "rows": rows, "missing": missing, "machine": machine}


def floor_plan(apartment: Apartment, car: Car) -> tuple[shapely.Geometry, np.ndarray, np.ndarray]:
    """Return the obstacles of a body of the car's height, and the floor's lowest and highest corner, m."""
    boxes = apartment.boxes()
    solid = shapely.union_all([footprint(boxes[i]) for i in obstacles(boxes, car.height)])
    corners = np.concatenate([np.array(room.polygon) for room in apartment.rooms])
    return solid, corners.min(axis=0), corners.max(axis=0)


def sealed_off(solid: shapely.Geometry, low: np.ndarray, high: np.ndarray) -> Arena:
    """Return the arena with a fence around its last corner."""
    x, y = high - SEALED
    fences = shapely.box(x, y, high[0], y + THICK), shapely.box(x, y, x + THICK, high[1])
    return rasterised(shapely.union_all([solid, *fences]), low, high)


def rasterised(solid: shapely.Geometry, low: np.ndarray, high: np.ndarray) -> Arena:
    """Rasterise ``solid``: cells that it overlaps are occupied."""
    shapely.prepare(solid)
    nx, ny = np.round((high - low + 2.0 * np.array(ARENA_MARGIN)) / ARENA_CELL).astype(int)
    origin = low - ARENA_MARGIN + 0.5 * ARENA_CELL
    x, y = np.meshgrid(origin[0] + ARENA_CELL * np.arange(nx), origin[1] + ARENA_CELL * np.arange(ny), indexing="ij")
    half = 0.5 * ARENA_CELL
    cells = shapely.box(x - half, y - half, x + half, y + half)
    return Arena.from_occupied(shapely.intersects(solid, cells), origin, ARENA_CELL)


def value_rows(arena: Arena, sealed: np.ndarray, tasks: Sequence[CarTask], car: Car) -> list[Row]:
    """Time value iteration from the floor plan to the cost-to-go, and warm starts after the goal has moved."""
    goals = [np.array(task.goal) for task in tasks if np.any(np.array(task.goal[:2]) < sealed - 0.1)][:GOALS]
    solve(PoseGrid.of(arena, car), goals[0])  # compiles
    cold, cpu, warm, results, again = [], [], [], [], []
    for goal in goals:
        began, worked = time.perf_counter(), time.process_time()
        grid = PoseGrid.of(arena, car)
        result = solve(grid, goal)
        cold.append(time.perf_counter() - began)
        cpu.append(time.process_time() - worked)
        results.append(result)
        moved = solve(grid, goal + np.array([WARM_START_SHIFT, 0.0, 0.0]), warm=result.cost_to_go)
        if moved.cost_to_go is not None:  # the moved goal may be occupied
            warm.append(moved.seconds)
            again.append(moved)
    size = "x".join(str(n) for n in grid.blocked.shape)
    motions = len(grid.motions.controls)
    facts = {
        "CPU s": float(np.median(cpu)),
        "sweeps": max(result.sweeps for result in results),
        "residual": max(result.residual for result in results),
        "unreachable": max(result.unreachable for result in results),
        "free": results[0].free,
    }
    rows = [_row(f"value iteration {size}, {motions} motions, a room sealed off", cold, "s", AIM_VALUE, facts)]
    if again:
        facts = {"sweeps": max(result.sweeps for result in again)}
        rows.append(_row(f"the same, warm, goal moved by {100 * WARM_START_SHIFT:g} cm", warm, "s", None, facts))
    return rows


def control_row(
    solver: MpcSolver,
    arena: Arena,
    solid: shapely.Geometry,
    tasks: Sequence[CarTask],
    steps: int,
    seed: int,
) -> Row:
    """Time plan and safe command, as the agents call them, over ``steps`` of a bicycle with small errors."""
    car, rng, critic = PROBLEM.car, np.random.default_rng(seed), Critic(arena, PROBLEM.car)
    planar, waiting = np.array(tasks[0].start), itertools.cycle(tasks)
    task, value = _next(waiting, critic, planar)
    # Once, uncounted, because it compiles: with a plan and without one.
    result = solver.plan(planar, value, arena.clearance)
    safety.step(PROBLEM, safety.init(np.zeros(2)), result.within_deadline(0.0), planar, arena.clearance)
    memory, counter = safety.init(np.zeros(2)), CompileCounter()
    seconds: list[float] = []
    cpu: list[float] = []
    reached, collisions, collided, spent = 0, 0, False, 0
    while len(seconds) < steps:
        began, worked = time.perf_counter(), time.process_time()
        result = solver.plan(planar, value, arena.clearance, memory.resume, memory.control)
        memory, action = safety.step(PROBLEM, memory, result, planar, arena.clearance)
        seconds.append(time.perf_counter() - began)
        cpu.append(time.process_time() - worked)
        planar, spent = _driven(planar, action.control, rng, car), spent + 1
        collided = collided or bool(shapely.Polygon(car.corners(planar)).intersects(solid))
        if task.reached(planar) or spent == TARGET_STEPS:
            reached, collisions = reached + task.reached(planar), collisions + collided
            task, value = _next(waiting, critic, planar)
            memory, collided, spent = safety.init(np.zeros(2)), False, 0
    milliseconds = [1e3 * s for s in seconds]
    facts = {
        "CPU ms": 1e3 * float(np.median(cpu)),
        "CPU ms 95 %": 1e3 * float(np.percentile(cpu, 95)),
        "over 100 ms": f"{np.mean(np.array(milliseconds) > AIM_CONTROL):.1%}",
        "recompilations": counter.count,
        "targets": reached,
        "collided": collisions + collided,
    }
    name = type(solver).__name__
    return _row(f"MPC {name}, horizon {PROBLEM.config.horizon}", milliseconds, "ms", AIM_CONTROL, facts)


def search_row(arena: Arena, tasks: Sequence[CarTask], car: Car) -> Row:
    """Time plans of hybrid A* along the chain."""
    levels = FootprintLevels.from_occupied(arena.occupied, arena.origin, arena.resolution, car)
    ends = [(np.array(task.start), np.array(task.goal)) for task in tasks]
    plan(*ends[0], levels, car)  # compiles
    plans = [plan(start, goal, levels, car) for start, goal in ends]
    facts = {"plans": len(plans), "found": sum(found.found for found in plans)}
    return _row("hybrid A*, from pose to pose", [1e3 * found.seconds for found in plans], "ms", None, facts)


def rate_rows(scene: str, physics: str, seed: int) -> list[Row]:
    """Measure steps a second of the environment, with and without images, under random commands."""
    rows = []
    for images in (False, True):
        env = gym.make("vssm_gym/CarNav-v1", scene=scene, physics=physics, images=images, end_on="reach")
        env.reset(seed=seed)
        low, high = env.action_space.low, env.action_space.high  # type: ignore[attr-defined]
        rng = np.random.default_rng(seed)

        def step(env: gym.Env = env, low: Any = low, high: Any = high, rng: np.random.Generator = rng) -> int:
            _, _, terminated, truncated, _ = env.step(rng.uniform(low, high))
            if terminated or truncated:
                env.reset()
            return 1

        what = f"CarNav in {physics}, {'RGB-D 160x120' if images else 'no images'}"
        rows.append(
            {"what": what, "p50": steps_a_second(step), "p95": None, "unit": "steps/s", "aim": None, "facts": {}}
        )
        env.close()
    return rows


def _next(waiting: Iterator[CarTask], critic: Critic, planar: np.ndarray) -> tuple[CarTask, CostToGo]:
    """Return the next target that can be reached, and its cost-to-go."""
    for task in itertools.islice(waiting, CONTROLLED_TARGETS):
        value = critic.aim(planar, np.array(task.goal)).cost_to_go
        if value is not None:
            return task, value
    raise InputError(
        task.scene,
        "rooms",
        f"room for the car; none of {CONTROLLED_TARGETS} targets can be reached at {ARENA_CELL} m a cell",
    )


def _driven(planar: np.ndarray, control: np.ndarray, rng: np.random.Generator, car: Car) -> np.ndarray:
    """Execute a command with small errors; return the pose at the end of its arc."""
    errors = rng.normal(size=2) * (SPEED_ERROR * abs(control[0]), STEERING_ERROR)
    speed, steering = control + errors
    x, y, heading = planar
    after = poses_after(heading, speed * car.dt, turn_of(speed * car.dt, steering, car.wheelbase), x, y)
    return np.array([*after[:2], wrap_angle(after[2])])


def _row(what: str, values: Sequence[float], unit: str, aim: float | None, facts: dict[str, Any]) -> Row:
    p50, p95 = (float(np.percentile(values, q)) for q in (50, 95))
    return {"what": what, "p50": p50, "p95": p95, "unit": unit, "aim": aim, "facts": facts}
