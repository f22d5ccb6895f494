"""Learn a transition from logs: cut them, fit the baselines, train, and compare all of them on other parts.

Each log is cut into as many blocks as there are networks, and each network is trained without one block of each log:
there the best update is chosen and the noise calibrated, and figures of "held out" are those of each network on its
own. Whole other logs may be given as a test, which nothing is fitted to.
"""

import time
from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vssm_gym.data.dynamics.log import DynamicsLog, Kind, Steps, cut
from vssm_gym.data.dynamics.read import read_dynamics
from vssm_gym.errors import InputError
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.learned import LearnedTransition
from vssm_gym.model.transition.learned_file import NOMINALS
from vssm_gym.model.transition.manifold import Manifold
from vssm_gym.progress import OnProgress
from vssm_gym.training.dynamics.baselines import fit_bias, fit_parametric
from vssm_gym.training.dynamics.calibration import GAINS
from vssm_gym.training.dynamics.evaluation import coverage, path_errors, step_likelihood
from vssm_gym.training.dynamics.fit import FitConfig, Fitted, Folds, fit
from vssm_gym.training.dynamics.windows import Windows, evenly_spread, windows

PHASES = 10  # cuts of a log that begin at other times within a step: as many windows of the same motion
FEWEST_HELD = 10  # steps of a block at least
LONGEST_SHARE = 0.8  # of a block, that a window takes at most: several windows must fit
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
        data: logs to learn from; a block of each is held out from each network.
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
    parts = [steps for log in logs for steps in cuts(log, config.step)]
    dt, shortest = parts[0].dt, min(map(len, parts)) // config.fit.members
    horizon = min(config.horizon, int(LONGEST_SHARE * shortest))
    if shortest < FEWEST_HELD:
        raise InputError(logs[0].source, "times", f"a longer log: a block has {shortest} steps")
    folds = folded(parts, nominal.manifold, horizon, config.fit.members)
    tested = {}
    for log in tests:
        steps = cuts(log, config.step)
        if len(steps[0]) < horizon:
            raise InputError(log.source, "times", f"at least {horizon} steps of {dt:g} s; found {len(steps[0])}")
        tested[f"test: {Path(log.source).name}"] = windows(steps, nominal.manifold, horizon)
    baselines = {
        "euler": nominal,
        "bias": fit_bias(nominal, folds.data, dt),
        "parametric": fit_parametric(nominal, folds.data, dt),
    }
    fitted = fit(baselines["bias"], folds, dt, config.fit, on_progress)
    whole = baselines | {"learned": fitted.transition}
    compared = {
        "trained on": [(whole, folds.data)],
        "held out": [
            (baselines | {"learned": member}, folds.data.take(held))
            for member, held in zip(fitted.members, folds.held, strict=True)
        ],
    } | {name: [(whole, data)] for name, data in tested.items()}
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
        "gain_at_bound": bool(fitted.gain >= GAINS[-1]),  # then envelopes hold too little, even of what calibrated them
        "factor": fitted.factor,
        "measured_stds": fitted.noise,
        "history": fitted.history,
        "parts": compare(compared, folds.data, dt, fitted.noise, on_progress),
    }
    return Learned(kind, fitted, report)


def cuts(log: DynamicsLog, step: float) -> list[Steps]:
    """Cut a log at several offsets within a step, where its poses are more frequent than the steps."""
    if log.kind != "imu":
        return [cut(log)]
    phases = max(1, min(PHASES, round(step / float(np.median(np.diff(log.times))))))
    return [cut(log, step, k * step / phases) for k in range(phases)]


def folded(parts: list[Steps], manifold: Manifold, horizon: int, members: int) -> Folds:
    """Cut each part into blocks, and find the windows of each block and those that share no step with it.

    Args:
        parts: that are not continued by each other.
        manifold: of the states.
        horizon: steps of a window.
        members: blocks of each part, and networks.
    """
    data = windows(parts, manifold, horizon)
    seen: list[list[np.ndarray]] = [[] for _ in range(members)]
    held: list[list[np.ndarray]] = [[] for _ in range(members)]
    count = 0
    for steps in parts:
        first = np.arange(len(steps) - horizon + 1)
        last, edges = first + horizon, np.linspace(0, len(steps), members + 1).round().astype(int)
        for k, (begin, end) in enumerate(pairwise(edges)):
            seen[k].append(count + np.flatnonzero((last <= begin - GAP) | (first >= end + GAP)))
            held[k].append(count + np.flatnonzero((first >= begin) & (last <= end)))
        count += len(first)
    every = [np.concatenate(indices) for indices in seen]
    most = max(map(len, every))  # of equal number, since all networks are trained at once
    return Folds(data, np.stack([np.resize(indices, most) for indices in every]), list(map(np.concatenate, held)))


Compared = list[tuple[dict[str, Transition], Windows]]  # models by name, and windows that they predict


def compare(
    parts: dict[str, Compared],
    trained_on: Windows,
    dt: float,
    noise: tuple[float, float] = (0.0, 0.0),
    on_progress: OnProgress | None = None,
) -> dict[str, dict[str, dict[str, Any]]]:
    """Return errors, coverage and likelihood of every model on every part.

    Args:
        parts: by name, pieces each with its models by name; ``learned`` also says how certain it is. Figures of a part
            are those of all its windows.
        trained_on: windows on which the noise of the other models is measured.
        dt: length of a step, s.
        noise: standard deviations of measured positions (m) and rotations (rad), for the envelopes.
        on_progress: called with ("comparing", models, total).

    Returns:
        ``result[part][model]``: ``position`` (m) and ``rotation`` (rad), RMSE after a tenth, three tenths and all of
        the steps; ``log_likelihood`` of the pose after one step, nats; of ``learned`` also the ``coverage`` of
        envelopes of 95 %.
    """
    rows: dict[str, dict[str, dict[str, Any]]] = {}
    total = sum(len(pieces[0][0]) for pieces in parts.values())
    for name, pieces in parts.items():
        horizon, shares = pieces[0][1].controls.shape[1], [len(data) for _, data in pieces]
        at = {str(k): k - 1 for k in sorted({max(1, horizon // 10), max(1, 3 * horizon // 10), horizon})}
        pooled = lambda values, shares=shares: np.average(values, axis=0, weights=shares)
        for model_name in pieces[0][0]:
            models = [(by_name[model_name], data) for by_name, data in pieces]
            errors = [path_errors(model, data, dt) for model, data in models]
            position, rotation = (
                np.sqrt(pooled([np.square(of) for of in every])) for every in zip(*map(astuple, errors), strict=True)
            )
            likelihoods = [step_likelihood(model, trained_on, data, dt, noise) for model, data in models]
            row: dict[str, Any] = {
                "windows": sum(shares),
                "position": {k: round(float(position[i]), 4) for k, i in at.items()},
                "rotation": {k: round(float(rotation[i]), 4) for k, i in at.items()},
                "log_likelihood": round(float(pooled(likelihoods)), 3),
            }
            learned = [(model, data) for model, data in models if isinstance(model, LearnedTransition)]
            if learned:
                most = COVERED_WINDOWS // len(learned)
                held = pooled([coverage(model, spread_over(data, most), dt, noise) for model, data in learned])
                row["coverage"] = _coverage(held, at)
            rows.setdefault(name, {})[model_name] = row
            if on_progress:
                on_progress("comparing", sum(map(len, rows.values())), total)
    return rows


def spread_over(data: Windows, most: int) -> Windows:
    """Return at most so many of the windows, evenly spread."""
    return data.take(evenly_spread(len(data), most))


def _coverage(held: Float[np.ndarray, "2 time"], at: dict[str, int]) -> dict[str, dict[str, float]]:
    """Return shares of windows inside envelopes of 95 %: of the position, and of the pose."""
    result = {}
    for name, of_one in zip(("position", "pose"), held, strict=True):
        shares = {k: round(float(of_one[i]), 3) for k, i in at.items()}
        result[name] = shares | {"all steps": round(float(of_one.mean()), 3)}
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
