"""Learn a transition from logs: cut them, fit the baselines, train, and compare all of them on other parts.

The first three quarters of each log are trained on. The last quarter is held out: the best network is chosen and its
noise calibrated there. Whole other logs may be given as a test, which nothing is fitted to.
"""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vssm_gym.data.dynamics.log import DynamicsLog, Kind, Steps, cut
from vssm_gym.data.dynamics.read import read_dynamics
from vssm_gym.errors import InputError
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.learned import LearnedTransition
from vssm_gym.model.transition.learned_file import NOMINALS
from vssm_gym.progress import OnProgress
from vssm_gym.training.dynamics.baselines import fit_bias, fit_parametric
from vssm_gym.training.dynamics.evaluation import coverage, path_errors, step_likelihood
from vssm_gym.training.dynamics.fit import FitConfig, Fitted, fit
from vssm_gym.training.dynamics.windows import Windows, windows

PHASES = 10  # cuts of a log that begin at other times within a step: as many windows of the same motion
HELD_SHARE_OF_LOG = 0.25  # share of a log, its end, that is not trained on
FEWEST_HELD = 10  # steps that are held out of a log at least
GAP = 2  # steps between what is trained on and what is held out: velocities are measured over several poses
COVERED_WINDOWS = 80  # windows at most from which coverage is measured


@dataclass(frozen=True)
class LearnConfig:
    """Configure what is learned.

    Attributes:
        step: s, of an IMU's steps; a robot's are those of its commands.
        horizon: steps, the longest open-loop prediction that is trained and judged; shorter where a log is short.
        fit: effort and rates of the training.
    """

    step: float = 0.1
    horizon: int = 100
    fit: FitConfig = field(default_factory=FitConfig)

    def __post_init__(self) -> None:
        if not 0.001 <= self.step <= 10.0:
            raise InputError("train-dynamics", "step", f"from 0.001 to 10 s; found {self.step:g}")
        if not 2 <= self.horizon <= 1000:
            raise InputError("train-dynamics", "horizon", f"from 2 to 1000 steps; found {self.horizon}")


@dataclass(frozen=True)
class Learned:
    """Hold a trained transition and how it compares.

    Attributes:
        kind: of the controls.
        fitted: the transition, and how its training went.
        report: the comparison, as plain JSON values.
    """

    kind: Kind
    fitted: Fitted
    report: dict[str, Any]


def learn(
    data: Sequence[str | Path],
    test: Sequence[str | Path] = (),
    config: LearnConfig | None = None,
    on_progress: OnProgress | None = None,
) -> Learned:
    """Learn a transition from logs of one kind.

    Args:
        data: logs to learn from; the end of each is held out.
        test: logs that are only predicted.
        config: step, horizon and effort.
        on_progress: called with ("training", updates, total) and ("comparing", models, total).

    Raises:
        InputError: a log that cannot be read, that is too short, or of another kind than the first.
    """
    config = config or LearnConfig()
    logs, tests = [read_dynamics(path) for path in data], [read_dynamics(path) for path in test]
    if not logs:
        raise InputError("train-dynamics", "data", "at least one log")
    for log in logs + tests:
        if log.kind != logs[0].kind or log.controls.shape[1] != logs[0].controls.shape[1]:
            expected = f"a log of the kind {logs[0].kind} with {logs[0].controls.shape[1]} numbers in a control"
            raise InputError(log.source, "controls", f"{expected}; found {log.kind}, {log.controls.shape[1]}")
    kind, nominal = logs[0].kind, NOMINALS[logs[0].kind]()
    trained, held = zip(*(_divide(cuts(log, config.step)) for log in logs), strict=True)
    dt = trained[0][0].dt
    shortest = min(len(steps) for part in held for steps in part)
    horizon = min(config.horizon, int(0.8 * shortest))
    if shortest < FEWEST_HELD:
        raise InputError(
            logs[0].source, "times", f"a longer log: its last {HELD_SHARE_OF_LOG:.0%} has {shortest} steps"
        )
    parts = {
        "trained on": windows([s for part in trained for s in part], nominal.manifold, horizon),
        "held out": windows([s for part in held for s in part], nominal.manifold, horizon),
    }
    for log in tests:
        steps = cuts(log, config.step)
        if len(steps[0]) < horizon:
            raise InputError(log.source, "times", f"at least {horizon} steps of {dt:g} s; found {len(steps[0])}")
        parts[f"test: {Path(log.source).name}"] = windows(steps, nominal.manifold, horizon)
    baselines = {
        "euler": nominal,
        "bias": fit_bias(nominal, parts["trained on"], dt),
        "parametric": fit_parametric(nominal, parts["trained on"], dt),
    }
    fitted = fit(baselines["bias"], parts["trained on"], parts["held out"], dt, config.fit, on_progress)
    report = {
        "kind": kind,
        "data": [Path(path).name for path in data],
        "test": [Path(path).name for path in test],
        "step": dt,
        "horizon": horizon,
        "fit": asdict(config.fit),
        "updates": fitted.updates,
        "seconds": round(fitted.seconds, 1),
        "interrupted": fitted.interrupted,
        "gain": fitted.gain,
        "measured_stds": fitted.noise,
        "history": fitted.history,
        "parts": compare(baselines | {"learned": fitted.transition}, parts, dt, fitted.noise, on_progress),
    }
    return Learned(kind, fitted, report)


def cuts(log: DynamicsLog, step: float) -> list[Steps]:
    """Cut a log at several offsets within a step, where its poses are more frequent than the steps."""
    if log.kind != "imu":
        return [cut(log)]
    phases = max(1, min(PHASES, round(step / float(np.median(np.diff(log.times))))))
    return [cut(log, step, k * step / phases) for k in range(phases)]


def _divide(phases: list[Steps]) -> tuple[list[Steps], list[Steps]]:
    """Return what is trained on and what is held out, of every cut of a log."""
    first = round((1.0 - HELD_SHARE_OF_LOG) * min(map(len, phases)))
    return [s.part(0, first - GAP) for s in phases], [s.part(first, len(s)) for s in phases]


def compare(
    models: dict[str, Transition],
    parts: dict[str, Windows],
    dt: float,
    noise: tuple[float, float] = (0.0, 0.0),
    on_progress: OnProgress | None = None,
) -> dict[str, dict[str, dict[str, Any]]]:
    """Return errors, coverage and likelihood of every model on every part.

    Args:
        models: by name; ``learned`` also says how certain it is.
        parts: windows by name; the noise of the other models is measured on the part "trained on".
        dt: length of a step, s.
        noise: standard deviations of measured positions (m) and rotations (rad), for the envelopes.
        on_progress: called with ("comparing", models, total).

    Returns:
        ``result[part][model]``: ``position`` (m) and ``rotation`` (rad), RMSE after a tenth, three tenths and all of
        the steps; ``log_likelihood`` of the pose after one step, nats; of ``learned`` also the ``coverage`` of
        envelopes of 95 %.
    """
    rows: dict[str, dict[str, dict[str, Any]]] = {}
    for name, data in parts.items():
        horizon = data.controls.shape[1]
        at = {str(k): k - 1 for k in sorted({max(1, horizon // 10), max(1, 3 * horizon // 10), horizon})}
        some = data.take(np.unique(np.linspace(0, len(data) - 1, min(len(data), COVERED_WINDOWS)).round().astype(int)))
        for model_name, model in models.items():
            errors = path_errors(model, data, dt)
            row: dict[str, Any] = {
                "windows": len(data),
                "position": {k: round(float(errors.position[i]), 4) for k, i in at.items()},
                "rotation": {k: round(float(errors.rotation[i]), 4) for k, i in at.items()},
                "log_likelihood": round(step_likelihood(model, parts["trained on"], data, dt, noise), 3),
            }
            if isinstance(model, LearnedTransition):
                row["coverage"] = _coverage(model, some, dt, noise, at)
            rows.setdefault(name, {})[model_name] = row
            if on_progress:
                on_progress("comparing", sum(map(len, rows.values())), len(parts) * len(models))
    return rows


def _coverage(
    model: LearnedTransition, data: Windows, dt: float, noise: tuple[float, float], at: dict[str, int]
) -> dict[str, dict[str, float]]:
    """Return shares of windows inside envelopes of 95 %: of the position, and of the pose."""
    result = {}
    for name, held in zip(("position", "pose"), coverage(model, data, dt, noise), strict=True):
        shares = {k: round(float(held[i]), 3) for k, i in at.items()}
        result[name] = shares | {"all steps": round(float(held.mean()), 3)}
    return result


def seconds_a_step(transition: LearnedTransition, repeats: int = 300) -> float:
    """Measure the time of one step without noise, compiled, s."""
    step = eqx.filter_jit(lambda t, z, u: t.mean(z, u, t.scales.step))
    state, control = transition.manifold.resting(jnp.eye(4)), jnp.zeros(transition.controls)
    state = jax.block_until_ready(step(transition, state, control))
    began = time.perf_counter()
    for _ in range(repeats):
        state = step(transition, state, control)
    jax.block_until_ready(state)
    return (time.perf_counter() - began) / repeats
