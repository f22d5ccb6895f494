"""Test DistBug on ranges that a reader can draw: its heading, its side around a wall, and when it leaves a wall."""

import math

import numpy as np
import pytest

from vssm_gym.agents.base import AgentContext
from vssm_gym.agents.navigation.dist_bug import DistBugAgent
from vssm_gym.model.transition import MotionNoise, Planar

BEAMS = 64
LIMITS = np.array([math.radians(30.0), 0.02])
OPEN = np.full(BEAMS, 1.0, np.float32)


def started(heading=0.0):
    agent = DistBugAgent()
    pose = np.array([0.2, 0.5, heading])
    context = AgentContext(
        np.eye(3),
        (0, 0),
        np.eye(4),
        LIMITS,
        0.2,
        None,
        pose,
        body_length=0.025,
        success_radius=0.05,
        noise=(0.0, 0.0),
        transition=Planar(MotionNoise(0.0, 0.0)),
    )
    agent.reset(context, {}, 0)
    return agent


def seen(scan, goal=(0.8, 0.5)):
    return {"scan": np.asarray(scan, np.float32), "goal": np.array(goal, np.float32)}


def wall_ahead(distance, left, right):
    """Return ranges to a wall ahead of the robot that ends ``left`` and ``right`` of it, m."""
    angle = 2.0 * np.pi * np.arange(BEAMS) / BEAMS
    with np.errstate(divide="ignore"):
        r = distance / np.cos(angle)
    hit = (r > 0.0) & (r * np.sin(angle) < left) & (r * np.sin(angle) > -right)
    return np.where(hit, r, 1.0)


def test_in_the_open_it_drives_straight_to_the_goal_and_stops_there():
    agent = started()
    steps = 0
    while steps < 60:
        decision, steps = agent.act(seen(OPEN)), steps + 1
        if decision.action[2] > 0.5:
            break
        np.testing.assert_allclose(decision.action, [0.0, 0.02, 0.0], atol=1e-6)
    assert decision.status == "arrived"
    assert np.hypot(*(decision.pose[:2] - [0.8, 0.5])) <= 0.3 * 0.05 + 1e-9
    assert steps == 1 + math.ceil((0.6 - 0.015) / 0.02)


@pytest.mark.parametrize(("left", "right", "sign"), [(0.01, 0.4, 1.0), (0.4, 0.01, -1.0)])
def test_it_goes_around_the_nearer_end_of_a_wall(left, right, sign):
    decision = started().act(seen(wall_ahead(0.03, left, right)))
    assert decision.status == "along a wall"
    assert np.sign(decision.action[0]) == sign
    assert decision.action[1] == 0.0  # it turns before it drives


def test_it_turns_towards_the_goal_before_it_drives():
    decision = started(heading=math.pi / 2).act(seen(OPEN))
    np.testing.assert_allclose(decision.action, [-LIMITS[0], 0.0, 0.0], atol=1e-6)


def test_missing_readings_are_not_walls():
    scan = OPEN.copy()
    scan[::3] = 0.0
    assert started().act(seen(scan)).action[1] == pytest.approx(0.02)


def test_an_enclosed_robot_reports_that_it_is_boxed_in():
    decision = started().act(seen(np.full(BEAMS, 0.02)))
    assert decision.status.startswith("boxed in")
    assert decision.action[1] == 0.0


def test_it_leaves_a_wall_only_nearer_to_the_goal_than_it_met_it():
    agent = started()
    agent.act(seen(wall_ahead(0.03, 0.05, 0.4)))
    assert agent.act(seen(OPEN)).status == "along a wall"  # as far from the goal as before, though the way is open
    agent._planar[:2] += [0.1, 0.0]
    assert agent.act(seen(OPEN)).status == "to the goal"
