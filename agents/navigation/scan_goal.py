"""Drive to where a scan was taken: the mode of an encoder's belief is the goal (DVBF-LM, section VI-A).

``scan_goal`` reads scans, the scan of its goal, its own commands, the model and its encoder. It drives as
``scan_astar`` does. Described in ``docs/agents/navigation.md``.
"""

import numpy as np

from vssm_gym.agents.base import AgentContext, Decision, Observation
from vssm_gym.agents.shared.scans.localization import ParticlePose
from vssm_gym.agents.shared.scans.navigator import ScanNavigation, ScanNavigator
from vssm_gym.errors import InputError
from vssm_gym.inference.scan_encoder.mode import pose_of

CONFIG = ScanNavigation()


class ScanGoalAgent:
    """Find the goal's pose by its scan, then filter the pose and plan in the model."""

    name = "scan_goal"
    robot = "disc"
    task = "pointgoal"
    needs_pose = False
    needs_map = True
    goal_by_scan = True  # observation["goal_scan"] in the place of observation["goal"]

    def __init__(self, config: ScanNavigation = CONFIG) -> None:
        self._navigator = ScanNavigator(ParticlePose(config.particles), config)

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> None:
        """Open an episode."""
        if context.scan_encoder is None:
            raise InputError("AgentContext", "scan_encoder", "an encoder of scans, which finds this agent's goal")
        self._context, self._seed = context, seed
        self._seen: np.ndarray | None = None
        self._navigator.reset(context, observation, seed)

    def act(self, observation: Observation) -> Decision:
        """Return the next command; a scan of another goal begins a new task."""
        scan = np.asarray(observation["goal_scan"], np.float32)
        if self._seen is None or not np.array_equal(scan, self._seen):
            encoder, model = self._context.scan_encoder, self._context.scan_model
            assert encoder is not None and model is not None
            self._seen, self._goal = scan, pose_of(encoder, model, scan, self._seed)[0][:2]
        return self._navigator.towards(self._goal, observation)
