"""Explore a maze by a deterministic LSTM over scans, trained on the very share of tiles that is measured.

``maze_lstm`` was trained in ``pillars-v1`` alone by augmented random search, ``maze_lstm_own`` in each maze that it is
run in, as the published baseline was: it knows the maze. Neither has a map or a pose. Described in
``docs/agents/exploration.md``.
"""

from pathlib import Path

import numpy as np

from vssm_gym.agents.base import AgentContext, Decision, Observation
from vssm_gym.agents.shared.planar.lstm_policy import LstmPolicy, load_lstm, read_inputs
from vssm_gym.files.shipped import ASSETS

LONGEST_READ = 1.5  # m, that a missing reading counts as
LSTM_FILES = ASSETS / "mazes" / "policies"  # one for each maze, ``NAME.npz``


class MazeLstmAgent:
    """Run a policy file; the default is the one trained in ``pillars-v1``."""

    name = "maze_lstm"
    robot = "disc"
    task = "explore"
    needs_pose = False
    needs_map = False

    def __init__(self, policy: LstmPolicy | Path | None = None) -> None:
        self._policy = policy if isinstance(policy, LstmPolicy) else load_lstm(policy or LSTM_FILES / "pillars-v1.npz")

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> None:
        """Open an episode; nothing is random."""
        del observation, seed
        self._limits, self._state = np.asarray(context.limits, np.float64), self._policy.start()

    def act(self, observation: Observation) -> Decision:
        """Return the policy's command."""
        ranges = read_inputs(observation["scan"], self._policy.inputs, LONGEST_READ)
        self._state, command = self._policy.step(self._state, ranges, self._limits)
        return Decision(np.array([*command, 0.0], np.float32), None, "runs its policy")
