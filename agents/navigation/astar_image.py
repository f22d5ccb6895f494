"""Find the place of the goal's image in the learned map, and drive there (image goals: Zhu et al., ICRA 2017).

``astar_image`` reads RGB-D, its own commands, the map and the goal's image. The image's pose is found by comparing its
colours with all of the map (:mod:`vssm_gym.inference.relocalisation`); driving is that of ``astar``. It drives to the
likeliest place, turns to where the image should have looked, and compares; where the camera shows something else it
drives to the next one. Described in ``docs/agents/navigation.md``.
"""

import math
from collections import Counter
from dataclasses import replace

import numpy as np

from vssm_gym.agents.base import STOP_COMMAND, AgentContext, Decision, Observation
from vssm_gym.agents.shared.localization import FilteredPose
from vssm_gym.agents.shared.map_index import MapIndex
from vssm_gym.agents.shared.navigation_config import NavigationConfig
from vssm_gym.agents.shared.navigator import Navigator
from vssm_gym.agents.shared.surroundings import KnownMap
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.model.emission import RGBD

CONFIG = NavigationConfig()
SAME_VIEW = 0.1  # rad: the robot looks where the goal's image did
MOST_TURNS = 40  # steps of turning there: a noisy robot may not get nearer


class AStarImageAgent:
    """Localise the goal's image and the robot against the map, plan in the map."""

    name = "astar_image"
    robot = "holonomic"
    task = "imagegoal"
    navigation = CONFIG
    needs_pose = False
    needs_map = True

    def __init__(self, config: NavigationConfig = CONFIG) -> None:
        self._index = MapIndex()
        self._places: list[np.ndarray] = []  # poses where the goal's image may have been taken, the likeliest first
        self._goal_rgb = np.empty(0, np.uint8)
        self._turns = 0  # steps of turning at the present place
        self._responses: Counter[str] = Counter()  # of the drives to places that were not the image's
        self._navigator = Navigator(KnownMap(FilteredPose("tracker", self._index)), config)

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> None:
        """Find the goal's image in the map, and open the episode."""
        self._context = context
        self._look_for(observation["goal_rgb"])
        self._navigator.reset(context, self._with_goal(observation), seed)

    def act(self, observation: Observation) -> Decision:
        """Drive to the likeliest place of the image, compare there, and go on to the next one, or give up."""
        if not np.array_equal(observation["goal_rgb"], self._goal_rgb):
            self._look_for(observation["goal_rgb"])
        decision = self._navigator.act(self._with_goal(observation))
        decision = replace(decision, responses=dict(self._responses + Counter(decision.responses)))
        if not self._places:
            stop = np.array([*STOP_COMMAND, 1.0], np.float32)
            return replace(decision, action=stop, status=f"{NOWHERE}; {decision.status}", gives_up=True)
        if not self._has_ended(decision):
            return decision
        command = None if decision.gives_up else self._turn()
        if command is None:
            if not decision.gives_up and self._is_here(observation):
                return decision
            if decision.gives_up and len(self._places) == 1:
                return decision
            self._responses = Counter(decision.responses)
            self._places, self._turns, command = self._places[1:], 0, np.zeros(3)
        self._navigator.instead(command)
        action = np.array([*command, 0.0], np.float32)
        return replace(
            decision, action=action, status=f"comparing with the goal's image; {decision.status}", gives_up=False
        )

    def _look_for(self, goal_rgb: np.ndarray) -> None:
        """Keep the poses where the goal's image may have been taken."""
        found = self._index.relocaliser(self._context).find_picture(goal_rgb.astype(np.float32) / 255.0)
        self._places = [one.planar for one in found.hypotheses]
        self._goal_rgb, self._turns, self._responses = np.array(goal_rgb), 0, Counter()

    def _with_goal(self, observation: Observation) -> dict[str, np.ndarray]:
        """Return the observation with the place to drive to; the start where none is left."""
        place = self._places[0] if self._places else np.asarray(self._context.start_pose, np.float64)
        return {**observation, "goal": place[:2]}

    def _has_ended(self, decision: Decision) -> bool:
        """Return True where the robot has arrived, or found no path; a lost robot can compare nothing."""
        return bool(decision.action[3] > 0.5) and not self._navigator.estimate.lost

    def _turn(self) -> np.ndarray | None:
        """Return the turn to where the goal's image should have looked; None where the robot looks there."""
        off = float(wrap_angle(self._places[0][2] - self._navigator.estimate.planar[2]))
        most = float(self._context.limits[0])
        self._turns += 1
        if abs(off) < SAME_VIEW or self._turns > MOST_TURNS:
            return None
        return np.array([math.copysign(min(abs(off), most), off), 0.0, 0.0])

    def _is_here(self, observation: Observation) -> bool:
        """Return True if the camera's image agrees with the goal's."""
        image = RGBD.from_camera(observation["rgb"], observation["depth"])
        planar = self._navigator.estimate.planar
        picture = self._goal_rgb.astype(np.float32) / 255.0
        return self._index.relocaliser(self._context).shows_picture(image, planar, picture, self._places[0])


NOWHERE = "gave up: nothing in the map looks like the image"
