"""Remember the last commands of robots, from which a policy can tell what a drive that lags has yet to do."""

import numpy as np
from jaxtyping import Bool, Float

from vssm_gym.agents.policy.features import LAST_COMMANDS


class CommandHistory:
    """Hold the last commands of n robots, newest first; zeros before the first of an episode.

    Attributes:
        commands: ``(n, LAST_COMMANDS, 3)`` turn (rad), direction (rad), step (m).
    """

    def __init__(self, n: int) -> None:
        self.commands = np.zeros((n, LAST_COMMANDS, 3), np.float32)

    def begin(self, begun: Bool[np.ndarray, "n"]) -> None:
        """Forget the commands of robots whose episode begins."""
        self.commands[begun] = 0.0

    def add(self, sent: Float[np.ndarray, "n 3"]) -> None:
        """Add the commands that are carried out next."""
        self.commands = np.concatenate([np.asarray(sent, np.float32)[:, None], self.commands[:, :-1]], axis=1)
