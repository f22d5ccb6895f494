"""Compute shortest-path distances to goals through the belief's free space: one field a goal, looked up every step.

``d(n)`` is the shortest path from node n to the goal over edges to 16 neighbours on a grid of free positions, as the
real environment's dense reward has it (:mod:`vssm_gym.envs.tasks.goal_progress`): at most 3 % longer than the true
distance along straight corridors. Between nodes it is bilinear; within a node's spacing of the goal it is the straight
distance.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from vssm_gym.envs.tasks.goal_progress import GRID_SPACING
from vssm_gym.envs.world_model.collision_map import CollisionMap, mean_clearance
from vssm_gym.geometry.grid_graph import edges, graph

UNREACHABLE = 1e6  # m: the distance of nodes from which no path leads to the goal
REACHABLE_DISTANCE = 1e3  # m: an interpolated distance above this is next to an unreachable node, and unknown
_RINGS = 3  # rings of blocked nodes next to free ones get a distance, so that a robot at a wall has one


class GoalDistances(eqx.Module):
    """Hold the distance fields of goals; see the module."""

    distance: Float[Array, "nodes"]  # (goals, nx, ny) in C order, m
    goals: Float[Array, "goals 2"]  # world, m
    origin: Float[Array, "2"]  # m
    shape: tuple[int, int] = eqx.field(static=True)

    def at(self, goal: Int[Array, "*batch"], x: Array, y: Array) -> Float[Array, "*batch"]:
        """Return the path length (m) from world points to goal ``goal``; above REACHABLE_DISTANCE where unknown."""
        nx, ny = self.shape
        straight = jnp.hypot(x - self.goals[goal, 0], y - self.goals[goal, 1])
        u = jnp.clip((x - self.origin[0]) / GRID_SPACING, 0.0, nx - 1.0)
        v = jnp.clip((y - self.origin[1]) / GRID_SPACING, 0.0, ny - 1.0)
        i, j = jnp.minimum(u.astype(jnp.int32), nx - 2), jnp.minimum(v.astype(jnp.int32), ny - 2)
        a, b = u - i, v - j
        low = (goal * nx + i) * ny + j
        d00, d01, d10, d11 = (
            self.distance.at[low + offset].get(mode="promise_in_bounds") for offset in (0, 1, ny, ny + 1)
        )
        left, right = d00 + b * (d01 - d00), d10 + b * (d11 - d10)
        return jnp.where(straight <= GRID_SPACING, straight, left + a * (right - left))


class Lattice:
    """Connect the free nodes of a belief for a disc of ``radius`` m in a graph (NumPy, at construction)."""

    def __init__(self, collision_map: CollisionMap, radius: float) -> None:
        self.origin = np.asarray(collision_map.origin, np.float64)
        extent = (np.array(collision_map.shape) - 1) * collision_map.resolution
        self.shape = tuple(int(n) for n in np.floor(extent / GRID_SPACING).astype(int) + 1)
        axes = [o + GRID_SPACING * np.arange(n) for o, n in zip(self.origin, self.shape, strict=True)]
        self.nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        self._collision_map, self._radius = collision_map, radius
        self.free = self.clearance(self.nodes) >= radius
        self._graph = self._edges()
        _, self.part = connected_components(self._graph, directed=False)

    def clearance(self, xy: np.ndarray) -> np.ndarray:
        """Return the clearance of world points ``(..., 2)`` in the mean map, m."""
        x, y = (jnp.asarray(xy[..., axis], jnp.float32) for axis in (0, 1))
        return np.asarray(mean_clearance(self._collision_map, x, y))

    def known(self, xy: np.ndarray) -> np.ndarray:
        """Return True where the columns at world points ``(..., 2)`` were observed."""
        return np.asarray(self._collision_map.known_at(jnp.asarray(xy[..., 0]), jnp.asarray(xy[..., 1])))

    def nearest(self, xy: np.ndarray) -> np.ndarray:
        """Return the number of the free node nearest to each of ``xy (n, 2)``."""
        free = np.flatnonzero(self.free)
        away = np.linalg.norm(self.nodes[free][None] - xy[:, None], axis=-1)
        return free[np.argmin(away, axis=1)]

    def goal_distances(self, goals: np.ndarray) -> GoalDistances:
        """Compute the distance fields of ``goals (n, 2)``, m."""
        at = self.nearest(goals)
        away = np.linalg.norm(self.nodes[at] - goals, axis=-1)
        distance = dijkstra(self._graph, directed=False, indices=at) + away[:, None]
        distance[:, ~self.free] = np.inf
        filled = _filled(distance.reshape(-1, *self.shape))
        flat = np.where(np.isfinite(filled), filled, UNREACHABLE).reshape(-1)
        field, at_goals, origin = (jnp.asarray(a, jnp.float32) for a in (flat, goals, self.origin))
        return GoalDistances(field, at_goals, origin, (self.shape[0], self.shape[1]))

    def _edges(self) -> csr_array:
        begin, end, length = edges(self.free.reshape(self.shape))
        along = np.linspace(0.0, 1.0, 5)[1:-1, None, None]
        between = (1.0 - along) * self.nodes[begin] + along * self.nodes[end]
        passable = (self.clearance(between) >= 0.95 * self._radius).all(axis=0)
        return graph(self.free.size, begin[passable], end[passable], GRID_SPACING * length[passable])


def _filled(distance: np.ndarray) -> np.ndarray:
    """Extend ``distance (goals, nx, ny)`` into blocked nodes: ``d(n) = min over neighbours m of |n - m| + d(m)``."""
    for _ in range(_RINGS):
        padded = np.pad(distance, ((0, 0), (1, 1), (1, 1)), constant_values=np.inf)
        nx, ny = distance.shape[1:]
        around = [
            padded[:, 1 + dx : 1 + dx + nx, 1 + dy : 1 + dy + ny] + GRID_SPACING * np.hypot(dx, dy)
            for dx in (-1, 0, 1)
            for dy in (-1, 0, 1)
            if dx or dy
        ]
        distance = np.where(np.isfinite(distance), distance, np.min(around, axis=0))
    return distance
