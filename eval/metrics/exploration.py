"""Measure explorations: coverage, entropy and completeness over path length and time, and the cost of a coverage.

A run that ends before it reaches a level of coverage is *censored*: its path length to that level is unknown, or
infinite. Averages must not leave it out, because the agent that gives up early would look fast. It is counted, and
where a number is needed it takes the value that is least favourable to the agent whose lead is claimed
(:func:`censored_ratio`).
"""

import math
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any, Literal, TypeAlias

import numpy as np
from jaxtyping import Float

from vssm_gym.eval.episodes.row import identified
from vssm_gym.eval.metrics.aggregate import CONDITION, Interval, bootstrap_mean, task_key
from vssm_gym.eval.metrics.metric import Row
from vssm_gym.eval.metrics.resampling import RESAMPLES
from vssm_gym.eval.metrics.training_runs import run_of

COVERAGE_LEVELS = (50, 90, 95, 99)  # % of coverage, to which path length and time are measured
COVERAGE_GOAL = 90  # % of coverage: a run that reaches it succeeds
EVERY_METRES, EVERY_SECONDS = 2.0, 10.0  # between samples of a curve, whichever comes first
ONE_STEP = {
    "metres": 0.16,
    "seconds": 0.2,
}  # least value in a ratio, which stays finite if the first image shows it all
TOTALS = {"metres": "path_length", "seconds": "seconds"}  # fields of a row with the whole run's path length and time
KNOWN = 0.95  # proportion of the runs that a point of a mean curve needs: runs that drop out would bend it
Axis: TypeAlias = Literal["metres", "seconds"]
CURVES = ("coverage", "entropy", "completeness")


@dataclass
class Recorder:
    """Record one run: its curves, and when it reached each level of coverage.

    Attributes:
        measure: ``() -> (entropy nats, completeness)`` of the agent's map, None each for an agent without one; it is
            only called when a sample is due, because it costs as much as a step.
    """

    measure: Callable[[], tuple[float | None, float | None]]
    curve: dict[str, list[Any]] = field(default_factory=lambda: {n: [] for n in ("metres", "seconds", *CURVES)})
    reached: dict[int, tuple[float, float]] = field(default_factory=dict)  # level in %: metres, seconds
    _due: tuple[float, float] = (0.0, 0.0)  # m and s from which on the next sample is taken

    def record(self, metres: float, seconds: float, coverage: float, *, last: bool = False) -> None:
        """Record one step; steps come in order, and the last one is sampled in any case."""
        for level in COVERAGE_LEVELS:
            if level not in self.reached and 100.0 * coverage >= level - 1e-9:
                self.reached[level] = round(metres, 4), round(seconds, 3)
        if last and self.curve["seconds"] and self.curve["seconds"][-1] == round(seconds, 3):
            return
        if last or metres >= self._due[0] or seconds >= self._due[1] - 1e-9:
            entropy, completeness = self.measure()
            values = (metres, seconds, coverage, entropy, completeness)
            digits = (3, 3, 4, 1, 4)
            for samples, value, n in zip(self.curve.values(), values, digits, strict=True):
                samples.append(None if value is None else round(value, n))
            self._due = (
                # The first turn on the spot drives no metres: a sample at the first motion ends it on the curve
                EVERY_METRES * (math.floor(metres / EVERY_METRES) + 1) if metres > 0.0 else ONE_STEP["metres"] / 2.0,
                EVERY_SECONDS * (math.floor(seconds / EVERY_SECONDS + 1e-9) + 1),
            )

    def row(self) -> dict[str, Any]:
        """Return ``curve``, and ``metres_50, seconds_50, ...``, None where the run ended before."""
        metres = {f"metres_{s}": self.reached[s][0] if s in self.reached else None for s in COVERAGE_LEVELS}
        seconds = {f"seconds_{s}": self.reached[s][1] if s in self.reached else None for s in COVERAGE_LEVELS}
        return {**metres, **seconds, "curve": self.curve}


def censored_ratio(first: Row, second: Row, level: int = COVERAGE_GOAL, axis: Axis = "metres") -> float | None:
    """Return ``T_first / T_second`` of the metres (or seconds) to ``level`` % coverage, or its largest possible value.

    - Both reached it: their ratio.
    - Only the first did. If the second ran out of time after p metres: ``T_first / p``, because ``T_second > p``. If
    the
      second stopped by itself, it would never have reached it: at most 1, ``min(1, T_first / p)``.
    - Only the second did: the metres that a robot can drive within the time limit (or the time limit itself) replace
      ``T_first``.
    - Neither did: None; such a pair is counted apart.

    A ratio below 1 is thus never due to a run that was cut short.
    """
    a, b = first[f"{axis}_{level}"], second[f"{axis}_{level}"]
    if a is None and b is None:
        return None
    numerator = first["budget"][axis] if a is None else a
    denominator = second[TOTALS[axis]] if b is None else b
    ratio = max(numerator, ONE_STEP[axis]) / max(denominator, ONE_STEP[axis])
    return min(1.0, ratio) if b is None and second["stopped"] else ratio


@dataclass(frozen=True)
class Ratio:
    """Hold the geometric mean of paired ratios with its 95 % interval, and counts of the pairs' outcomes."""

    interval: Interval  # of the ratio; NaN without a pair that has one
    pairs: int
    shorter: int  # pairs in which the first reached the level on a shorter path, or alone
    first_missed: int  # pairs whose run of the first did not reach the level
    second_missed: int

    @property
    def text(self) -> str:
        """Format mean and interval as text."""
        return self.interval.text(2)


def ratio(
    rows: Iterable[Row], first: str, second: str, level: int = COVERAGE_GOAL, seed: int = 0, axis: Axis = "metres"
) -> Ratio:
    """Compute ``exp(mean(log(T_first / T_second)))`` over starts that both agents ran, resampling :func:`clusters`.

    Ratios are those of :func:`censored_ratio`; pairs in which neither reached the level count in ``pairs`` only.
    """
    paired = pairs(rows, first, second)
    found = [(a, b, value) for a, b in paired if (value := censored_ratio(a, b, level, axis)) is not None]
    logs = _mean([math.log(value) for _, _, value in found], [(a, b) for a, b, _ in found], seed)
    mean, low, high = (float(np.exp(v)) for v in (logs.mean, logs.low, logs.high))
    return Ratio(
        Interval(mean, low, high, logs.tasks, logs.episodes),
        len(paired),
        sum(b[f"{axis}_{level}"] is None or value < 1.0 for a, b, value in found if a[f"{axis}_{level}"] is not None),
        sum(a[f"{axis}_{level}"] is None for a, _ in paired),
        sum(b[f"{axis}_{level}"] is None for _, b in paired),
    )


def pairs(rows: Iterable[Row], first: str, second: str) -> list[tuple[Row, Row]]:
    """Pair the runs of two agents from the same start of the same scene under the same noise.

    Of a method with several policies each of them is paired.
    """
    names = (*CONDITION, "task", "seed")
    of: dict[str, dict[tuple, list[Row]]] = {first: {}, second: {}}
    for row in rows:
        if row["agent"] in of:
            of[row["agent"]].setdefault(tuple(identified(row, name) for name in names), []).append(row)
    return [pair for key, ran in of[first].items() if key in of[second] for pair in product(ran, of[second][key])]


def _mean(values: Sequence[float], of: Sequence[tuple[Row, Row]], seed: int) -> Interval:
    """Compute the mean over pairs, resampling :func:`clusters`, and the policies of the first that has several."""
    return bootstrap_mean(values, clusters([a for a, _ in of]), seed, [run_of(a) or run_of(b) for a, b in of])


def clusters(rows: Sequence[Row]) -> list[Hashable]:
    """Return the cluster of each run for resampling: its scene, or its start where all runs are of one scene."""
    scenes = [row["scene_hash"] for row in rows]
    return scenes if len(set(scenes)) > 1 else [task_key(row) for row in rows]


def median(values: Sequence[float], units: Sequence[Hashable], seed: int = 0) -> Interval:
    """Compute the median of values that may be infinite, and its percentile interval, resampling whole ``units``."""
    if not len(values):
        return Interval(np.nan, np.nan, np.nan, 0, 0)
    order = np.argsort(values)
    x, names = np.asarray(values, dtype=np.float64)[order], list(dict.fromkeys(units))
    unit = np.array([names.index(name) for name in units])[order]
    middle = float(_weighted_median(x, np.ones((1, len(x))))[0])
    if len(names) < 2:
        return Interval(middle, np.nan, np.nan, 1, len(x))
    rng = np.random.default_rng(np.random.SeedSequence([seed, len(names)]))
    weights = rng.multinomial(len(names), np.full(len(names), 1.0 / len(names)), size=RESAMPLES // 4)[:, unit]
    drawn = np.sort(_weighted_median(x, weights))  # no interpolation between quantiles: inf - inf is no number
    low, high = (float(drawn[round(q * (len(drawn) - 1))]) for q in (0.025, 0.975))
    return Interval(middle, low, high, len(names), len(x))


def _weighted_median(x: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the median of sorted ``x`` (n,) under each row of ``weights`` (m, n); of two middle values the mean."""
    total = np.cumsum(weights, axis=1)
    lower, upper = (
        x[np.argmax(reached, axis=1)] for reached in (2 * total >= total[:, -1:], 2 * total > total[:, -1:])
    )
    return 0.5 * (lower + upper)


def median_to_level(rows: Sequence[Row], level: int, seed: int = 0, axis: Axis = "metres") -> Interval:
    """Compute the median metres (or seconds) to ``level`` %; a run that did not reach it counts as longer than all."""
    values = [math.inf if row[f"{axis}_{level}"] is None else float(row[f"{axis}_{level}"]) for row in rows]
    return median(values, clusters(rows), seed)


def at(row: Row, name: str, axis: str, grid: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Evaluate a run's curve ``name`` over ``axis`` (``metres`` | ``seconds``), NaN where it is unknown.

    It is linear between samples. After the end of a run that the agent ended it stays constant, because the agent keeps
    its map; after the end of a run that ran out of time it is unknown.
    """
    x = np.asarray(row["curve"][axis], dtype=float)
    y = np.array([np.nan if value is None else value for value in row["curve"][name]], dtype=float)
    found = np.interp(grid, x, y)
    return found if row["stopped"] else np.where(grid <= x[-1] + 1e-9, found, np.nan)


def mean_curve(
    rows: Sequence[Row], name: str, axis: str, grid: Float[np.ndarray, "n"], seed: int = 0
) -> Float[np.ndarray, "3 n"]:
    """Compute the mean over runs and its 95 % interval at each point of ``grid``, resampling :func:`clusters`.

    NaN where fewer than ``KNOWN`` of the runs are known; the interval is NaN with one cluster.
    """
    values = np.array([at(row, name, axis, grid) for row in rows])
    known = np.isfinite(values)
    names = list(dict.fromkeys(clusters(rows)))
    member = np.array([names.index(unit) for unit in clusters(rows)])
    sums, counts = np.zeros((len(names), len(grid))), np.zeros((len(names), len(grid)))
    np.add.at(sums, member, np.where(known, values, 0.0))
    np.add.at(counts, member, known)
    enough = known.mean(axis=0) >= KNOWN
    curve = np.full((3, len(grid)), np.nan)
    curve[0, enough] = sums[:, enough].sum(axis=0) / counts[:, enough].sum(axis=0)
    if len(names) > 1 and enough.any():
        rng = np.random.default_rng(np.random.SeedSequence([seed, len(names)]))
        weights = rng.multinomial(len(names), np.full(len(names), 1.0 / len(names)), size=RESAMPLES // 4)
        with np.errstate(invalid="ignore"):  # 0 / 0 for a resample of scenes that are unknown there
            drawn = (weights @ sums[:, enough]) / (weights @ counts[:, enough])
        curve[1:, enough] = np.nanquantile(drawn, [0.025, 0.975], axis=0)
    return curve


def paired_at(
    rows: Iterable[Row], name: str, first: str, second: str, where: float, seed: int = 0, axis: Axis = "metres"
) -> Interval:
    """Compute ``mean(first - second)`` of a curve at one path length or time, over pairs in which both are known."""
    paired = pairs(rows, first, second)
    grid = np.array([where])
    values = [float((at(a, name, axis, grid) - at(b, name, axis, grid))[0]) for a, b in paired]
    kept = [i for i, value in enumerate(values) if math.isfinite(value)]
    return _mean([values[i] for i in kept], [paired[i] for i in kept], seed)
