"""Test every registered planner on every kind of space, against one protocol and an exact visibility graph."""

import inspect
import itertools
from collections.abc import Callable

import numpy as np
import pytest
import shapely

from tests.helpers.box_rooms import ROOM, free_space
from tests.helpers.planning_worlds import clearance_map, signed_depth, voxel_map
from vssm_gym.agents.exploration.frontier_nearest import NearestFrontier
from vssm_gym.agents.navigation.oracle import OracleAgent
from vssm_gym.agents.shared.explorer import ExplorationConfig, Explorer
from vssm_gym.agents.shared.localization import TruePose
from vssm_gym.agents.shared.navigation_config import NavigationConfig
from vssm_gym.agents.shared.navigator import Navigator
from vssm_gym.agents.shared.surroundings import KnownMap
from vssm_gym.envs.tasks.geodesic import Geodesics
from vssm_gym.errors import InputError
from vssm_gym.planning.car.dwa import DwaStatus
from vssm_gym.planning.clearance import OUTSIDE, ClearanceField, ClearanceMap, Space, on_grid
from vssm_gym.planning.floor_plan import FloorPlan
from vssm_gym.planning.mpc.problem import MpcStatus
from vssm_gym.planning.mpc.safety import SafeKind
from vssm_gym.planning.planners import PLANNERS, Planner, find_planner
from vssm_gym.planning.result import Outcome, PlanResult, PlanStatus
from vssm_gym.planning.value_iteration import ValueStatus

RADIUS = 0.1  # m
BOXES = [shapely.box(1.0, 0.9, 1.6, 2.4), shapely.box(2.4, 0.0, 2.7, 2.6), shapely.box(3.4, 1.8, 4.2, 2.4)]
SEALED = shapely.box(3.2, 2.9, 3.3, 4.0) | shapely.box(3.2, 2.9, 4.6, 3.0) | shapely.box(4.5, 2.9, 4.6, 4.0)
SOLID = shapely.union_all([*BOXES, SEALED])


def from_occupancy() -> ClearanceMap:
    """Return exact distances to the floor plan's borders on a grid."""
    return clearance_map(ROOM, SOLID)


def function() -> ClearanceField:
    """Return the same distances as a function of the position, without a grid."""
    blocked = SOLID | (ROOM.buffer(1.0) - ROOM)
    low, high = np.split(np.array(ROOM.bounds), 2)
    return ClearanceField(lambda xy: -signed_depth(blocked, xy[:, 0], xy[:, 1]), low - 0.2, high + 0.2, 0.025)


def learned() -> ClearanceMap:
    """Return the clearance of a learned map of the room."""
    return ClearanceMap.from_voxel_map(voxel_map(ROOM, [(SOLID, 0.0, 1.0)]))


def explored() -> ClearanceMap:
    """Return the coarse clearance of an explorer's floor plan."""
    return FloorPlan.of(voxel_map(ROOM, [(SOLID, 0.0, 1.0)]), 0.08, 0.5).clearance()


KINDS: dict[str, Callable[[], Space]] = {kind.__name__: kind for kind in (from_occupancy, function, learned, explored)}
SURFACE_ERROR = {
    "from_occupancy": 0.01,
    "function": 0.01,
    "learned": 0.02,
    "explored": 0.03,
}  # m, at corners of the boxes
PLACES = [(0.4, 0.4), (0.5, 3.5), (2.0, 1.5), (1.9, 3.6), (3.0, 0.5), (4.6, 2.2), (3.8, 1.5), (4.6, 0.3)]
TRIPS = [(np.array(a), np.array(b)) for a, b in itertools.permutations(PLACES, 2)][::3]


@pytest.fixture(scope="module", params=KINDS)
def space(request: pytest.FixtureRequest) -> tuple[str, Space]:
    return request.param, KINDS[request.param]()


@pytest.fixture(scope="module")
def geodesics() -> dict[float, Geodesics]:
    """Return exact shortest paths of discs of some radii."""
    radii = {round(RADIUS + sign * (error + 0.01), 3) for error in SURFACE_ERROR.values() for sign in (-1.0, 1.0)}
    return {radius: Geodesics(free_space([SOLID], radius)) for radius in radii}


@pytest.fixture(params=PLANNERS)
def planner(request: pytest.FixtureRequest) -> Planner:
    return PLANNERS[request.param]


def length(path: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def along(path: np.ndarray, spacing: float = 0.005) -> np.ndarray:
    """Return points along a polyline."""
    pieces = [path[:1]]
    for a, b in itertools.pairwise(path):
        n = 1 + int(np.linalg.norm(b - a) / spacing)
        pieces.append(a + (b - a) * np.linspace(0.0, 1.0, n + 1)[1:, None])
    return np.concatenate(pieces)


def test_every_row_has_the_protocols_signature(planner):
    asked = inspect.signature(Planner.__call__).parameters
    for name, parameter in list(asked.items())[1:]:
        mine = inspect.signature(planner).parameters[name]
        assert (mine.kind, mine.default) == (parameter.kind, parameter.default)


@pytest.mark.parametrize("goal_radius", [0.0, 0.35])
def test_paths_are_free_short_and_end_right(space, planner, geodesics, goal_radius):
    """Paths have the required clearance; they are no shorter than a thinner disc's, hardly longer than a thicker one's.

    The comparison brackets the error of the space's surfaces. Theta*'s bends lie on nodes, so 2 % and two cells.
    """
    kind, where = space
    grid = on_grid(where)
    slack = SURFACE_ERROR[kind] + 0.01
    thin, thick = (geodesics[round(RADIUS + sign * slack, 3)] for sign in (-1.0, 1.0))
    for start, goal in TRIPS:
        result = planner(start, goal, where, RADIUS, goal_radius=goal_radius)
        assert result.status is PlanStatus.FOUND
        assert result.expansions > 0
        assert result.seconds > 0.0
        assert result.cost == pytest.approx(length(result.path))
        assert np.allclose(result.path[0], start)
        assert np.linalg.norm(result.path[-1] - goal) <= max(goal_radius, grid.resolution) + 1e-9
        # Half a cell between the samples of a sight test: the clearance may dip by a little between them.
        assert grid.at(along(result.path)).min() >= RADIUS - 0.003
        assert result.cost >= thin.length(start, goal, goal_radius) - grid.resolution
        assert result.cost <= 1.02 * thick.length(start, goal, goal_radius) + 2.0 * grid.resolution


def test_a_margin_is_kept(space, planner):
    grid = on_grid(space[1])
    for start, goal in TRIPS[:6]:
        result = planner(start, goal, space[1], RADIUS, margin=0.05)
        assert result.found
        assert grid.at(along(result.path)).min() >= RADIUS + 0.05 - 0.003


def test_a_tight_start_is_left_along_a_ramp(space, planner):
    """A disc of 10 cm leaves a place 6 cm off a wall, and has its clearance as soon as the ramp allows."""
    grid, start = on_grid(space[1]), np.array([2.34, 0.6])
    result = planner(start, np.array([0.5, 3.5]), space[1], RADIUS)
    assert result.found
    points = along(result.path)
    asked = np.minimum(
        RADIUS, grid.at(start) - 0.3 * np.sqrt(2.0) * grid.resolution + 0.3 * np.hypot(*(points - start).T)
    )
    assert np.all(grid.at(points) >= asked - 0.004)


def reasons(planner: Planner, where: Space) -> dict[PlanStatus, PlanResult]:
    inside, cell, outside = np.array([2.55, 1.0]), np.array([3.9, 3.5]), np.array([0.4, 0.4])
    return {
        PlanStatus.START_BLOCKED: planner(inside, outside, where, RADIUS, margin=-0.02),
        PlanStatus.GOAL_BLOCKED: planner(outside, inside, where, RADIUS),
        PlanStatus.NO_PATH: planner(outside, cell, where, RADIUS),
        PlanStatus.TIME_OUT: planner(outside, np.array([4.6, 2.2]), where, RADIUS, max_expansions=30),
    }


def test_failures_are_values_with_a_message(planner):
    """Failures are a start deep inside a wall, a goal without room, a goal behind walls, and too few expansions."""
    where = clearance_map(ROOM, SOLID | shapely.box(2.2, 0.7, 2.9, 1.3))
    for status, result in reasons(planner, where).items():
        assert result.status is status
        assert not result.found
        assert len(result.status.message.split()) > 4
        if status is PlanStatus.TIME_OUT:
            assert result.expansions == 30
            assert where.at(along(result.path)).min() >= RADIUS - 0.003
            assert result.cost == pytest.approx(length(result.path))
        else:
            assert result.path.shape == (0, 2)
            assert result.cost == np.inf


def test_a_goal_within_reach_needs_no_search(planner):
    result = planner(np.array([1.8, 3.5]), np.array([2.0, 3.5]), from_occupancy(), RADIUS, goal_radius=0.35)
    assert result.found
    assert result.path.shape == (1, 2)
    assert result.cost == result.expansions == 0


def test_the_same_question_has_the_same_answer(space, planner):
    one, two = (planner(*TRIPS[3], space[1], RADIUS, margin=0.02) for _ in range(2))
    assert np.array_equal(one.path, two.path)
    assert (one.cost, one.expansions) == (two.cost, two.expansions)


@pytest.mark.parametrize(
    ("field", "arguments", "keywords"),
    [
        ("start", (np.array([np.nan, 0.0]), PLACES[0], RADIUS), {}),
        ("goal", (np.array(PLACES[0]), np.zeros(4), RADIUS), {}),
        ("radius", (np.array(PLACES[0]), PLACES[1], -0.1), {}),
        ("margin", (np.array(PLACES[0]), PLACES[1], RADIUS), {"margin": np.inf}),
        ("goal_radius", (np.array(PLACES[0]), PLACES[1], RADIUS), {"goal_radius": -1.0}),
    ],
)
def test_nan_and_infinite_arguments_are_errors(planner, field, arguments, keywords):
    start, goal, radius = arguments
    with pytest.raises(InputError, match=field):
        planner(start, goal, from_occupancy(), radius, **keywords)


def test_a_function_is_sampled_once():
    calls = []

    def at(xy: np.ndarray) -> np.ndarray:
        calls.append(len(xy))
        return 1.0 - np.abs(xy[:, 1] - 1.0)

    field = ClearanceField(at, np.zeros(2), np.array([3.0, 2.0]), 0.1)
    for planner in PLANNERS.values():
        assert planner(np.array([0.3, 0.5]), np.array([2.7, 1.2]), field, RADIUS).found
    assert calls == [31 * 21]
    grid = on_grid(field)
    assert grid is on_grid(field)
    assert grid is on_grid(grid)
    xy = np.random.default_rng(0).uniform([0.0, 0.0], [3.0, 2.0], (50, 2))
    assert np.allclose(grid.at(xy), at(xy), atol=1e-6)  # linear between its nodes, of which one lies on the ridge
    assert grid.at(np.array([3.2, 1.0])) == OUTSIDE


@pytest.mark.parametrize(
    ("field", "low", "high", "resolution", "values"),
    [
        ("low, high", [0.0, 1.0], [1.0, 1.0], 0.1, 1.0),
        ("resolution", [0.0, 0.0], [1.0, 1.0], 0.0, 1.0),
        ("at", [0.0, 0.0], [1.0, 1.0], 0.1, np.nan),
    ],
)
def test_a_bad_function_is_an_error(field, low, high, resolution, values):
    with pytest.raises(InputError, match=field):
        on_grid(ClearanceField(lambda xy: np.full(len(xy), values), np.array(low), np.array(high), resolution))


def test_planners_by_name_or_as_they_are():
    for name, planner in PLANNERS.items():
        assert find_planner(name) is planner
        assert find_planner(planner) is planner
    with pytest.raises(InputError, match="astar"):
        find_planner("a*")
    with pytest.raises(InputError, match="planner"):
        Navigator(KnownMap(TruePose()), NavigationConfig(planner="dijkstra's"))


@pytest.mark.parametrize("name", PLANNERS)
def test_agents_take_their_planner_by_configuration(name):
    """The navigator and the explorers call the planner that their configuration names or holds, and no other."""
    assert Navigator(KnownMap(TruePose()), NavigationConfig(planner=name))._plan is PLANNERS[name]
    explorer = Explorer(NearestFrontier(), config=ExplorationConfig(planner=name))
    assert explorer._plan_path is PLANNERS[name]
    assert OracleAgent(NavigationConfig(planner=PLANNERS[name])).name == "oracle"


@pytest.mark.parametrize("outcome", [PlanStatus, ValueStatus, MpcStatus, SafeKind, DwaStatus])
def test_every_outcome_has_a_message_of_its_own(outcome):
    """Planners, value iteration, controllers and the safety layer share one kind of outcome."""
    assert issubclass(outcome, Outcome)
    messages = [member.message for member in outcome]
    assert len(outcome.__members__) == len(set(messages)) >= 4  # two outcomes with one message would be one member
    assert all(" " in message and message == message.strip() for message in messages)
