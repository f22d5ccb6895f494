"""Tasks in the belief's free space: a pool of starts and goals, drawn once by the rules of the real tasks.

Start and goal are free with a margin and observed, more than APART body lengths from each other and connected by a way
of at least SHORTEST m (SPEC 6; :mod:`vssm_gym.envs.tasks.navigation`, and :mod:`vssm_gym.envs.tasks.car` for the car).
Goals are few, because each has a distance field; starts are as many as there are tasks.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vssm_gym.envs.tasks.navigation import MARGIN
from vssm_gym.envs.world_model.config import SOURCE, Imagination
from vssm_gym.envs.world_model.goal_distance import BEYOND, Lattice, Ways
from vssm_gym.errors import InputError

_ATTEMPTS = 64  # draws of a whole pool before giving up
GIVEN_SLACK = 0.1  # m that a given start or goal may lack of the footprint's clearance: real ones know the true walls


class Pool(eqx.Module):
    """What an episode is drawn from, one row a task."""

    start: Float[Array, "tasks 3"]  # x, y (m, world), heading (rad)
    goal: Int[Array, "tasks"]  # number of the goal
    geodesic: Float[Array, "tasks"]  # m from start to goal
    count: Int[Array, ""]  # tasks; rows beyond are padding, up to a power of two


class Fit(NamedTuple):
    """What of a robot decides its tasks, m."""

    radius: float  # of the disc that passes
    room: float  # clearance that starts and goals have, beside MARGIN
    apart: float  # more than this between start and goal
    success: float  # from the goal within which it is reached
    shortest: float  # way to there, at least


def draw_tasks(lattice: Lattice, fit: Fit, wanted: Imagination) -> tuple[Pool, Ways]:
    """The pool and its goals' distance fields.

    Raises :class:`InputError` where free space has no two places far enough apart, or a given task does not fit.
    """
    if wanted.tasks is not None:
        return _given(lattice, fit, wanted.tasks)
    rng = np.random.default_rng(wanted.pool_seed)
    nodes = np.flatnonzero(lattice.free & lattice.known(lattice.nodes))
    parts = np.bincount(lattice.part[nodes]) if len(nodes) else np.zeros(1, int)
    nodes = nodes[lattice.part[nodes] == parts.argmax()]
    if len(nodes) == 0:
        raise InputError(SOURCE, "map", "free space for this robot; found none")
    goals = _positions(rng, lattice, nodes, fit, wanted.goals)
    ways = lattice.ways(goals)
    starts, numbers, lengths, found = [], [], [], 0
    for _ in range(_ATTEMPTS):
        xy = _positions(rng, lattice, nodes, fit, wanted.pool)
        number = rng.integers(len(goals), size=len(xy))
        heading = rng.uniform(-np.pi, np.pi, len(xy))
        length = _lengths(ways, number, xy)
        apart = np.linalg.norm(xy - goals[number], axis=1) > fit.apart
        kept = apart & (length - fit.success >= fit.shortest) & (length < BEYOND)
        starts.append(np.column_stack([xy, heading])[kept])
        numbers.append(number[kept])
        lengths.append(length[kept])
        found += int(kept.sum())
        if found >= wanted.pool:
            break
    else:
        raise InputError(SOURCE, "map", f"free space with places {fit.apart:g} m apart; found {found} tasks")
    start, number, length = (np.concatenate(a)[: wanted.pool] for a in (starts, numbers, lengths))
    return _pool(start, number, length), ways


def _positions(rng: np.random.Generator, lattice: Lattice, nodes: np.ndarray, fit: Fit, n: int) -> np.ndarray:
    """``n`` positions uniform in the cells around free nodes, free with a margin and observed themselves."""
    found = np.zeros((0, 2))
    for _ in range(_ATTEMPTS):
        xy = lattice.nodes[rng.choice(nodes, size=4 * n)] + rng.uniform(-0.05, 0.05, (4 * n, 2))
        xy = xy.round(4)  # 0.1 mm, as tasks are written to files
        found = np.concatenate([found, xy[(lattice.clearance(xy) >= fit.room + MARGIN) & lattice.known(xy)]])
        if len(found) >= n:
            return found[:n]
    raise InputError(SOURCE, "map", f"positions with {fit.room + MARGIN:.2f} m of clearance; found {len(found)}")


def _given(lattice: Lattice, fit: Fit, tasks: Any) -> tuple[Pool, Ways]:
    """A ``TaskSet`` or a sequence of tasks, checked against the belief."""
    listed = list(getattr(tasks, "tasks", tasks))
    if not listed:
        raise InputError(SOURCE, "tasks", "at least one task; found none")
    start = np.array([one.start for one in listed], np.float64)
    goals, number = np.unique(np.array([one.goal[:2] for one in listed], np.float64), axis=0, return_inverse=True)
    number = number.reshape(-1)
    ways = lattice.ways(goals)
    length = _lengths(ways, number, start)
    for field, xy in (("start", start[:, :2]), ("goal", goals[number])):
        clearance = lattice.clearance(xy)
        if (worst := int(np.argmin(clearance))) >= 0 and clearance[worst] < fit.radius - GIVEN_SLACK:
            expected = f"a free position in this map; task {worst} has ({xy[worst][0]:.2f}, {xy[worst][1]:.2f})"
            raise InputError(SOURCE, f"tasks.{field}", expected)
    if (lost := np.flatnonzero(length >= BEYOND)).size:
        raise InputError(SOURCE, "tasks", f"goals that can be reached from the start in this map; not task {lost[0]}")
    return _pool(start, number, length), ways


def _lengths(ways: Ways, number: np.ndarray, xy: np.ndarray) -> np.ndarray:
    x, y = (jnp.asarray(xy[:, axis], jnp.float32) for axis in (0, 1))
    return np.asarray(ways.at(jnp.asarray(number, jnp.int32), x, y), np.float64)


def _pool(start: np.ndarray, number: np.ndarray, length: np.ndarray) -> Pool:
    count = len(start)
    row = np.minimum(np.arange(1 << (count - 1).bit_length()), count - 1)
    start, number, length = start[row], number[row], length[row]
    return Pool(
        jnp.asarray(start, jnp.float32),
        jnp.asarray(number, jnp.int32),
        jnp.asarray(length, jnp.float32),
        jnp.asarray(count, jnp.int32),
    )
