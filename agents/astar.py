"""``astar``: track the pose in the learned map, plan with A* on it, drive (SPEC 6; TNP-SM, "ours").

Reads RGB-D, its own commands and the map; never the true pose.
"""

from dataclasses import dataclass, field

from vssm_gym.agents.base import AgentContext, Decision, Observation
from vssm_gym.agents.localization import MapLocalizer
from vssm_gym.agents.navigation import NavigationConfig, Navigator


@dataclass(frozen=True)
class AStarConfig:
    """Settings of the ``astar`` agent."""

    navigation: NavigationConfig = field(default_factory=NavigationConfig)


class AStarAgent:
    """Localises against the map, plans in the map."""

    name = "astar"
    needs_pose = False
    needs_map = True

    def __init__(self, config: AStarConfig | None = None) -> None:
        config = config or AStarConfig()
        self._navigator = Navigator(MapLocalizer(), config.navigation)

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> None:
        """Open an episode; the agent draws no random numbers, so ``seed`` changes nothing."""
        self._navigator.reset(context, observation)

    def act(self, observation: Observation) -> Decision:
        """Localise, plan, steer, or stop."""
        return self._navigator.act(observation)
