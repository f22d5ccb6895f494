"""Take one thing from ``slam_nav`` at a time, to measure its effect, and compare it with a classical explorer.

All of them are :class:`~vssm_gym.agents.navigation.slam_nav.SlamNavAgent`'s navigator on a growing map, with another
setting. Described in ``docs/agents/navigation.md``.
"""

import math
from dataclasses import replace

from vssm_gym.agents.navigation.slam_nav import CONFIG
from vssm_gym.agents.shared.mapping import MapAndPose, MapAtObservedPose
from vssm_gym.agents.shared.navigation_config import NavigationConfig
from vssm_gym.agents.shared.navigator import Navigator
from vssm_gym.agents.shared.recovery import IN_OWN_MAP, WITHOUT, Failure, Response
from vssm_gym.agents.shared.surroundings import GrowingMap
from vssm_gym.agents.shared.trust import LostConfig
from vssm_gym.planning.traversability import TraversabilityConfig

KNOWN_SPACE = TraversabilityConfig(unknown=math.inf)
# No clearance for what the noise of a step may do, a stop at the rim, and an estimate that is certain enough always.
WITHOUT_UNCERTAINTY = replace(
    CONFIG,
    stop_sigmas=0.0,
    most_uncertain=(math.inf, math.inf),
    following=replace(CONFIG.following, sigmas=0.0),
)
EXPLORE_FIRST = replace(
    CONFIG,
    responses={**IN_OWN_MAP, Failure.NO_PATH: (Response.EXPLORE, Response.TURN_AROUND, Response.LOOK_AGAIN)},
)


class SlamNavTruePoseAgent:
    """Build the map at the true pose: what localisation costs."""

    name = "slam_nav_true_pose"
    robot = "holonomic"
    task = "pointgoal"
    navigation = CONFIG
    needs_pose = True
    needs_map = False

    def __init__(self, config: NavigationConfig = CONFIG) -> None:
        navigator = Navigator(GrowingMap(MapAtObservedPose()), config)
        self.reset, self.act = navigator.reset, navigator.act


class SlamNavKnownSpaceAgent:
    """Plan through known space alone: unknown space is as good as occupied."""

    name = "slam_nav_known_space"
    robot = "holonomic"
    task = "pointgoal"
    navigation = CONFIG
    needs_pose = False
    needs_map = False

    def __init__(self, config: NavigationConfig = CONFIG) -> None:
        navigator = Navigator(GrowingMap(MapAndPose(), KNOWN_SPACE), config)
        self.reset, self.act = navigator.reset, navigator.act


class SlamNavNoRecoveryAgent:
    """Give up at the first failure; where it is lost, after ten steps by the commands alone."""

    name = "slam_nav_no_recovery"
    robot = "holonomic"
    task = "pointgoal"
    navigation = replace(CONFIG, responses=WITHOUT, lost=LostConfig(coast=10, give_up=10))
    needs_pose = False
    needs_map = False

    def __init__(self, config: NavigationConfig = navigation) -> None:
        navigator = Navigator(GrowingMap(MapAndPose()), config)
        self.reset, self.act = navigator.reset, navigator.act


class SlamNavNoUncertaintyAgent:
    """Take estimates and steps for exact: no distance is kept for what noise and a wrong estimate may do."""

    name = "slam_nav_no_uncertainty"
    robot = "holonomic"
    task = "pointgoal"
    navigation = WITHOUT_UNCERTAINTY
    needs_pose = False
    needs_map = False

    def __init__(self, config: NavigationConfig = WITHOUT_UNCERTAINTY) -> None:
        navigator = Navigator(GrowingMap(MapAndPose(), TraversabilityConfig(deviations=0.0)), config)
        self.reset, self.act = navigator.reset, navigator.act


class FrontierNavAgent:
    """Drive to the frontier that is nearest on the way to the goal, until known space leads to the goal."""

    name = "frontier_nav"
    robot = "holonomic"
    task = "pointgoal"
    navigation = EXPLORE_FIRST
    needs_pose = False
    needs_map = False

    def __init__(self, config: NavigationConfig = EXPLORE_FIRST) -> None:
        navigator = Navigator(GrowingMap(MapAndPose(), KNOWN_SPACE), config)
        self.reset, self.act = navigator.reset, navigator.act
