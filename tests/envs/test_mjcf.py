"""Test that the robot executes commands in free space, and that obstacles stop it without friction."""

import math
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.box_rooms import furniture, two_rooms
from vssm_gym.envs.physics import FloorWorld, build_floor_spec
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.geometry.transforms import wrap_angle

ROBOT = HolonomicRobot()
EMPTY = FloorWorld(two_rooms(), ROBOT)
WALL = 0.05 + ROBOT.radius  # m from a wall's centre line to the robot's centre at contact


@given(
    st.floats(-math.pi, math.pi),
    st.floats(-math.pi, math.pi),
    st.floats(0.0, 0.4),
    st.floats(-1.0, 1.0),
)
def test_free_motion_ends_at_the_commanded_pose(heading, direction, distance, turn):
    start = np.array([1.5, 1.5, heading])
    target = np.add(start, [distance * math.cos(direction), distance * math.sin(direction), turn])
    EMPTY.reset(start)
    assert not EMPTY.drive(target)
    after = EMPTY.pose()
    np.testing.assert_allclose(after[:2], target[:2], atol=1e-9)
    assert abs(float(wrap_angle(np.array(after[2] - target[2])))) < 1e-9
    assert -math.pi <= after[2] < math.pi


def test_many_steps_do_not_accumulate_speed_or_error():
    rng, expected = np.random.default_rng(0), np.array([1.5, 2.0, 0.0])
    EMPTY.reset(expected)
    for _ in range(200):
        goal = np.array([1.5, 2.0]) + rng.uniform(-0.5, 0.5, 2)
        expected = np.add(expected, [*(0.2 * (goal - expected[:2])), rng.uniform(-0.2, 0.2)])
        EMPTY.drive(expected)
    np.testing.assert_allclose(EMPTY.pose()[:2], expected[:2], atol=1e-9)


@given(st.floats(-1.3, 1.3), st.floats(0.05, 0.4), st.floats(0.0, 0.3))
def test_a_wall_stops_the_robot_which_can_slide_and_back_off(angle, distance, gap):
    """Against the wall x = 0, at ``angle`` from its normal, x stays outside and y advances as without the wall."""
    EMPTY.reset(np.array([WALL + gap, 2.0, 0.0]))
    push = distance * np.array([-math.cos(angle), math.sin(angle) * 0.5, 0.0])
    collided = False
    for _ in range(4):
        before = EMPTY.pose()
        collided |= EMPTY.drive(before + push)
        after = EMPTY.pose()
        assert after[0] > WALL - 0.005
        assert after[1] - before[1] == pytest.approx(push[1], abs=1e-3)
    if 4 * -push[0] > gap + 0.01:
        assert collided and EMPTY.contacts() == ["wall 3"]
    back = np.add(EMPTY.pose(), [0.1, 0.0, 0.3])
    EMPTY.drive(back)
    np.testing.assert_allclose(EMPTY.pose()[:2], back[:2], atol=0.006)
    assert not EMPTY.drive(np.add(EMPTY.pose(), [0.05, 0.0, 0.0])) and EMPTY.contacts() == []


def test_a_corner_holds_the_robot():
    EMPTY.reset(np.array([0.5, 3.5, 0.0]))
    for _ in range(20):
        EMPTY.drive(np.add(EMPTY.pose(), [-0.16, 0.16, 0.0]))
    np.testing.assert_allclose(EMPTY.pose()[:2], [WALL, 4.0 - WALL], atol=0.005)
    assert EMPTY.contacts() == ["wall 2", "wall 3"]


@pytest.mark.parametrize(
    ("low", "high", "blocks"),
    [
        (0.0, 0.1, True),
        (0.45, 0.55, True),  # a table's edge at the robot's top must stop it, not press it into the floor
        (0.3, 0.32, True),
        (0.6, 0.7, False),
        (0.0, 0.008, False),  # a rug
    ],
)
def test_obstacles_at_the_robots_height_block_it(low, high, blocks):
    slab = furniture("slab", (2.0, 2.0, 0.5 * (low + high)), (0.3, 1.0, high - low))
    world = FloorWorld(two_rooms(pieces=(slab,)), ROBOT)
    world.reset(np.array([1.2, 2.0, 0.0]))
    collided = [world.drive(np.add(world.pose(), [0.16, 0.0, 0.0])) for _ in range(8)]
    assert any(collided) == blocks
    assert world.pose()[0] == pytest.approx(1.85 - ROBOT.radius if blocks else 1.2 + 8 * 0.16, abs=0.005)


def test_nothing_is_tunnelled_through():
    """A 1 cm panel stops the longest step that high noise can produce."""
    panel = furniture("panel", (2.0, 2.0, 0.5), (0.01, 2.0, 1.0), yaw=0.4)
    world = FloorWorld(two_rooms(pieces=(panel,)), ROBOT)
    normal = np.array([math.cos(0.4), math.sin(0.4)])
    for start in np.random.default_rng(1).uniform([1.4, 1.7], [1.7, 2.3], (20, 2)):
        world.reset(np.array([*start, 0.0]))
        for _ in range(3):
            world.drive(np.add(world.pose(), [*(0.45 * normal), 0.0]))
            clearance = 0.0 - normal @ (world.pose()[:2] - [2.0, 2.0]) - 0.005 - ROBOT.radius
            assert clearance > -0.008


@given(st.integers(0, 2**32 - 1))
def test_contacts_agree_with_free_space(seed):
    """The physics engine and the geometry of tasks agree on collisions."""
    rng = np.random.default_rng(seed)
    pieces = tuple(
        furniture(
            f"f{i}", (*rng.uniform([0.5, 0.5], [5.5, 3.5]), 0.3), (*rng.uniform(0.1, 0.8, 2), 0.5), rng.uniform(0, 3)
        )
        for i in range(4)
    )
    apartment = two_rooms(pieces=pieces)
    world = FloorWorld(apartment, ROBOT)
    points = rng.uniform([0.2, 0.2], [5.8, 3.8], (20, 2))
    # Free space is a polygon inside the true one: at most 0.9 % of the radius of grown corners is missing.
    free = FreeSpace.from_apartment(apartment, ROBOT.radius, ROBOT.height)
    roomy = FreeSpace.from_apartment(apartment, ROBOT.radius - 0.003, ROBOT.height)
    for point in points:
        world.reset(np.array([*point, 0.0]))
        collided = world.drive(np.add(world.pose(), [0.0, 0.0, 0.1]))
        if free.contains(point):
            assert not collided
        elif not roomy.contains(point):
            assert collided and set(world.contacts()) <= set(free.obstacles_at(point))


def test_rays_hit_boxes_and_pass_through_the_robot():
    EMPTY.reset(np.array([1.0, 2.0, 0.0]))
    boxes = EMPTY.boxes
    directions = np.array([[-2.0, 0.0, 0.0], [0.0, 0.0, -0.5], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    t, hit = EMPTY.multi_ray(np.array([1.0, 2.0, 0.4]), directions)
    np.testing.assert_allclose(t, [0.475, 0.8, 4.95, 1.95], atol=1e-9)  # the third goes through the doorway
    assert [boxes[i].kind for i in hit] == ["wall", "floor", "wall", "wall"]
    t, hit = EMPTY.multi_ray(np.array([1.0, 2.0, 40.0]), np.array([[0.0, 0.0, 1.0]]))
    assert (t[0], hit[0]) == (0.0, -1)


def test_a_pickled_world_continues():
    EMPTY.reset(np.array([0.2, 2.0, 0.5]))
    EMPTY.drive(np.array([0.1, 2.0, 0.6]))
    copy = pickle.loads(pickle.dumps(EMPTY))
    np.testing.assert_array_equal(copy.pose(), EMPTY.pose())
    assert copy.contacts() == EMPTY.contacts() == ["wall 3"]
    target = np.add(copy.pose(), [-0.1, 0.1, 0.2])
    assert copy.drive(target) == EMPTY.drive(target)
    np.testing.assert_allclose(copy.pose(), EMPTY.pose(), atol=1e-12)


def test_the_spec_can_be_saved_as_mjcf(tmp_path):
    spec = build_floor_spec(two_rooms(), ROBOT)
    spec.compile()
    xml = spec.to_xml()
    assert (
        'name="robot"' in xml
        and xml.count("<geom") == 2 + len(EMPTY.boxes) + sum(b.kind == "wall" for b in EMPTY.boxes) - 1
    )
