"""Test hybrid A* in predicted ranges: against all chains of controls, exact clearances and exact shortest paths."""

import itertools
import math

import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.plane.scan_room import AnalyticRoom, full_circle
from vssm_gym.envs.physics.planar import clearance
from vssm_gym.envs.tasks.mazes import ROBOT, load_maze
from vssm_gym.errors import InputError
from vssm_gym.eval.protocols.exact_scans import ExactScans
from vssm_gym.model.transition import MotionNoise, Planar
from vssm_gym.model.transition.rigid import Rigid
from vssm_gym.planning.result import PlanStatus
from vssm_gym.planning.scans.control_sequences import motions, random_controls
from vssm_gym.planning.scans.hybrid_astar import ScanPlannerConfig, plan
from vssm_gym.planning.scans.range_table import RangeTable, range_table

LIMITS = ROBOT.limits[[0, 2]]
RADIUS = ROBOT.radius
MOVES = motions(Planar(MotionNoise(0.0, 0.0)), random_controls(0, LIMITS, 32, 3), 0.2, 0.01)


def open_table(side: float = 1.0, reach: float = 1.5) -> RangeTable:
    """Return a table of a model that predicts nothing within its range, anywhere."""
    n = round(side / 0.01) + 1
    far = np.full((n, n), reach, np.float32)
    return RangeTable(0.0, 0.0, 0.01, far, np.zeros_like(far), np.full((n, n, 128), reach, np.float32))


def length_of(poses):
    return float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())


@pytest.fixture(scope="module")
def maze():
    return load_maze("pillars-v1")


@pytest.fixture(scope="module")
def exact(maze):
    return range_table(ExactScans(jnp.asarray(maze.rectangles), full_circle()), np.zeros(2), np.ones(2))


def test_motions_are_those_of_the_transition():
    controls = random_controls(3, LIMITS, 5, 4)
    transition = Planar(MotionNoise(0.0, 0.0))
    found = motions(transition, controls, 0.2, 0.01)
    state = np.zeros((5, 3))
    for k in range(4):
        state = np.asarray(transition.mean(jnp.asarray(state), jnp.asarray(controls[:, k]), 0.2))
        np.testing.assert_allclose(found.displacement[:, 2 * k + 1], state, atol=1e-6)
    assert found.length.max() <= 0.01 + 1e-6
    np.testing.assert_allclose(found.length.sum(axis=1), controls[..., 2].sum(axis=1), atol=1e-6)
    assert np.array_equal(random_controls(3, LIMITS, 5, 4), controls)
    with pytest.raises(InputError, match="plane"):
        motions(Rigid(), controls, 0.2, 0.01)
    with pytest.raises(InputError, match="three"):
        random_controls(0, LIMITS, 2, 1)


def test_the_cheapest_of_all_chains_is_found():
    """With cells so fine that no two chains share one, the search is as good as trying every chain."""
    controls = random_controls(1, LIMITS, 5, 2)[[0, 2, 3, 4]]
    moves = motions(Planar(MotionNoise(0.0, 0.0)), controls, 0.2, 0.01)
    config = ScanPlannerConfig(cell=0.003, headings=120, turn=0.003)
    start = np.array([0.05, 0.1, 0.3])
    reached = {}
    for chain in itertools.product(range(4), repeat=4):
        pose, cost = start.copy(), 0.0
        for m in chain:
            c, s = math.cos(pose[2]), math.sin(pose[2])
            x, y, turn = moves.displacement[m, -1]
            pose = pose + np.array([c * x - s * y, s * x + c * y, turn])
            cost += moves.length[m].sum() + 0.003 * moves.turned[m]
            place = round(pose[0], 9), round(pose[1], 9)
            reached[place] = min(cost, reached.get(place, math.inf))
    for goal in [max(reached), min(reached, key=lambda p: abs(p[0] - 0.12) + abs(p[1] - 0.16))]:
        goal = np.array(goal)
        best = min(cost for place, cost in reached.items() if math.hypot(*(place - goal)) <= 0.004)
        found = plan(start, goal, open_table(0.3), moves, RADIUS, goal_radius=0.004, config=config)
        assert found.found
        assert found.cost == pytest.approx(best, abs=1e-5)


def test_drives_keep_the_exact_clearance(maze, exact):
    """Between all poses, not only at them; and a drive without danger is nearly as short as any path."""
    ratios, short = [], []
    for task in maze.tasks.tasks[::75]:
        start, goal = np.array(task.start), np.array(task.goal)
        found = plan(start, goal, exact, MOVES, RADIUS, goal_radius=0.012)
        assert found.found
        assert math.hypot(*(found.poses[-1, :2] - goal)) <= 0.012
        np.testing.assert_allclose(found.poses[0], start, atol=1e-9)
        for a, b in itertools.pairwise(found.poses[:, :2]):
            for share in (0.25, 0.5, 0.75, 1.0):
                assert clearance(*(a + share * (b - a)), maze.rectangles) >= RADIUS
        shortest = maze.sampler.geodesics.length(start[:2], goal, 0.012)
        ratios.append(length_of(found.poses) / shortest)
        careless = plan(
            start, goal, exact, MOVES, RADIUS, goal_radius=0.012, config=ScanPlannerConfig(danger=0.0, turn=0.0)
        )
        short.append(length_of(careless.poses) / shortest)
    assert min(short) > 1.0 - 1e-3  # nothing is shorter than the exact path
    assert max(short) < 1.12
    assert max(ratios) < 1.15


def test_danger_keeps_away_from_walls(maze, exact):
    task = maze.tasks.tasks[100]
    kept = []
    for danger in (0.0, 0.3):
        config = ScanPlannerConfig(danger=danger)
        found = plan(np.array(task.start), np.array(task.goal), exact, MOVES, RADIUS, goal_radius=0.012, config=config)
        kept.append(np.mean([min(clearance(x, y, maze.rectangles), 0.04) for x, y in found.poses[:, :2]]))
    assert kept[1] > kept[0]


def test_a_place_behind_a_wall_is_not_entered_whatever_is_predicted_there():
    """A model knows nothing behind a wall: it may predict that all is free, but before the wall it sees the wall."""
    table = open_table()
    before = table.x + table.spacing * np.arange(101) <= 0.5
    direction = 2.0 * np.pi * np.arange(128) / 128
    away = (0.5 - table.spacing * np.arange(101))[:, None] / np.maximum(np.cos(direction), 1e-3)
    reach = np.where(before[:, None] & (np.cos(direction) > 1e-3), away, 1.5)
    walled = table._replace(reach=np.broadcast_to(reach[:, None], table.reach.shape).astype(np.float32))
    start, goal = np.array([0.3, 0.5, 0.0]), np.array([0.7, 0.5])
    assert plan(start, goal, table, MOVES, RADIUS, goal_radius=0.012).found
    config = ScanPlannerConfig(margins=(0.0025,))
    assert plan(start, goal, walled, MOVES, RADIUS, goal_radius=0.012, config=config).status is PlanStatus.NO_PATH


def test_a_start_that_is_too_near_is_left(maze, exact):
    room = range_table(AnalyticRoom(full_circle()), np.zeros(2), np.array([1.0, 0.6]))
    found = plan(np.array([0.5, 0.009, 0.0]), np.array([0.8, 0.3]), room, MOVES, RADIUS, goal_radius=0.012)
    assert found.found
    assert found.poses[-1, 1] > 0.28
    blocked = plan(np.array([0.3, 0.4, 0.0]), np.array([0.8, 0.3]), room, MOVES, RADIUS, goal_radius=0.012)
    assert blocked.status is PlanStatus.START_BLOCKED
    assert len(blocked.poses) == 0
    assert blocked.cost == math.inf


def test_too_few_expansions_end_in_the_nearest_place(maze, exact):
    task = maze.tasks.tasks[20]
    config = ScanPlannerConfig(max_expansions=100)
    found = plan(np.array(task.start), np.array(task.goal), exact, MOVES, RADIUS, goal_radius=0.012, config=config)
    assert found.status is PlanStatus.TIME_OUT
    assert found.expansions == 100
    assert len(found.poses) > 1


def test_what_is_no_pose_is_refused():
    with pytest.raises(InputError, match="start"):
        plan(np.array([0.1, np.nan, 0.0]), np.ones(2), open_table(), MOVES, RADIUS, goal_radius=0.01)
    with pytest.raises(InputError, match="goal"):
        plan(np.array([0.1, 0.1, 0.0]), np.ones(3), open_table(), MOVES, RADIUS, goal_radius=0.01)
    with pytest.raises(InputError, match="margins"):
        ScanPlannerConfig(margins=())
    with pytest.raises(InputError, match="cell"):
        ScanPlannerConfig(cell=0.0)
