"""``no_map``: align each image to the one before, plan with A* on the learned map (SPEC 6; TNP-SM, "no map").

It plans in the same map as ``astar`` but never compares an image with it, so its errors add up.
"""

from dataclasses import dataclass, field

from vssm_gym.agents.base import AgentContext, Decision, Observation
from vssm_gym.agents.localization import FrameLocalizer
from vssm_gym.agents.navigation import NavigationConfig, Navigator


@dataclass(frozen=True)
class NoMapConfig:
    """Settings of the ``no_map`` agent."""

    navigation: NavigationConfig = field(default_factory=NavigationConfig)


class NoMapAgent:
    """Localises against the previous image, plans in the map."""

    name = "no_map"
    needs_pose = False
    needs_map = True

    def __init__(self, config: NoMapConfig | None = None) -> None:
        config = config or NoMapConfig()
        self._navigator = Navigator(FrameLocalizer(), config.navigation)

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> None:
        """Open an episode; the agent draws no random numbers, so ``seed`` changes nothing."""
        self._navigator.reset(context, observation)

    def act(self, observation: Observation) -> Decision:
        """Localise, plan, steer, or stop."""
        return self._navigator.act(observation)
