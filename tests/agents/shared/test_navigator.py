"""Test the navigator in surroundings that follow a script: an open floor, a wall that comes and goes, a lost pose."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.agents.test_agents import ROBOT, context
from vssm_gym.agents.base import AgentContext, Decision, Observation
from vssm_gym.agents.navigation.slam_nav import CONFIG
from vssm_gym.agents.navigation.slam_nav_ablations import SlamNavNoRecoveryAgent
from vssm_gym.agents.shared.following import PlannedPath
from vssm_gym.agents.shared.localization import Localization
from vssm_gym.agents.shared.navigation_config import NavigationConfig
from vssm_gym.agents.shared.navigator import BLIND, NO_ROOM, Navigator
from vssm_gym.agents.shared.recovery import IN_OWN_MAP, Failure
from vssm_gym.agents.shared.route import Detour
from vssm_gym.agents.shared.surroundings import Terrain
from vssm_gym.envs.robots import NOISE_LEVELS, execute
from vssm_gym.inference.status import Status
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.clearance import ClearanceMap

RESOLUTION, SIDE = 0.05, 100  # m, cells: 5 m
START, GOAL = np.array([1.0, 2.5, 0.0]), np.array([4.0, 2.5])
NOTHING = np.empty((0, 2))


def floor(wall: bool) -> ClearanceMap:
    """Return the clearance of an open floor, or of one that a wall at x = 2.5 m cuts in two."""
    occupied = np.ones((SIDE, SIDE), bool)
    occupied[1:-1, 1:-1] = False
    if wall:
        occupied[SIDE // 2] = True
    field = np.where(occupied, 0.5, -0.5) * RESOLUTION
    return ClearanceMap.from_occupancy(field, np.zeros(2), RESOLUTION)


OPEN, CUT = floor(False), floor(True)


class Scripted:
    """Move the robot exactly, and say at each step whether it is lost, what the floor is like and what has changed."""

    map: VoxelMap  # none is needed

    def __init__(self, lost=(), wall=lambda k: False, changed=lambda k: NOTHING, blind=(), full=False, opens=0) -> None:
        self.lost, self.wall, self.changed, self.blind, self.is_full = lost, wall, changed, blind, full
        self.looks, self.met, self.opens, self.open = 0, [], opens, 0  # looks for which a doubted wall is gone

    def reset(self, context: AgentContext, observation: Observation) -> Localization:
        self.planar, self.k, self.frame = np.array(context.start_pose), 0, context.direction_frame
        return Localization(self.planar.copy(), np.zeros(3), Status.OK)

    def update(self, command: np.ndarray, observation: Observation) -> Localization:
        self.k += 1
        command = np.asarray(command, float)
        if self.frame == "world":
            command = command - [0.0, self.planar[2] + command[0], 0.0]
        self.planar = execute(self.planar, command, NOISE_LEVELS["none"], np.random.default_rng(0))
        lost = sum(1 for k in self.lost if k <= self.k) if self.k in self.lost else 0
        return Localization(self.planar.copy(), np.zeros(3), Status.LOST if lost else Status.OK, lost)

    def look(self, planar: np.ndarray, goal: np.ndarray) -> Terrain:
        self.looks += 1
        space = CUT if self.wall(self.k) and not self.open else OPEN
        self.open = max(0, self.open - 1)
        return Terrain(space, space, self.changed(self.k))

    def around(self, planar: np.ndarray) -> ClearanceMap:
        return OPEN

    def sees_ahead(self) -> bool:
        return self.k not in self.blind

    def meet(self, xy: np.ndarray, radius: float) -> None:
        self.met.append(np.array(xy))

    def doubt(self, xy: np.ndarray, radius: float) -> bool:
        self.open = self.opens
        return True


def run(
    surroundings: Scripted, config: NavigationConfig, steps: int = 200, start: np.ndarray = START, **changes
) -> list[Decision]:
    """Return the decisions of a drive to the goal."""
    navigator, observation = Navigator(surroundings, config), {"goal": GOAL}
    navigator.reset(replace(context(None, start), **changes), observation, 0)
    decisions = []
    for _ in range(steps):
        decisions.append(navigator.act(observation))
        if decisions[-1].action[3] > 0.5:
            break
    return decisions


def test_it_arrives():
    decisions = run(Scripted(), NavigationConfig())
    assert decisions[-1].status.startswith("arrived")


def test_a_look_around_that_a_lost_pose_interrupts_goes_on():
    """It sees every direction before it drives, though it was lost over four steps of its first turn."""
    surroundings = Scripted(lost=range(5, 9))
    decisions = run(surroundings, CONFIG)
    activities = [decision.status.split(";")[0] for decision in decisions]
    assert activities[0] == "looking around first"
    assert activities[5].startswith("looking around: lost")
    assert activities[12] == "looking around first"
    first = next(k for k, decision in enumerate(decisions) if decision.action[2] > 0.0)
    seen = np.mod([decision.pose[2] for decision in decisions[:first]], 2.0 * math.pi)
    angles = np.sort(seen)
    assert np.diff([*angles, angles[0] + 2.0 * math.pi]).max() < 0.5 * math.pi
    assert decisions[-1].status.startswith("arrived")


def test_it_goes_on_too_where_the_robot_ran_out_of_responses():
    decisions = run(Scripted(lost=range(5, 80)), CONFIG, steps=300)
    activities = [decision.status.split(";")[0] for decision in decisions]
    assert activities[79] == "looking around: lost"
    assert activities[80] == "looking around first"


def test_without_recovery_a_lost_robot_gives_up():
    decisions = run(Scripted(lost=range(5, 200)), SlamNavNoRecoveryAgent.navigation)
    assert decisions[-1].gives_up
    assert len(decisions) == 16  # ten steps by the commands


def test_what_has_changed_may_end_a_detour():
    """No cell of the detour's ellipse has changed, but one elsewhere: the plan to the goal is made anew."""
    for changed in (NOTHING, np.array([[1.0, 4.5]])):
        surroundings = Scripted(changed=lambda k, changed=changed: changed)
        navigator = Navigator(surroundings, NavigationConfig())
        navigator.reset(context(None, START), {"goal": GOAL}, 0)
        route = navigator._task.route
        route.detour = Detour(np.array([1.0, 1.0]), 0.0)
        route.path = PlannedPath(np.array([START[:2], route.detour.end]), OPEN, 0.01)
        navigator.act({"goal": GOAL})
        assert (route.detour is None) == bool(len(changed))


def test_one_step_is_no_progress():
    """A wall that is doubted comes back after a step: the row of responses ends, and does not begin anew."""
    surroundings = Scripted(wall=lambda k: True, opens=4)
    row = len(IN_OWN_MAP[Failure.NO_PATH])
    decisions = run(surroundings, replace(CONFIG, look_first=False), steps=400)
    assert decisions[-1].gives_up
    assert len(decisions) < 50 * row


@pytest.mark.parametrize("full", [False, True])
def test_a_full_map_is_named_where_no_path_is_found(full):
    decisions = run(Scripted(wall=lambda k: True, full=full), NavigationConfig())
    assert decisions[-1].gives_up
    assert (NO_ROOM in decisions[-1].status) == full


@pytest.mark.parametrize("frame", ["body", "world"])
def test_what_cannot_be_seen_is_in_the_way_of_the_step_that_was_not_taken(frame):
    start = np.array([4.0, 1.0, 0.0])  # it has to turn by a right angle first
    surroundings = Scripted(blind=range(1, 200))
    decisions = run(surroundings, NavigationConfig(), start=start, direction_frame=frame, steps=20)
    k = next(k for k, decision in enumerate(decisions) if BLIND in decision.status)
    ahead = np.array(surroundings.met) - decisions[k].pose[:2]
    assert len(ahead) > 1
    assert np.abs(np.arctan2(ahead[:, 1], ahead[:, 0]) - 0.5 * math.pi).max() < 0.3


@pytest.mark.parametrize("config", [NavigationConfig(), CONFIG])
def test_a_robot_that_never_sees_ahead_is_stuck_and_gives_up(config):
    """It tries the responses to that, though no step is ever commanded along its path."""
    decisions = run(Scripted(blind=range(1000)), config, steps=500)
    assert decisions[-1].gives_up
    assert "stuck" in decisions[-1].status
    assert BLIND in decisions[-1].responses


def test_a_plan_is_made_before_the_first_step():
    surroundings = Scripted()
    navigator = Navigator(surroundings, CONFIG)
    navigator.reset(context(None, START), {"goal": GOAL}, 0)
    assert surroundings.looks == 1
    assert ROBOT.limits[0] == pytest.approx(navigator.act({"goal": GOAL}).action[0])
