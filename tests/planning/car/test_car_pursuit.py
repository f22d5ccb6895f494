"""Test the pursuit of a drive: exact on arcs, stable off them, through cusps in order, to the goal's heading."""

import math

import numpy as np
import pytest

from tests.helpers.car_worlds import CAR, DEAD_END, PARKED, PARKING, collides, levels, move, occupied, solid
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.planning.car import reeds_shepp
from vssm_gym.planning.car.hybrid_astar import plan
from vssm_gym.planning.car.pursuit import CarPath, PursuitCommand

RADIUS = 0.5  # m
START = np.array([0.3, -0.2, 0.4])


def drive_of(lengths: list[float], steerings: list[int], step: float = 0.025) -> CarPath:
    curve = reeds_shepp.ReedsSheppPath(START, np.array(lengths), np.array(steerings, np.int8), RADIUS)
    return CarPath(*reeds_shepp.sample(curve, step))


def run(
    drive: CarPath, planar: np.ndarray, lag: float = 0.0, slip: float = 0.0
) -> tuple[np.ndarray, list[PursuitCommand]]:
    """Drive until done or for 60 s; commands are reached by a first-order lag (share kept a step), slip is m a step."""
    poses, steps, progress, executed = [planar], [], 0.0, np.zeros(2)
    rng = np.random.default_rng(0)
    while len(steps) < 600:
        steps.append(drive.follow(planar, progress, CAR))
        progress = steps[-1].progress
        if steps[-1].done:
            break
        executed = lag * executed + (1.0 - lag) * steps[-1].control
        planar = move(planar, executed) + slip * rng.normal(size=3)
        poses.append(planar)
    return np.array(poses), steps


DRIVES = [
    ([1.5], [0]),
    ([-1.5], [0]),
    ([1.2], [1]),
    ([-1.2], [-1]),
    ([0.6, 0.8, 0.6], [1, 0, -1]),
    ([0.6, -0.5, 0.7], [1, -1, 1]),
    ([-0.8, 0.6, -0.4], [0, 1, 0]),
    ([0.5, -0.5], [0, 0]),
]


@pytest.mark.parametrize(("lengths", "steerings"), DRIVES)
@pytest.mark.parametrize(("lag", "slip", "tolerance"), [(0.0, 0.0, 0.02), (0.5, 0.0, 0.04), (0.5, 0.002, 0.06)])
def test_drives_are_followed_to_their_end(lengths, steerings, lag, slip, tolerance):
    drive = drive_of(lengths, steerings)
    poses, steps = run(drive, START, lag, slip)
    assert steps[-1].done
    np.testing.assert_array_equal(steps[-1].control, 0.0)
    assert steps[-1].progress == pytest.approx(drive.length)
    assert math.hypot(*(poses[-1] - drive.poses[-1])[:2]) < tolerance + 0.02
    assert abs(wrap_angle(poses[-1, 2] - drive.poses[-1, 2])) < math.radians(10.0)
    off = [np.hypot(*(drive.poses[:, :2] - p[:2]).T).min() for p in poses]
    assert max(off) < tolerance + 0.0125  # samples are 2.5 cm apart


@pytest.mark.parametrize(("lengths", "steerings"), DRIVES)
def test_commands_are_within_limits_and_progress_never_falls(lengths, steerings):
    drive = drive_of(lengths, steerings)
    _, steps = run(drive, START, 0.5, 0.005)
    for step in steps:
        assert np.all(np.abs(step.control) <= CAR.limits + 1e-12)
    assert np.all(np.diff([s.progress for s in steps]) >= 0.0)


@pytest.mark.parametrize("gear", [1.0, -1.0])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_displaced_car_comes_back(gear, side):
    drive = drive_of([gear * 2.0], [0])
    c, s = math.cos(START[2]), math.sin(START[2])
    _, steps = run(drive, START + side * np.array([-0.05 * s, 0.05 * c, 0.1]))
    assert steps[0].deviation == pytest.approx(0.05, abs=1e-6)
    assert steps[0].heading_error == pytest.approx(side * 0.1, abs=1e-6)
    assert steps[-1].deviation < 0.03
    middle = len(steps) // 2
    assert all(step.deviation < 0.01 for step in steps[middle:-1] if step.progress < drive.length - 0.3)


def test_on_an_arc_the_steering_is_that_of_the_arc():
    """This holds for every look-ahead distance; pursuit alone would steer less."""
    drive = drive_of([1.5], [1], step=0.01)
    pose = drive.poses[40]
    control = drive.follow(pose, drive.along[40], CAR).control
    assert math.tan(control[1]) / CAR.wheelbase == pytest.approx(1.0 / RADIUS, rel=1e-3)


def test_it_slows_before_a_cusp_and_before_the_goal():
    drive = drive_of([1.0, -1.0], [0, 0])
    _, steps = run(drive, START)
    speed = np.array([s.control[0] for s in steps[:-1]])
    progress = np.array([s.progress for s in steps[:-1]])
    for end in (1.0, 2.0):
        near = (progress > end - 0.05) & (progress < end - 0.021)
        assert near.any()
        assert np.abs(speed[near]).max() < 0.2
    assert np.abs(speed).max() > 0.4
    assert np.all(speed[progress < 0.97] > 0.0)
    assert np.all(speed[progress >= 1.0] < 0.0)


def test_a_drive_over_its_own_track_is_driven_completely():
    """It drives forwards and backwards twice, so that the nearest point does not identify the segment."""
    drive = drive_of([0.6, -0.6, 0.6, -0.6], [0, 0, 0, 0])
    poses, steps = run(drive, START)
    along = (poses - START)[:, :2] @ [math.cos(START[2]), math.sin(START[2])]
    turns = np.flatnonzero(np.diff(np.sign(np.diff(along))))
    assert len(turns) == 3
    assert steps[-1].done
    assert abs(along[-1]) < 0.03


def test_the_distance_from_the_drive_is_reported():
    drive = drive_of([2.0], [0])
    away = START + np.array([0.0, 0.5, 0.0])
    assert drive.follow(away, 0.0, CAR).deviation > 0.4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("grid", "start", "goal"),
    [
        (PARKING, np.array([0.4, 0.7, 0.0]), PARKED),
        (DEAD_END, np.array([0.5, 1.0, math.pi]), np.array([0.5, 0.35, math.pi])),
        (occupied(3.0, 2.0, (1.3, 0.0, 1.6, 1.3)), np.array([0.6, 0.4, 1.57]), np.array([2.4, 0.4, 1.57])),
    ],
)
def test_plans_of_hybrid_astar_are_driven_without_collision(grid, start, goal):
    result = plan(start, goal, levels(grid), CAR)
    poses, steps = run(CarPath(result.poses, result.gears), start)
    assert steps[-1].done
    assert math.hypot(*(poses[-1] - goal)[:2]) < 0.05
    assert abs(wrap_angle(poses[-1, 2] - np.array(goal[2]))) < math.radians(15.0)
    assert not collides(solid(grid), poses).any()


def test_at_the_goal_already():
    step = CarPath(START[None], np.ones(1, np.int8)).follow(START, 0.0, CAR)
    assert step.done
    np.testing.assert_array_equal(step.control, 0.0)


@pytest.mark.parametrize(
    ("poses", "gears", "field"),
    [
        (np.zeros((0, 3)), np.zeros(0), "poses"),
        (np.zeros((3, 2)), np.ones(3), "poses"),
        (np.zeros((2, 3)), np.zeros(2), "gears"),
    ],
)
def test_bad_input_is_named(poses, gears, field):
    with pytest.raises(InputError, match=field):
        CarPath(poses, gears)
