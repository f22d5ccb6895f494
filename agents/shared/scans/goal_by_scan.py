"""Find the place of a goal that is a scan, and drive there (DVBF-LM, section VI-A)."""

from dataclasses import replace

import numpy as np

from vssm_gym.agents.base import AgentContext, Decision, Observation
from vssm_gym.agents.shared.scans.localization import ParticlePose
from vssm_gym.agents.shared.scans.navigator import ScanNavigation, ScanNavigator
from vssm_gym.errors import InputError
from vssm_gym.inference.scan_encoder.mode import modes_of

RULED_OUT = 5.0  # nats, of a pose that explains the goal's scan that much worse than the best one


class GoalByScan:
    """Find the poses that explain the goal's scan, then filter the pose and plan in the model.

    It stops at the likeliest. An episode that goes on then says that another place was meant, which looks the same: the
    next likeliest is its goal.

    Args:
        config: of planning and following.
    """

    def __init__(self, config: ScanNavigation) -> None:
        self._navigator = ScanNavigator(ParticlePose(config.particles), config)

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> None:
        """Open an episode."""
        if context.scan_encoder is None:
            raise InputError("AgentContext", "scan_encoder", "an encoder of scans, which finds this agent's goal")
        self._context, self._seed = context, seed
        self._seen: np.ndarray | None = None
        self._arrived = False
        self._navigator.reset(context, observation, seed)

    def act(self, observation: Observation) -> Decision:
        """Return the next command; a scan of another goal begins a new task."""
        scan = np.asarray(observation["goal_scan"], np.float32)
        if self._seen is None or not np.array_equal(scan, self._seen):
            encoder, model = self._context.scan_encoder, self._context.scan_model
            assert encoder is not None and model is not None
            modes = modes_of(encoder, model, scan, self._seed)
            self._seen, self._goals = scan, modes.poses[modes.scores > modes.scores[0] - RULED_OUT, :2]
            self._others = 0
        elif self._arrived:
            self._leave_out()
        decision = self._navigator.towards(self._goals[0], observation)
        while decision.gives_up and self._leave_out():
            decision = self._navigator.towards(self._goals[0], observation)
        self._arrived = bool(decision.action[2])
        return replace(decision, responses={**(decision.responses or {}), "another place": self._others})

    def _leave_out(self) -> bool:
        """Turn to the next likeliest place; return False if there is none."""
        if len(self._goals) == 1:
            return False
        self._goals, self._others = self._goals[1:], self._others + 1
        return True
