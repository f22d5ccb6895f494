"""Explore an apartment that nobody has mapped until the map shows where the goal's image was taken, and drive there.

``slam_image`` reads RGB-D, its own commands and the goal's image. It drives as ``slam_nav`` in the map that PRISM
builds, from frontier to frontier, and searches that map for the image at every step
(:class:`~vssm_gym.agents.shared.searching.picture_search.PictureSearch`). Where a pose explains the image it drives
there, turns to where the image should have looked, and compares the image with the camera's. Described in
``docs/agents/navigation.md``.
"""

import math
import time
from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np

from vssm_gym.agents.base import STOP_COMMAND, AgentContext, Decision, Observation
from vssm_gym.agents.navigation.slam_nav import CONFIG as SLAM_NAV
from vssm_gym.agents.shared.frontier_gain import FrontierGain, FrontierGainConfig
from vssm_gym.agents.shared.manoeuvres import Turn
from vssm_gym.agents.shared.map_index import rig_of
from vssm_gym.agents.shared.mapping import MapAndPose
from vssm_gym.agents.shared.navigation_config import NavigationConfig
from vssm_gym.agents.shared.navigator import NO_ROOM, Navigator
from vssm_gym.agents.shared.recovery import IN_OWN_MAP, Failure, Response
from vssm_gym.agents.shared.searching.frontier_goals import FrontierGoals
from vssm_gym.agents.shared.searching.picture_matches import Match
from vssm_gym.agents.shared.searching.picture_search import PictureSearch, PictureSearchConfig
from vssm_gym.agents.shared.searching.unseen_views import UnseenViews, UnseenViewsConfig
from vssm_gym.agents.shared.surroundings import GrowingMap
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD
from vssm_gym.planning.floor_plan import FloorPlan

# Where no path leads to a place there are others to drive to.
# A turn by a radian takes as long as 0.8 m of driving, and unseen views show what lies behind small frontiers.
FRONTIERS = FrontierGainConfig(decay=0.7, turn=0.8, least=0.5, hazard=(0.25, 3.0))
ARC = 1.0  # rad off its path, up to which it drives as it turns: its time is short, and not its path
CONFIG = replace(
    SLAM_NAV,
    responses={**IN_OWN_MAP, Failure.NO_PATH: (Response.LOOK_AGAIN,)},
    following=replace(SLAM_NAV.following, arc=ARC),
)


@dataclass(frozen=True)
class ImageGoalConfig:
    """Configure the search, and which of its matches are believed; lengths in metres."""

    search: PictureSearchConfig = field(default_factory=PictureSearchConfig)
    frontiers: FrontierGainConfig = FRONTIERS
    near: float = 0.25  # radius around a place within which the robot stops: matches err, too
    views: UnseenViewsConfig = field(default_factory=UnseenViewsConfig)
    # Likelihood (nats a pixel that the map shows) and correlation of image and map, for which exploration is
    # interrupted; and the same where nothing is left to explore.
    clear: tuple[float, float] = (3.5, 0.6)
    doubtful: tuple[float, float] = (2.0, 0.5)
    share: float = 0.4  # of the image that the map shows
    corrections: int = 3  # drives at most to a match that was aligned anew at its place
    most_turns: int = 40  # steps of turning at a place: a noisy robot may not get nearer


class SlamImageAgent:
    """Localise, map, explore, and search the map for the goal's image."""

    name = "slam_image"
    robot = "holonomic"
    task = "imagegoal"
    navigation = CONFIG
    needs_pose = False
    needs_map = False

    def __init__(self, config: NavigationConfig = CONFIG, images: ImageGoalConfig | None = None) -> None:
        self._config = images or ImageGoalConfig()
        self._surroundings = GrowingMap(MapAndPose())
        self._navigator = Navigator(self._surroundings, config)
        self._frontiers = FrontierGoals(FrontierGain(self._config.frontiers), config.margins)
        self.plan: FloorPlan | None = None  # of the last step on which the pose was known

    @property
    def map(self) -> VoxelMap:
        """Return the belief over the apartment, world frame; it is valid until the next step."""
        return self._surroundings.map

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> None:
        """Open an episode; one step of the search is made and dropped, so that compiling it delays no later one."""
        self._context = replace(context, success_radius=min(self._config.near, context.success_radius))
        self._place, self._turns = np.asarray(context.start_pose, np.float64)[:2], 0
        self._navigator.reset(self._context, self._with_goal(observation), seed)
        self._frontiers.reset(self._context, seed)
        self._look_for(observation["goal_rgb"])
        start = np.asarray(context.start_pose, np.float64)
        self._search.step(self.map, self._surroundings.floor_plan())
        self._search.align(self.map, [start])
        self._search.agrees(RGBD.from_camera(observation["rgb"], observation["depth"]), start, start)
        self._look_for(observation["goal_rgb"])

    def _look_for(self, goal_rgb: np.ndarray) -> None:
        """Begin the search for an image."""
        self._goal_rgb = np.array(goal_rgb)
        self._search = PictureSearch(self._config.search, self._context, goal_rgb.astype(np.float32) / 255.0)
        self._views = UnseenViews(self._config.views, rig_of(self._context).camera)
        self._match: Match | None = None  # that is driven to
        self._corrections = 0  # drives to it after it was aligned anew
        self._responses: Counter[str] = Counter()  # of this image's drives before the present one

    def act(self, observation: Observation) -> Decision:
        """Drive to a pose that explains the image, or explore."""
        if not np.array_equal(observation["goal_rgb"], self._goal_rgb):
            self._look_for(observation["goal_rgb"])
            self._frontiers.leave()
            self._place, self._turns = self._navigator.estimate.planar[:2].copy(), 0  # a drive that ends at once
        decision = self._navigator.act(self._with_goal(observation))
        if self._navigator.estimate.lost:
            return self._completed(decision, decision.gives_up)
        began = time.perf_counter()
        self.plan = plan = self._surroundings.floor_plan()
        self._search.step(self.map, plan)
        decision.latency["search"] = time.perf_counter() - began
        # Where the robot has begun to turn it has arrived, however its estimate changes by turning.
        ended = bool(decision.action[3] > 0.5) or self._turns > 0
        c = self._config
        if (best := self._search.matches.best(*c.clear, c.share, than=self._match)) is not None:
            self._corrections = 0
            decision = self._drive_to(best, decision)
        elif self._match is not None:
            decision = self._at_match(decision, observation) if ended else decision
        elif ended or self._frontiers.is_seen(plan) or self._views.is_seen(self._search.places, self._search.shares):
            decision = self._at_viewpoint(decision, plan, ended)
        return self._completed(decision, decision.status.startswith(NOWHERE))

    # --- at the end of a drive

    def _at_match(self, decision: Decision, observation: Observation) -> Decision:
        """Turn to where the image should have looked, and compare; explore on where it shows something else."""
        match, c = self._match, self._config
        assert match is not None
        if not decision.gives_up:
            if (command := self._turned(float(match.planar[2]))) is not None:
                return self._instead(decision, command, "turns to where the image looked")
            again = self._search.align(self.map, [match.planar])
            image = RGBD.from_camera(observation["rgb"], observation["depth"])
            if again and self._search.agrees(image, self._navigator.estimate.planar, again[0].planar):
                away = math.hypot(*(again[0].planar[:2] - self._navigator.estimate.planar[:2]))
                if away <= c.near:
                    return self._arrived(decision)
                if self._corrections < c.corrections:
                    self._corrections += 1
                    return self._drive_to(again[0], decision)
        self._search.matches.refute(match)
        self._match = None
        return self._explore(decision)

    def _at_viewpoint(self, decision: Decision, plan: FloorPlan, ended: bool) -> Decision:
        """Look at what the robot has driven to see, and choose the next place."""
        if ended:
            heading = self._frontiers.heading(self._navigator.estimate.planar)
            heading = heading if self._views.chosen is None else float(self._views.chosen[2])
            if not (decision.gives_up or heading is None) and (command := self._turned(heading)) is not None:
                return self._instead(decision, command, "looks at what is unknown")
            self._views.close()
            self._frontiers.dismiss(plan, reached=not decision.gives_up)
        return self._explore(decision)

    def _explore(self, decision: Decision) -> Decision:
        """Drive to the next frontier, else to an unseen view, else to the best match that is left; or give up."""
        assert self.plan is not None
        estimate, search = self._navigator.estimate, self._search
        place = self._frontiers.choose(self.map, self.plan, estimate)
        if place is None and self._frontiers.roadmap is not None:
            place = self._views.choose(search.places, search.shares, self._frontiers.roadmap, estimate.planar)
        if place is not None:
            return self._goto(place, decision)
        if (best := self._search.matches.best(*self._config.doubtful, self._config.share)) is not None:
            self._corrections = 0
            return self._drive_to(best, decision)
        if not search.is_done:
            return self._instead(decision, np.zeros(3), "compares what it has seen")
        status = f"{NOWHERE}; {NO_ROOM}" if self._surroundings.is_full else NOWHERE
        return replace(decision, action=np.array([*STOP_COMMAND, 1.0], np.float32), status=status)

    # --- the next drive

    def _drive_to(self, match: Match, decision: Decision) -> Decision:
        self._match = match
        self._frontiers.leave()
        self._views.chosen = None
        return self._goto(match.planar[:2], decision)

    def _goto(self, place: np.ndarray, decision: Decision) -> Decision:
        """Return the decision that drives to a place ``(2,)``, m; one that ends there at once is for the next step."""
        self._place, self._turns = np.array(place, np.float64), 0
        self._responses += Counter(decision.responses)
        new = self._navigator.redirected(self._place)
        planning = decision.latency["planning"] + new.latency["planning"]
        new = replace(new, latency={**decision.latency, "planning": planning})
        return self._instead(new, np.zeros(3), "chooses another place") if new.action[3] > 0.5 else new

    def _with_goal(self, observation: Observation) -> dict[str, np.ndarray]:
        return {**observation, "goal": self._place}

    def _arrived(self, decision: Decision) -> Decision:
        status = f"arrived; localization: {self._navigator.estimate.status}"
        return replace(decision, action=np.array([*STOP_COMMAND, 1.0], np.float32), status=status)

    def _turned(self, heading: float) -> np.ndarray | None:
        """Return the turn to a heading; None where the robot has it, or has turned for long enough."""
        self._turns += 1
        turn = Turn([heading], float(self._context.limits[0]))
        return None if self._turns > self._config.most_turns else turn.command(self._navigator.estimate.planar)

    def _instead(self, decision: Decision, command: np.ndarray, activity: str) -> Decision:
        """Return the decision with another command."""
        self._navigator.instead(command)
        return replace(decision, action=np.array([*command, 0.0], np.float32), status=f"{activity}; {decision.status}")

    def _completed(self, decision: Decision, gives_up: bool) -> Decision:
        """Return the decision with the responses to failures of all drives so far."""
        what = "exploring" if self._match is None else "driving to a match"
        status = decision.status if decision.action[3] > 0.5 else f"{what}: {decision.status}"
        responses = self._responses + Counter(decision.responses)
        return replace(decision, status=status, gives_up=gives_up, responses=dict(responses))


NOWHERE = "gave up: all that can be reached has been explored, and nothing looks like the image"
