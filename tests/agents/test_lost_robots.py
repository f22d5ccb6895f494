"""Test agents whose camera fails: they say so, never arrive where they are not, and give up in the end.

The world is that of ``test_agents``: images are rendered from the map, and the robot moves with low noise.
"""

from collections.abc import Callable, Mapping
from itertools import groupby

import numpy as np
import pytest

from tests.agents.test_agents import LOW, context, learned, observe
from vssm_gym.agents.base import Decision
from vssm_gym.agents.registry import AGENTS
from vssm_gym.agents.shared.trust import LostConfig
from vssm_gym.envs.robots import execute
from vssm_gym.eval.faults.navigation import SILENT_STEPS
from vssm_gym.maps.voxel_map import VoxelMap

__all__ = ["learned"]  # the fixture

START, GOAL = np.array([1.0, 1.0, 1.0]), np.array([4.3, 0.6])
FROM = 8  # step of the first faulty image
NEAR = 0.4  # m, the success radius
Images = list[Mapping[str, np.ndarray]]
Fault = Callable[[int, Images], Mapping[str, np.ndarray]]


def run(name: str, world: VoxelMap, fault: Fault, carried: np.ndarray | None = None, steps: int = 110):
    """Drive with a fault; the robot is at ``carried`` after step ``FROM``. Return decisions and errors, m."""
    rng, planar, agent = np.random.default_rng(0), START, AGENTS[name]()
    images: Images = [observe(planar, GOAL, world)]
    agent.reset(context(world, planar), images[0], 0)
    decisions: list[Decision] = []
    errors: list[float] = []
    for k in range(1, steps):
        decisions.append(agent.act(fault(k - 1, images)))
        errors.append(float(np.hypot(*(decisions[-1].pose[:2] - planar[:2]))))
        if decisions[-1].action[3] > 0.5:
            break
        planar = execute(planar, decisions[-1].action[:3], LOW, rng)
        planar = carried if carried is not None and k == FROM else planar
        images.append(observe(planar, GOAL, world))
    return decisions, errors, float(np.hypot(*(planar[:2] - GOAL)))


def frozen(steps: int) -> Fault:
    return lambda k, images: images[FROM - 1] if FROM <= k < FROM + steps else images[-1]


def dark(k: int, images: Images) -> Mapping[str, np.ndarray]:
    last = images[-1]
    return last if k < FROM else {**last, "rgb": np.zeros_like(last["rgb"]), "depth": np.zeros_like(last["depth"])}


@pytest.mark.slow
def test_images_that_freeze_for_a_while_are_noticed_and_bridged(learned):
    """The robot stands while its camera is frozen; then the images fit where its commands have led it."""
    decisions, errors, away = run("astar", learned, frozen(20))
    flagged = [k for k, decision in enumerate(decisions) if "frozen images" in decision.status]
    assert flagged[0] <= FROM + 6
    assert flagged[-1] == FROM + 19
    assert decisions[-1].status.startswith("arrived")
    assert away <= NEAR
    assert errors[-1] < 0.1


@pytest.mark.parametrize("name", ["astar", "no_map"])
@pytest.mark.parametrize("fault", [frozen(10**6), dark], ids=["frozen", "dark"])
def test_a_camera_that_fails_for_good_ends_the_task(name, fault, learned):
    decisions, _, _ = run(name, learned, fault)
    assert decisions[-1].status.startswith("gave up: lost")
    assert decisions[-1].gives_up
    assert len(decisions) <= FROM + 6 + LostConfig().give_up + 1
    assert not any(decision.status.startswith("arrived") for decision in decisions)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["astar", "no_map"])
def test_a_robot_that_is_carried_off_says_that_it_is_lost(name, learned):
    """Behind the wall, turned round: it says so at once, soon after each false fit, and claims no arrival elsewhere."""
    decisions, errors, away = run(name, learned, frozen(0), carried=np.array([4.5, 2.5, -2.0]))
    assert "lost" in decisions[FROM].status
    assert not decisions[-1].status.startswith("arrived") or away <= NEAR
    wrong = [e > NEAR and "localization: ok" in d.status for e, d in zip(errors, decisions, strict=True)]
    assert max((len(list(steps)) for bad, steps in groupby(wrong) if bad), default=0) <= SILENT_STEPS


@pytest.mark.slow
def test_a_robot_that_is_carried_off_finds_itself_in_all_of_the_map(learned):
    """From the first room into the other, turned round: its estimate is right again, and it arrives."""
    decisions, errors, away = run("astar", learned, frozen(0), carried=np.array([3.1, 1.9, -2.0]))
    assert "lost" in decisions[FROM].status
    assert decisions[-1].status.startswith("arrived")
    assert away <= NEAR
    assert errors[-1] < 0.1


@pytest.mark.slow
def test_a_start_pose_that_is_wrong_is_corrected(learned):
    """The robot is told that it starts in the other room."""
    agent, planar, rng = AGENTS["astar"](), START, np.random.default_rng(0)
    agent.reset(context(learned, np.array([3.2, 2.2, -2.0])), observe(planar, GOAL, learned), 0)
    for _ in range(90):
        decision = agent.act(observe(planar, GOAL, learned))
        if decision.action[3] > 0.5:
            break
        planar = execute(planar, decision.action[:3], LOW, rng)
    assert decision.status.startswith("arrived")
    assert np.hypot(*(planar[:2] - GOAL)) <= NEAR
