"""``dead_reckoning``: integrate the commands, plan with A* on the learned map (SPEC 6; TNP-SM, "dynamics").

It plans in the same map as ``astar`` and looks at no image at all.
"""

from dataclasses import dataclass, field

from vssm_gym.agents.base import AgentContext, Decision, Observation
from vssm_gym.agents.localization import DeadReckoning
from vssm_gym.agents.navigation import NavigationConfig, Navigator


@dataclass(frozen=True)
class DeadReckoningConfig:
    """Settings of the ``dead_reckoning`` agent."""

    navigation: NavigationConfig = field(default_factory=NavigationConfig)


class DeadReckoningAgent:
    """Localises by its own commands, plans in the map."""

    name = "dead_reckoning"
    needs_pose = False
    needs_map = True

    def __init__(self, config: DeadReckoningConfig | None = None) -> None:
        config = config or DeadReckoningConfig()
        self._navigator = Navigator(DeadReckoning(), config.navigation)

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> None:
        """Open an episode; the agent draws no random numbers, so ``seed`` changes nothing."""
        self._navigator.reset(context, observation)

    def act(self, observation: Observation) -> Decision:
        """Localise, plan, steer, or stop."""
        return self._navigator.act(observation)
