"""Convert the actions of an environment to commands in SI units.

    metric        command = clip(action, low, high)
    normalized    command = low + (clip(action, -1, 1) + 1) / 2 (high - low)
    discrete      command = moves[action]

A stop is one more number, from 0 to 1 and true above 0.5 (``metric``) or from -1 to 1 and true above 0
(``normalized``), or one more move, the last one (``discrete``).
"""

from collections.abc import Sequence
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from jaxtyping import Float

from vssm_gym.envs.validation import parse_action
from vssm_gym.errors import InputError

ActionForm = Literal["metric", "normalized", "discrete"]
ACTION_FORMS = ("metric", "normalized", "discrete")


class Actions:
    """Parse the actions of one environment.

    Args:
        form: how an action states a command; see the module.
        names: of a command's components.
        bounds: the lowest and the highest command, SI units.
        moves: the commands of the discrete actions.
        stop: if True, an action may also end the episode.
    """

    def __init__(
        self,
        form: ActionForm,
        names: Sequence[str],
        bounds: tuple[np.ndarray, np.ndarray],
        moves: Sequence[np.ndarray] = (),
        stop: bool = False,
    ) -> None:
        self.form, self.stop = form, stop
        self._names, self._bounds = (*names, "stop") if stop else tuple(names), bounds
        self._moves = [np.asarray(move, dtype=np.float64) for move in moves]
        self.space = self._space()

    def _space(self) -> gym.spaces.Space[Any]:
        low, high = self._bounds
        if self.form == "discrete":
            return gym.spaces.Discrete(len(self._moves) + self.stop)
        if self.form == "normalized":
            return gym.spaces.Box(-1.0, 1.0, (len(self._names),), np.float32)
        ends = [0.0] * self.stop, [1.0] * self.stop
        return gym.spaces.Box(np.array([*low, *ends[0]], np.float32), np.array([*high, *ends[1]], np.float32))

    def parse(self, action: Any) -> tuple[np.ndarray, bool]:
        """Return the command within its bounds, and True if the action is a stop.

        Raises :class:`InputError` for anything but finite numbers, one for each component, or the number of a move.
        """
        if self.form == "discrete":
            return self._move(action)
        values = parse_action(action, self._names)
        command = values[:-1] if self.stop else values
        if self.form == "normalized":
            return from_unit(command, *self._bounds), self.stop and bool(values[-1] > 0.0)
        return np.clip(command, *self._bounds), self.stop and bool(values[-1] > 0.5)

    def _move(self, action: Any) -> tuple[np.ndarray, bool]:
        values, count = np.asarray(action), len(self._moves) + self.stop
        if values.shape != () or values.dtype.kind not in "iu" or not 0 <= values < count:
            raise InputError("step", "action", f"a whole number from 0 to {count - 1}; found {action!r:.80}")
        number = int(values)
        stops = number == len(self._moves)
        return (np.zeros_like(self._moves[0]) if stops else self._moves[number].copy()), stops


def from_unit(
    action: Float[np.ndarray, "*batch n"], low: Float[np.ndarray, "n"], high: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "*batch n"]:
    """``low + (clip(action, -1, 1) + 1) / 2 (high - low)``: commands of actions in [-1, 1]."""
    return low + 0.5 * (np.clip(action, -1.0, 1.0) + 1.0) * (high - low)
