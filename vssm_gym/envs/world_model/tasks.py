"""Draw a pool of tasks in the belief's free space by the rules of the real tasks.

Start and goal are free with a margin and observed, more than APART body lengths from each other, and connected by a
path of at least SHORTEST m (:mod:`vssm_gym.envs.tasks.navigation`, and :mod:`vssm_gym.envs.tasks.car` for the car).
Goals are few, because each has a distance field; every task has a start of its own.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vssm_gym.envs.tasks.navigation import BORDER_MARGIN
from vssm_gym.envs.world_model.config import SOURCE, Imagination
from vssm_gym.envs.world_model.goal_distance import REACHABLE_DISTANCE, GoalDistances, Lattice
from vssm_gym.errors import InputError

_POOLS_DRAWN = 64  # draws of a whole pool before giving up
GIVEN_SLACK = 0.1  # m by which a given start or goal may be too close to mapped walls: it was drawn among the true ones


class TaskPool(eqx.Module):
    """Hold the tasks that episodes are drawn from, one row a task."""

    start: Float[Array, "tasks 3"]  # x, y (m, world), heading (rad)
    goal: Int[Array, "tasks"]  # number of the goal
    geodesic: Float[Array, "tasks"]  # m from start to goal
    count: Int[Array, ""]  # tasks; rows beyond are padding, up to a power of two


class TaskLimits(NamedTuple):
    """Hold the rules that a robot's tasks obey, m."""

    radius: float  # of the disc that paths are planned for
    clearance: float  # of starts and goals, in addition to BORDER_MARGIN
    min_distance: float  # between start and goal
    success_radius: float  # around the goal
    min_path_length: float  # from the start to the success region


def draw_tasks(lattice: Lattice, limits: TaskLimits, config: Imagination) -> tuple[TaskPool, GoalDistances]:
    """Draw the pool; return it and its goals' distance fields.

    Raises :class:`InputError` where free space has no two places far enough apart, or a given task is not free.
    """
    if config.tasks is not None:
        return _given(lattice, limits, config.tasks)
    rng = np.random.default_rng(config.pool_seed)
    nodes = np.flatnonzero(lattice.free & lattice.known(lattice.nodes))
    parts = np.bincount(lattice.part[nodes]) if len(nodes) else np.zeros(1, int)
    nodes = nodes[lattice.part[nodes] == parts.argmax()]
    if len(nodes) == 0:
        raise InputError(SOURCE, "map", "free space for this robot; found none")
    goals = _positions(rng, lattice, nodes, limits, config.goals)
    distances = lattice.goal_distances(goals)
    starts, numbers, lengths, found = [], [], [], 0
    for _ in range(_POOLS_DRAWN):
        xy = _positions(rng, lattice, nodes, limits, config.pool)
        number = rng.integers(len(goals), size=len(xy))
        heading = rng.uniform(-np.pi, np.pi, len(xy))
        length = _lengths(distances, number, xy)
        apart = np.linalg.norm(xy - goals[number], axis=1) > limits.min_distance
        kept = apart & (length - limits.success_radius >= limits.min_path_length) & (length < REACHABLE_DISTANCE)
        starts.append(np.column_stack([xy, heading])[kept])
        numbers.append(number[kept])
        lengths.append(length[kept])
        found += int(kept.sum())
        if found >= config.pool:
            break
    else:
        raise InputError(SOURCE, "map", f"free space with places {limits.min_distance:g} m apart; found {found} tasks")
    start, number, length = (np.concatenate(a)[: config.pool] for a in (starts, numbers, lengths))
    return _pool(start, number, length), distances


def _positions(rng: np.random.Generator, lattice: Lattice, nodes: np.ndarray, limits: TaskLimits, n: int) -> np.ndarray:
    """Draw ``n`` positions uniformly in the cells around free nodes that are observed and free with a margin."""
    found = np.zeros((0, 2))
    for _ in range(_POOLS_DRAWN):
        xy = lattice.nodes[rng.choice(nodes, size=4 * n)] + rng.uniform(-0.05, 0.05, (4 * n, 2))
        xy = xy.round(4)  # 0.1 mm, as tasks are written to files
        found = np.concatenate(
            [found, xy[(lattice.clearance(xy) >= limits.clearance + BORDER_MARGIN) & lattice.known(xy)]]
        )
        if len(found) >= n:
            return found[:n]
    raise InputError(
        SOURCE, "map", f"positions with {limits.clearance + BORDER_MARGIN:.2f} m of clearance; found {len(found)}"
    )


def _given(lattice: Lattice, limits: TaskLimits, tasks: Any) -> tuple[TaskPool, GoalDistances]:
    """Check a ``TaskSet`` or a sequence of tasks against the belief."""
    listed = list(getattr(tasks, "tasks", tasks))
    if not listed:
        raise InputError(SOURCE, "tasks", "at least one task; found none")
    start = np.array([one.start for one in listed], np.float64)
    goals, number = np.unique(np.array([one.goal[:2] for one in listed], np.float64), axis=0, return_inverse=True)
    number = number.reshape(-1)
    distances = lattice.goal_distances(goals)
    length = _lengths(distances, number, start)
    for field, xy in (("start", start[:, :2]), ("goal", goals[number])):
        clearance = lattice.clearance(xy)
        if (worst := int(np.argmin(clearance))) >= 0 and clearance[worst] < limits.radius - GIVEN_SLACK:
            expected = f"a free position in this map; task {worst} has ({xy[worst][0]:.2f}, {xy[worst][1]:.2f})"
            raise InputError(SOURCE, f"tasks.{field}", expected)
    if (lost := np.flatnonzero(length >= REACHABLE_DISTANCE)).size:
        raise InputError(SOURCE, "tasks", f"goals that can be reached from the start in this map; not task {lost[0]}")
    return _pool(start, number, length), distances


def _lengths(distances: GoalDistances, number: np.ndarray, xy: np.ndarray) -> np.ndarray:
    x, y = (jnp.asarray(xy[:, axis], jnp.float32) for axis in (0, 1))
    return np.asarray(distances.at(jnp.asarray(number, jnp.int32), x, y), np.float64)


def _pool(start: np.ndarray, number: np.ndarray, length: np.ndarray) -> TaskPool:
    count = len(start)
    row = np.minimum(np.arange(1 << (count - 1).bit_length()), count - 1)
    start, number, length = start[row], number[row], length[row]
    return TaskPool(
        jnp.asarray(start, jnp.float32),
        jnp.asarray(number, jnp.int32),
        jnp.asarray(length, jnp.float32),
        jnp.asarray(count, jnp.int32),
    )
