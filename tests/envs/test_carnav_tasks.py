"""Test where the car fits and which poses it reaches: shapely and hand-made rooms are the oracles."""

import math
import pickle

import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from tests.helpers.box_rooms import furniture
from tests.helpers.car_worlds import two_yards, yard
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.scenes.solids import footprint
from vssm_gym.envs.tasks.car import (
    GOAL_MARGIN,
    TARGET_APART,
    CarTask,
    CarTaskSampler,
)
from vssm_gym.envs.tasks.car_sets import make_car_tasks
from vssm_gym.envs.tasks.car_space import ARC_TURNS, LATTICE_CELL, LATTICE_HEADINGS, CarSpace
from vssm_gym.errors import InputError
from vssm_gym.geometry.car import GOAL_HEADING_TOLERANCE, GOAL_RADIUS, Car
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.model.transition import Bicycle

CAR = Car()
ARENAS = ("arena", "depot", "dock", "garage", "paddock")
PIECES = (
    furniture("crate", (1.5, 1.0, 0.2), (0.3, 0.5, 0.4), 0.6),
    furniture("shelf", (2.2, 1.6, 1.0), (1.0, 0.3, 0.2)),
)
ROOM = yard(3.0, 2.4, PIECES)
SPACE = CarSpace(ROOM, CAR)
SOLID = shapely.union_all([footprint(box) for box in ROOM.boxes() if box.kind == "wall" or box.name == "crate"])
SAMPLER = CarTaskSampler.of(ROOM, CAR)
CUT = CarTaskSampler.of(two_yards(), CAR)


@given(st.floats(0.1, 2.9), st.floats(0.1, 2.3), st.floats(-4.0, 4.0), st.sampled_from([0.0, 0.03, -0.01]))
def test_a_pose_is_free_where_its_rectangle_meets_no_box(x, y, heading, margin):
    """Shapely's intersection is the oracle, up to a nanometre at contact. The shelf hangs above the car."""
    grown = Car(length=CAR.length + 2 * margin, width=CAR.width + 2 * margin, rear_overhang=CAR.rear_overhang + margin)
    away = shapely.Polygon(grown.corners(np.array([x, y, heading]))).distance(SOLID)
    overlap = shapely.Polygon(grown.corners(np.array([x, y, heading]))).intersection(SOLID).area
    free = bool(SPACE.free(np.array([x, y, heading]), margin))
    if away > 1e-9 or overlap > 1e-9:
        assert free == (away > 0.0)


def test_off_the_floor_is_not_free():
    assert not SPACE.free(np.array([[-1.0, 1.0, 0.0], [9.0, 1.0, 0.0]])).any()


def test_the_obstacle_of_a_collision_is_named():
    assert SPACE.obstacles_at(np.array([1.4, 1.0, 0.0])) == ["crate"]
    assert SPACE.obstacles_at(np.array([0.1, 1.2, 0.0])) == ["wall 3"]
    assert SPACE.obstacles_at(np.array([0.6, 0.5, 0.0])) == []


def test_one_room_is_one_part_and_a_fence_makes_two():
    labels = SPACE.labels
    assert (labels == 0).sum() > 0.9 * (labels >= 0).sum()
    space = CUT.space
    west, east = space.part(np.array([1.0, 1.5, 0.0])), space.part(np.array([5.0, 1.5, 0.0]))
    assert {west, east} == {0, 1}
    assert space.part(np.array([3.0, 1.5, 0.0])) == -1  # in the gap, which is too narrow
    assert space.part(np.array([1.5, 0.4, 2.0])) == west
    # pressed against the fence it belongs to the side that it stands on
    assert space.part(np.array([2.95 - 0.325 + 0.001, 1.0, 0.0])) == west


def test_a_pocket_without_room_to_turn_or_leave_is_a_part_of_its_own():
    """In a walled box of 0.6 x 0.4 m the car fits and cannot leave."""
    pen = [
        furniture("south", (2.0, 1.75, 0.2), (0.9, 0.1, 0.4)),
        furniture("north", (2.0, 2.25, 0.2), (0.9, 0.1, 0.4)),
        furniture("west", (1.6, 2.0, 0.2), (0.1, 0.4, 0.4)),
        furniture("east", (2.4, 2.0, 0.2), (0.1, 0.4, 0.4)),
    ]
    sampler = CarTaskSampler.of(yard(4.0, 4.0, tuple(pen)), CAR)
    inside = np.array([1.88, 2.0, 0.0])
    assert sampler.space.free(inside, 0.02)
    assert sampler.space.part(inside) != sampler.space.part(np.array([0.5, 0.5, 0.0])) == 0
    with pytest.raises(InputError, match=r"goal: expected a target that the car can reach from \(0.50, 0.50, 0.00\)"):
        sampler.task((0.5, 0.5, 0.0), tuple(inside))


@pytest.mark.parametrize("targets", ["poses", "points"])
@pytest.mark.parametrize("scene", ARENAS)
def test_tasks_are_free_apart_and_within_reach(scene, targets):
    sampler = CarTaskSampler.of(load_scene(scene), CAR)
    tasks = [sampler.draw(np.random.default_rng([7, i]), targets, i) for i in range(12)]
    assert len(set(tasks)) == 12
    for i, task in enumerate(tasks):
        assert task.id == i and task.scene == scene and len(task.goal) == (3 if targets == "poses" else 2)
        assert sampler.space.free(np.array(task.start), GOAL_MARGIN - 1e-9)
        if targets == "poses":
            assert sampler.space.free(np.array(task.goal), GOAL_MARGIN - 1e-9)
        assert math.dist(task.start[:2], task.goal[:2]) > TARGET_APART
        sampler.validate(task)
        assert not task.reached(np.array(task.start))
    assert sampler.draw(np.random.default_rng([7, 5]), targets, 5) == tasks[5]


@pytest.mark.parametrize("scene", ARENAS)
def test_nearly_all_of_an_arena_is_within_reach(scene):
    """The rest are single poses of the lattice without a path to other poses."""
    sampler = CarTaskSampler.of(load_scene(scene), CAR)
    count = np.bincount(sampler.space.labels[sampler.space.labels >= 0])
    assert count[0] > 0.97 * count.sum() and count[1] < 10
    poses = sampler.space.sample(np.random.default_rng(0), 2000, GOAL_MARGIN)
    assert len(poses) > 300 and np.mean([sampler.space.part(pose) == 0 for pose in poses]) > 0.99


def test_goals_are_drawn_on_the_side_where_the_car_is():
    rng = np.random.default_rng(0)
    for x in (1.0, 5.0):
        for _ in range(5):
            goal = CUT.goal_from(rng, np.array([x, 1.5, 0.3])).goal
            assert (goal[0] < 3.0) == (x < 3.0)
    with pytest.raises(InputError, match="goal: expected a target that the car can reach"):
        CUT.task((1.0, 1.5, 0.0), (5.0, 1.5))


def test_targets_are_uniform_over_free_poses():
    rng = np.random.default_rng(1)
    goals = np.array([CUT.goal_from(rng, np.array([0.4, 0.4, 0.3])).goal for _ in range(400)])
    assert abs(np.exp(1j * goals[:, 2]).mean()) < 0.12
    assert goals[:, 0].min() < 0.6 and goals[:, 0].max() > 2.4 and np.ptp(goals[:, 1]) > 2.0


@given(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-0.5, 0.5))
def test_reached_means_near_and_aligned(dx, dy, turn):
    pose, point = (CarTask(scene="yard", start=(0, 0, 0), goal=goal) for goal in ((1.0, 1.0, 3.1), (1.0, 1.0)))
    planar = np.array([1.0 + dx, 1.0 + dy, 3.1 + turn])  # the heading may pass pi
    assert point.reached(planar) == (math.hypot(planar[0] - 1.0, planar[1] - 1.0) <= GOAL_RADIUS)
    assert pose.reached(planar) == (point.reached(planar) and pose.turn(planar) <= GOAL_HEADING_TOLERANCE)
    assert pose.turn(planar) == pytest.approx(abs(turn), abs=1e-9)


@pytest.mark.parametrize(
    ("start", "goal", "message"),
    [
        ((1.5, 1.0, 0.0), (0.6, 0.5, 0.0), "start: expected a pose where the car fits.*crate"),
        ((0.6, 0.5, 0.0), (1.5, 1.0, 0.0), "goal: expected a pose where the car fits.*crate"),
        ((9.0, 0.5, 0.0), (0.6, 0.5, 0.0), "start: .*off the floor"),
        ((0.6, 0.5, 0.0), (9.0, 9.0), "goal: expected a target that the car can reach"),
        ((0.6, 0.5, 0.0), (1.5, 1.0), "goal: expected a target that the car can reach"),
        ((0.6, 0.5), (1.5, 1.0), "start"),
        ((0.6, 0.5, 0.0), (math.nan, 1.0), "goal"),
        ((0.6, 0.5, 0.0), (1.0,), "goal"),
    ],
)
def test_impossible_tasks_are_refused(start, goal, message):
    with pytest.raises(InputError, match=message):
        SAMPLER.task(start, goal)


def test_tasks_of_other_scenes_are_refused():
    task = SAMPLER.draw(np.random.default_rng(0))
    with pytest.raises(InputError, match="scene"):
        CUT.validate(task)
    with pytest.raises(ValidationError):
        CarTask(scene="yard", start=(0, 0, 0), goal=(1, 1), extra=1)


def test_a_scene_has_one_sampler_also_through_pickle():
    assert CarTaskSampler.of(ROOM, CAR) is SAMPLER
    assert pickle.loads(pickle.dumps(SAMPLER)) is SAMPLER


def test_a_scene_without_room_is_refused():
    sampler = CarTaskSampler.of(yard(0.5, 0.5), CAR)
    with pytest.raises(InputError, match="yard: rooms: expected room for a car"):
        sampler.draw(np.random.default_rng(0))


def test_every_target_that_is_drawn_would_be_accepted():
    """A corner of `paddock` holds poses near the drivable part that nothing drivable comes close enough to."""
    tasks = make_car_tasks(load_scene("paddock"), 70)
    sampler = CarTaskSampler.of(load_scene("paddock"), CAR)
    for task in tasks.tasks:
        sampler.validate(task)


@pytest.mark.parametrize("curvature", [-1, 0, 1])
@pytest.mark.parametrize("k", [0, 5, 40])
def test_the_lattice_is_joined_by_the_arcs_of_the_bicycle(k: int, curvature: int) -> None:
    """The twin of the model's law: cells of the exact arc at full lock, to the rounding to a cell."""
    turn, angle = ARC_TURNS[1], 2.0 * np.pi * ARC_TURNS[1] / LATTICE_HEADINGS
    steering = curvature * CAR.max_steering
    bicycle = Bicycle(wheelbase=CAR.wheelbase)
    for share, (i, j, heading) in zip((0.25, 0.5, 0.75, 1.0), SPACE._cells_along(k, curvature, turn), strict=True):
        start = jnp.array([0.0, 0.0, 2.0 * np.pi * k / LATTICE_HEADINGS])
        x, y, after = bicycle.mean(start, jnp.array([CAR.turning_radius * angle * share, steering]), 1.0)
        assert max(abs(LATTICE_CELL * i - float(x)), abs(LATTICE_CELL * j - float(y))) <= 0.5 * LATTICE_CELL + 1e-6
        assert (
            abs(wrap_angle(float(after) - 2.0 * np.pi * heading / LATTICE_HEADINGS)) <= np.pi / LATTICE_HEADINGS + 1e-5
        )
