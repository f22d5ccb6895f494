"""``oracle``: the true pose, and A* on the learned map: what perfect localisation would reach (SPEC 6).

The only agent that reads ``observation["pose"]``; map, planner and controller are those of ``astar``.
"""

from dataclasses import dataclass, field

from vssm_gym.agents.base import AgentContext, Decision, Observation
from vssm_gym.agents.localization import TruePose
from vssm_gym.agents.navigation import NavigationConfig, Navigator


@dataclass(frozen=True)
class OracleConfig:
    """Settings of the ``oracle`` agent."""

    # The pose is certain but for its rounding to float32, so it stops at the very rim.
    navigation: NavigationConfig = field(default_factory=lambda: NavigationConfig(stop_margin=0.002))


class OracleAgent:
    """Knows the true pose, plans in the map."""

    name = "oracle"
    needs_pose = True
    needs_map = True

    def __init__(self, config: OracleConfig | None = None) -> None:
        config = config or OracleConfig()
        self._navigator = Navigator(TruePose(), config.navigation)

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> None:
        """Open an episode; the agent draws no random numbers, so ``seed`` changes nothing."""
        self._navigator.reset(context, observation)

    def act(self, observation: Observation) -> Decision:
        """Localise, plan, steer, or stop."""
        return self._navigator.act(observation)
