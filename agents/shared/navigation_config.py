"""Configure a navigator: what a path keeps away from, when to stop, what counts as a failure, how to respond."""

from dataclasses import dataclass, field

from vssm_gym.agents.shared.following import FollowingConfig
from vssm_gym.agents.shared.recovery import IN_KNOWN_MAP, Table
from vssm_gym.agents.shared.trust import LostConfig
from vssm_gym.planning.planners import Planner


@dataclass(frozen=True)
class NavigationConfig:
    """Configure how to plan, when to stop, and when something has failed; lengths in metres."""

    planner: str | Planner = "astar"  # a name of vssm_gym.planning.planners, or any planner
    # Clearance beyond the radius that a path must have, tried in turn; less than none, because surfaces have an error.
    margins: tuple[float, ...] = (0.01, -0.03)
    slack: float = 0.015  # by which following requires less than planning, so that small errors cause no new plan
    gain: float = 0.03  # share of its cost by which a new path must be cheaper to replace one that is still free
    stop_margin: float = 0.01  # inside the success radius, for errors that the estimate's covariance leaves out
    stop_sigmas: float = 2.5  # further inside, in standard deviations of the estimated position
    least_radius: float = 0.05  # the robot stops so near to the goal, however uncertain its estimate is
    landing: float = 0.002  # the path ends so far inside the stop radius; a step that ended short would cost another
    arrival: float = 0.1  # distance at which the end of a detour is reached
    stuck_length: float = 0.4  # length of driving commands over which progress is measured
    stuck_share: float = 0.35  # fraction of it that the estimate must have moved; less means that the robot is stuck
    patience: int = 24  # steps within ``arrival`` of one place, while driving, after which it is stuck, too: 1.5 turns
    # Of the obstacle that is then assumed at the robot's front; it doubles with every time within a reach.
    obstacle_radius: float = 0.03
    obstacle_reach: float = 0.6
    largest_obstacle: float = 0.24
    # Of the obstacle that is assumed where an image has no depth: it is nearer than a depth camera measures.
    blind_distance: float = 0.3
    blind_radius: float = 0.14
    doubted: float = 1.5  # radius within which obstacles are doubted
    most_uncertain: tuple[float, float] = (0.15, 0.15)  # m, rad: standard deviations against the map
    look_first: bool = False  # whether an episode begins with a full turn
    # A bend nearer than the estimate errs would turn the robot back and forth; the test of the step keeps it safe.
    following: FollowingConfig = field(default_factory=lambda: FollowingConfig(bend_passed=0.08))
    lost: LostConfig = field(default_factory=LostConfig)  # when an estimate that is not believed fails the task
    responses: Table = field(default_factory=lambda: IN_KNOWN_MAP)
