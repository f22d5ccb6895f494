"""Test floor plans of beliefs, roadmaps and candidates in them, and tours, against exact geometry and enumeration."""

import itertools

import numpy as np
import pytest
import shapely

from tests.helpers.planning_worlds import VOXEL, voxel_map
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.exploration.candidates import Roadmap, candidates, representatives, spread_places
from vssm_gym.planning.exploration.minimum_latency_tour import best_order
from vssm_gym.planning.floor_plan import PAD, FloorPlan
from vssm_gym.planning.occupancy_grid import FREE, OCCUPIED, UNKNOWN

FLOOR = shapely.box(0.0, 0.0, 5.0, 3.0)
WALL = shapely.box(2.4, 0.0, 2.6, 2.0)  # leaves 1 m between two rooms
START = np.array([1.0, 1.0])
NONE = np.empty((0, 2))


@pytest.fixture(scope="module")
def west():
    """Return the plan of a map in which only x < 3.5 was observed."""
    seen = voxel_map(FLOOR, [(WALL, 0.0, 1.0)], observed=lambda x, y, z: (x < 3.5) & (y == y) & (z == z))
    return seen, FloorPlan.of(seen, 0.08, 0.5)


def test_the_plan_shows_free_occupied_and_unknown_cells(west):
    _, plan = west
    assert plan.state(np.array([[1.0, 1.0], [3.0, 2.5], [2.43, 1.0], [4.5, 1.0], [90.0, 0.0]])).tolist() == [
        FREE,
        FREE,
        OCCUPIED,
        UNKNOWN,
        UNKNOWN,
    ]
    free = plan.centres(np.argwhere(plan.cells == FREE))
    inside = shapely.contains_xy((FLOOR - WALL).buffer(0.5 * VOXEL), free[:, 0], free[:, 1])
    assert inside.all()
    assert len(free) * plan.resolution**2 == pytest.approx(3.5 * 3.0 - 0.2 * 2.0, rel=0.05)
    assert plan.origin[0] >= -0.3 - 1e-6  # the map ends here, less than PAD beside what is known
    assert PAD > 0.3


def test_the_body_frees_cells_and_observations_add_obstacles(west):
    voxels, _ = west
    shape = voxels.shape[:2]
    at = lambda x, y: tuple(np.round((np.array([x, y]) - np.asarray(voxels.origin)[:2]) / VOXEL).astype(int))
    body, near, seen = (np.zeros(shape, bool) for _ in range(3))
    body[at(2.45, 1.0)] = near[at(4.5, 1.0)] = seen[at(1.0, 2.0)] = True
    near[at(2.45, 1.2)] = True  # in the wall: a ring does not disprove what was seen
    plan = FloorPlan.of(voxels, 0.08, 0.5, body, near, seen)
    places = np.array([[2.45, 1.0], [4.5, 1.0], [1.0, 2.0], [2.45, 1.2]])
    assert plan.state(places).tolist() == [FREE, FREE, OCCUPIED, OCCUPIED]


def test_clearance_agrees_with_the_finer_one(west):
    voxels, plan = west
    fine, coarse = ClearanceMap.from_voxel_map(voxels), plan.clearance()
    points = np.random.default_rng(0).uniform([0.2, 0.2], [3.3, 2.8], (200, 2))
    assert np.abs(fine.at(points) - coarse.at(points)).max() < VOXEL
    window = plan.clearance(START, 0.5)
    assert window.clearance.shape == (21, 21)


def test_roadmap_distances_lead_around_walls(west):
    _, plan = west
    roadmap = Roadmap.of(plan, START, 0.15)
    there = np.array([3.2, 1.0])
    around = np.hypot(1.4 - 0.15, 1.0 + 0.15) + 0.5 + np.hypot(0.6 - 0.15, 1.0 + 0.15)  # over the wall's grown end
    assert roadmap.at(roadmap.distance, there[None])[0] == pytest.approx(around, rel=0.06)
    assert roadmap.at(roadmap.distances_from(there), START[None])[0] == pytest.approx(around, rel=0.06)
    assert roadmap.reaches(there)
    assert not roadmap.reaches(np.array([4.5, 1.0]))  # unknown space is not free for the body
    finite = np.isfinite(roadmap.distance)
    assert (roadmap.headroom[finite] >= 0.15).all()


def test_a_robot_at_a_wall_can_leave_it(west):
    _, plan = west
    assert Roadmap.of(plan, np.array([0.08, 1.0]), 0.15).reaches(START)


def test_places_cover_reachable_space(west):
    _, plan = west
    roadmap = Roadmap.of(plan, START, 0.15)
    places = spread_places(roadmap, 0.5)
    reached = plan.centres(np.argwhere(np.isfinite(roadmap.distance)))
    gap = np.linalg.norm(reached[:, None] - places[None], axis=-1).min(axis=1)
    assert gap.max() < 0.5 * np.sqrt(2.0)
    assert len(np.unique(np.floor(places / 0.5), axis=0)) == len(places)
    along = roadmap.at(roadmap.distance, places)
    assert np.all(np.diff(along) >= 0.0)


def test_candidates_see_the_unknown_and_representatives_share_it(west):
    _, plan = west
    roadmap = Roadmap.of(plan, START, 0.15)
    found = candidates(roadmap, spacing=0.5, hazard=0.5, least_area=0.1, dismissed=NONE)
    assert len(found.xy) > 3
    assert (found.area >= 0.1).all()
    blind = np.array([1.0, 0.5])  # behind the wall
    assert np.linalg.norm(found.xy - blind, axis=1).min() > 0.1
    chosen = representatives(found, 3, 0.1, 0.1)
    assert chosen[0] == np.argmax(found.area * np.exp(-0.1 * found.distance))
    assert len(set(chosen.tolist())) == len(chosen)
    best = np.zeros(found.seen.shape[1])
    for k in chosen:  # greedy: none adds more than the one that was chosen
        more = np.maximum(found.seen - best, 0.0).sum(axis=1) * np.exp(-0.1 * found.distance)
        assert more[k] == pytest.approx(more.max(), rel=1e-5)
        best = np.maximum(best, found.seen[k])
    fewer = candidates(roadmap, spacing=0.5, hazard=0.5, least_area=0.1, dismissed=found.xy[chosen[:1]])
    assert np.linalg.norm(fewer.xy - found.xy[chosen[0]], axis=1).min() > 0.2


def test_a_map_without_unknown_space_has_no_candidates():
    plan = FloorPlan.of(voxel_map(FLOOR, []), 0.08, 0.5)
    cells = np.where(plan.cells == UNKNOWN, OCCUPIED, plan.cells).astype(np.int8)
    roadmap = Roadmap.of(FloorPlan(cells, plan.occupancy, plan.origin, plan.resolution), START, 0.15)
    found = candidates(roadmap, spacing=0.5, hazard=0.5, least_area=0.1, dismissed=NONE)
    assert len(found.xy) == 0
    assert len(representatives(found, 3, 0.1, 0.1)) == 0


@pytest.mark.parametrize("n", [1, 2, 4, 6])
def test_best_order_by_enumeration(n):
    rng = np.random.default_rng(n)
    for _ in range(20):
        xy, weight = rng.uniform(0.0, 10.0, (n, 2)), rng.uniform(0.0, 5.0, n)
        start, between = np.linalg.norm(xy, axis=1), np.linalg.norm(xy[:, None] - xy[None], axis=-1)

        def cost(order, start=start, between=between, weight=weight):
            arrival = np.cumsum([start[order[0]], *(between[a, b] for a, b in itertools.pairwise(order))])
            return float(arrival @ weight[list(order)])

        order, total = best_order(start, between, weight)
        assert sorted(order.tolist()) == list(range(n))
        assert total == pytest.approx(min(map(cost, itertools.permutations(range(n)))))
        assert cost(order.tolist()) == pytest.approx(total)


def test_a_small_pocket_nearby_comes_before_a_large_room_far_away():
    """Greedy gain leaves the pocket for later and returns; the minimum-latency tour visits it first."""
    start, weight = np.array([0.5, 6.0]), np.array([1.0, 10.0])
    between = np.array([[0.0, 5.5], [5.5, 0.0]])
    assert np.argmax(weight) == 1
    assert best_order(start, between, weight)[0].tolist() == [0, 1]
