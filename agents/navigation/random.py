"""Draw uniform commands within the limits and a rare stop: the lower bound of every comparison.

``random`` reads no observation. Described in ``docs/agents/navigation.md``.
"""

from dataclasses import dataclass

import numpy as np

from vssm_gym.agents.base import ANY_TASK, AgentContext, Decision, Observation


@dataclass(frozen=True)
class RandomConfig:
    """Configure the ``random`` agent."""

    stop_probability: float = 0.005  # per step: 200 steps per episode on average, enough to leave the room


class RandomAgent:
    """``turn ~ U(-max, max)``, ``o ~ U(-max, max)``, ``s ~ U(0, max)``, independent of the observation."""

    name = "random"
    robot = "holonomic"
    task = ANY_TASK
    needs_pose = False
    needs_map = False

    def __init__(self, config: RandomConfig | None = None) -> None:
        self._config = config or RandomConfig()

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> None:
        """Open an episode whose commands follow from ``seed`` alone."""
        self._high = np.asarray(context.limits, np.float64)
        self._low = self._high * (-1.0, -1.0, 0.0)
        self._rng = np.random.default_rng(seed)

    def act(self, observation: Observation) -> Decision:
        """Draw a command."""
        command = self._rng.uniform(self._low, self._high)
        stop = self._rng.random() < self._config.stop_probability
        return Decision(np.array([*command, float(stop)], np.float32), None, "stopping" if stop else "wandering")
