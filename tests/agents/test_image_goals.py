"""Test agents whose goal is an image: they find where it was taken, drive there, and tell look-alikes apart there."""

import numpy as np
import pytest

from tests.agents.test_agents import CAMERA, LOW, context, learned, observe
from tests.helpers.planning_worlds import APART, twin_rooms
from vssm_gym.agents.navigation.astar_image import AStarImageAgent
from vssm_gym.envs.robots import execute
from vssm_gym.maps.voxel_map import VoxelMap

__all__ = ["learned"]  # the fixture

NEAR = 0.4  # m, the success radius


def seen(planar: np.ndarray, taken: np.ndarray, m: VoxelMap) -> dict[str, np.ndarray]:
    """Return the observation of ImageNav: the camera's image, and the colours seen from the goal."""
    observation = observe(planar, planar[:2], m)
    del observation["goal"], observation["pose"]
    return observation | {"goal_rgb": observe(taken, planar[:2], m)["rgb"]}


def drive(m: VoxelMap, start: np.ndarray, taken: np.ndarray, steps: int = 120):
    """Drive to where an image was taken; return agent, decisions and the true pose at the end."""
    rng, planar, agent = np.random.default_rng(0), start, AStarImageAgent()
    agent.reset(context(m, start), seen(planar, taken, m), 0)
    decisions = []
    for _ in range(steps):
        decisions.append(agent.act(seen(planar, taken, m)))
        if decisions[-1].action[3] > 0.5:
            break
        planar = execute(planar, decisions[-1].action[:3], LOW, rng)
    return decisions, planar


@pytest.mark.parametrize("taken", [(4.3, 0.6, 2.5), (0.8, 2.2, -0.8), (3.0, 2.0, -2.4)])
def test_the_robot_drives_to_where_the_image_was_taken(taken, learned):
    decisions, planar = drive(learned, np.array([1.0, 1.0, 1.0]), np.array(taken))
    assert decisions[-1].status.startswith("arrived")
    assert np.hypot(*(planar[:2] - np.array(taken)[:2])) <= NEAR


def test_a_goal_that_shows_nothing_is_no_error(learned):
    agent, start = AStarImageAgent(), np.array([1.0, 1.0, 1.0])
    observation = seen(start, start, learned) | {"goal_rgb": np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)}
    agent.reset(context(learned, start), observation, 0)
    assert agent.act(observation).action.shape == (4,)


def test_places_out_of_reach_are_given_up_for_the_next_one():
    """Two equal rooms without a door between them: whichever is likelier, the robot stops in its own."""
    m = twin_rooms(differ=False)
    start, taken = np.array([1.9, 1.7, 0.0]), np.array([0.9, 1.0, -0.6])
    for shift in (0.0, APART):
        here = np.array([shift, 0.0, 0.0])
        decisions, planar = drive(m, start + here, taken + here)
        assert decisions[-1].action[3] > 0.5
        assert np.hypot(*(planar[:2] - (taken + here)[:2])) <= NEAR
