"""Cut a log into windows that are predicted, and into windows that the noise of plain integration is fitted to.

Nothing is fitted to what is judged: the noise is that of other logs, or of the first third of the log itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from vssm_gym.data.dynamics.log import DynamicsLog, Steps
from vssm_gym.data.dynamics.read import read_dynamics
from vssm_gym.errors import InputError
from vssm_gym.model.transition.learned_file import TransitionFile
from vssm_gym.training.dynamics.learn import GAP, cuts
from vssm_gym.training.dynamics.windows import Windows, evenly_spread, windows

STEPS_AHEAD = (10, 30, 100)  # after which predictions are scored; the last is the length of a window
MOST_STARTS = 80  # windows that are predicted
FITTED_PART = 3  # one of so many parts of a log is fitted to where there is no other log
STEP_TOLERANCE = 0.1  # of a robot's step, whose commands are displacements


@dataclass(frozen=True)
class Judged:
    """Hold what is predicted.

    Attributes:
        log: name of the log.
        kind: of its controls.
        dt: length of a step, s.
        data: windows of ``STEPS_AHEAD[-1]`` steps, evenly spread over the log.
        begins: s, stamp of the first state of each window.
        fitted: windows that the noise of plain integration is fitted to.
        fitted_on: where they are from, in words.
        notices: sentences for the user.
    """

    log: str
    kind: str
    dt: float
    data: Windows
    begins: Float[np.ndarray, "windows"]
    fitted: Windows
    fitted_on: str
    notices: tuple[str, ...]

    @property
    def stretches(self) -> list[int]:
        """Return the stretch of the log, as long as a window, in which each window begins."""
        length = STEPS_AHEAD[-1] * self.dt
        return np.floor((self.begins - self.begins.min()) / length + 1e-6).astype(int).tolist()


def read_judged(path: Path, stored: TransitionFile, fit: Sequence[Path] = ()) -> Judged:
    """Read a log, and cut it.

    Args:
        path: the log that is predicted.
        stored: the learned transition, which says the kind of the logs and the step of an IMU.
        fit: logs that the noise of plain integration is fitted to; none: the first third of ``path``.

    Raises:
        InputError: a log that cannot be read, of another kind than the transition's, or shorter than the windows.
    """
    if any(other.resolve() == path.resolve() for other in fit):
        raise InputError("bench prediction", "fit", f"other logs than {path}, which is judged")
    manifold, length = stored.transition.nominal.manifold, STEPS_AHEAD[-1]
    parts = _parts(path, stored)
    dt = parts[0].dt
    if fit:
        fitted = [steps for other in fit for steps in _long_enough(other, _parts(other, stored), length)]
        fitted_on = ", ".join(other.name for other in fit)
        judged = _long_enough(path, parts, length)
    else:
        needed = FITTED_PART * length
        whole = _long_enough(path, parts, needed, f": {length} in its first third, or `--fit` and another log")
        cut_at = [len(steps) // FITTED_PART for steps in whole]
        fitted = [steps.part(0, end) for steps, end in zip(whole, cut_at, strict=True)]
        judged = [steps.part(end + GAP, len(steps)) for steps, end in zip(whole, cut_at, strict=True)]
        fitted_on = f"the first third of {path.name}, which is not judged"
    data = windows(judged, manifold, length)
    begins = np.concatenate([steps.begin + dt * np.arange(len(steps) - length + 1) for steps in judged])
    chosen = evenly_spread(len(data), MOST_STARTS)
    notices: tuple[str, ...] = ()
    learned_from = stored.trained.get("data")
    if isinstance(learned_from, list) and path.name in learned_from:
        notices = (f"the transition was learned from a log named {path.name}: if it is this one, it has been seen",)
    return Judged(
        path.name,
        stored.kind,
        dt,
        data.take(chosen),
        begins[chosen],
        windows(fitted, manifold, length),
        fitted_on,
        notices,
    )


def _parts(path: Path, stored: TransitionFile) -> list[Steps]:
    """Read a log of the transition's kind, and cut it at its step."""
    log: DynamicsLog = read_dynamics(path)
    numbers, step = stored.transition.controls, float(stored.transition.scales.step)
    if log.kind != stored.kind or log.controls.shape[1] != numbers:
        expected = f"those that the transition was learned from: {stored.kind}, {numbers} numbers a control"
        raise InputError(log.source, "controls", f"{expected}; found {log.kind}, {log.controls.shape[1]}")
    parts = cuts(log, step)
    if abs(parts[0].dt - step) > STEP_TOLERANCE * step:
        raise InputError(log.source, "times", f"steps of {step:g} s, as learned; found {parts[0].dt:g} s")
    return parts


def _long_enough(path: Path, parts: list[Steps], needed: int, why: str = "") -> list[Steps]:
    """Return the parts; raise where the shortest is too short."""
    shortest = min(map(len, parts))
    if shortest < needed:
        raise InputError(path, "times", f"at least {needed} steps of {parts[0].dt:g} s{why}; found {shortest}")
    return parts
