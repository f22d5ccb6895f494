"""Test value iteration at its working size, in the built-in arena with a sealed room: sweeps, residual, policy cost."""

import numpy as np
import pytest
import shapely

from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.geometry.car import Car
from vssm_gym.planning.car.footprint import Arena
from vssm_gym.planning.value_iteration import CostToGo, Motions, PoseGrid, ValueConfig, solve

pytestmark = pytest.mark.slow

CAR = Car()
CELL = 0.035  # m
SHAPE = (160, 128)
RADIUS = 0.1  # m
LONGEST = 250  # motions of a rollout


@pytest.fixture(scope="module")
def arena() -> Arena:
    """Return the scene's boxes at the car's height as cells, and walls that enclose a corner."""
    solids = [shapely.box(4.2, 3.2, 5.2, 3.25), shapely.box(4.2, 3.2, 4.25, 4.2)]
    for box in load_scene("arena").boxes():
        if box.center[2] - 0.5 * box.size[2] < 0.2 and box.center[2] + 0.5 * box.size[2] > 0.03:
            half = 0.5 * np.array(box.size[:2])
            corners = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
            c, s = np.cos(box.yaw), np.sin(box.yaw)
            solids.append(shapely.Polygon(corners @ np.array([[c, s], [-s, c]]) + box.center[:2]))
    solid = shapely.union_all(solids)
    shapely.prepare(solid)
    origin = np.array([-0.2, -0.14]) + 0.5 * CELL
    x, y = (origin[a] + CELL * np.arange(SHAPE[a]) for a in (0, 1))
    x, y = np.meshgrid(x, y, indexing="ij")
    half = 0.5 * CELL
    return Arena.from_occupied(
        shapely.intersects(solid, shapely.box(x - half, y - half, x + half, y + half)), origin, CELL
    )


def finer(arena: Arena) -> Arena:
    """Return the same squares, each divided into four."""
    occupied = np.repeat(np.repeat(arena.occupied, 2, axis=0), 2, axis=1)
    return Arena.from_occupied(occupied, arena.origin - 0.25 * arena.resolution, 0.5 * arena.resolution)


def obstacles(arena: Arena) -> shapely.Geometry:
    """Return occupied squares and the area beyond the grid, shrunk by a micrometre, so that contact is allowed."""
    half = 0.5 * arena.resolution - 1e-6
    at = arena.origin + arena.resolution * np.argwhere(arena.occupied)
    low = arena.origin - 0.5 * arena.resolution
    grid = shapely.box(*low, *(low + arena.resolution * np.array(arena.occupied.shape)))
    solid = shapely.union_all([*shapely.box(*(at - half).T, *(at + half).T), grid.buffer(1.0) - grid])
    shapely.prepare(solid)
    return solid


def policy_cost(cost: CostToGo, motions: Motions, planar: np.ndarray, goal: np.ndarray, solid) -> np.ndarray:
    """Return discounted motions of the greedy policy in the continuous world: the free motion with the best value.

    Arcs of a circle from where the car is, collisions by polygons; ``1 / (1 - gamma)`` for those that do not arrive.
    The last motion is never undone: no optimal drive does that, and one that interpolated values send to and fro would.
    """
    planar, total, active = planar.copy(), np.zeros(len(planar)), np.ones(len(planar), bool)
    last = np.full(len(planar), -1)
    share = np.linspace(0.0, 1.0, 9)[1:]
    curvature = np.tan(motions.controls[:, 1]) / CAR.wheelbase
    ahead = np.sign(motions.controls[:, 0]) * motions.length
    angle = (ahead * curvature)[:, None] * share
    chord = ahead[:, None] * share * np.sinc(0.5 * angle / np.pi)
    same, opposite = np.isclose(curvature[:, None], curvature), (ahead[:, None] > 0.0) != (ahead > 0.0)
    undoing = np.argmax(same & opposite, axis=1)
    arrived = lambda z: np.hypot(z[:, 0] - goal[0], z[:, 1] - goal[1]) <= RADIUS
    for t in range(LONGEST):
        active &= ~arrived(planar)
        now = np.flatnonzero(active)
        if len(now) == 0:
            break
        z = planar[now, None, None]
        direction = z[..., 2] + 0.5 * angle
        arcs = np.stack(
            [z[..., 0] + chord * np.cos(direction), z[..., 1] + chord * np.sin(direction), z[..., 2] + angle], axis=-1
        )
        left, best = np.arange(len(now)), np.full(len(now), -1)
        value = np.array(cost.at(arcs[:, :, -1]))
        moving = np.flatnonzero(last[now] >= 0)
        value[moving, undoing[last[now[moving]]]] = np.inf
        for choice in np.argsort(value, axis=1).T:
            bodies = shapely.polygons(CAR.corners(arcs[left, choice[left]]))
            hit = shapely.intersects(solid, bodies).any(axis=1)
            best[left[~hit]] = choice[left[~hit]]
            left = left[hit]
        active[now[left]] = False  # nowhere to go
        moved = best >= 0
        total[now[moved]] += cost.gamma**t
        last[now[moved]] = best[moved]
        planar[now[moved]] = arcs[np.flatnonzero(moved), best[moved], -1]
    return np.where(arrived(planar), total, cost.never)


@pytest.fixture(scope="module")
def grids(arena) -> tuple[PoseGrid, PoseGrid]:
    """Return grids at the working resolution and at twice that in x, y and heading, with the same motions."""
    coarse = ValueConfig()
    fine = ValueConfig(n_headings=2 * coarse.n_headings, turns=tuple(2 * b for b in coarse.turns))
    return PoseGrid.of(arena, CAR, coarse), PoseGrid.of(finer(arena), CAR, fine)


def test_working_size_with_a_sealed_room(grids):
    grid = grids[0]
    assert grid.blocked.shape == (160, 128, 64)
    assert len(grid.motions.controls) == 10
    result = solve(grid, np.array([1.0, 1.0]))
    assert result.solved
    assert result.residual < 1e-3
    assert result.sweeps <= 100
    inside = np.moveaxis(grid.blocked[128:155, 98:123], -1, 0)
    assert result.unreachable >= np.count_nonzero(~inside) > 0
    assert np.all(np.asarray(result.cost_to_go.values)[128:155, 98:123] == np.float32(100.0))


@pytest.mark.parametrize("goal", [(1.0, 1.0), (2.6, 2.1), (4.6, 0.5), (3.0, 3.8)])
def test_policy_cost_within_3_percent_of_twice_the_resolution(arena, grids, goal):
    goal = np.array(goal)
    solid = obstacles(arena)
    rng = np.random.default_rng(0)
    starts = rng.uniform([0.0, 0.0, -np.pi], [5.2, 4.2, np.pi], (12_000, 3))
    starts = starts[~shapely.intersects(solid, shapely.polygons(CAR.corners(starts)))]
    coarse, fine = (solve(grid, goal[:2]).cost_to_go for grid in grids)
    starts = starts[(coarse.at(starts) < 99.0) & (fine.at(starts) < 99.0)][:300]
    a, b = (policy_cost(c, g.motions, starts, goal, solid) for c, g in zip((coarse, fine), grids, strict=True))
    assert (a < coarse.never).mean() > 0.98
    assert a.mean() <= 1.03 * b.mean()  # over all starts: one that does not arrive costs as much as never
    assert coarse.at(starts).mean() == pytest.approx(fine.at(starts).mean(), rel=0.03)
