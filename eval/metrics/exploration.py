"""What an exploration is worth (SPEC 8): coverage, entropy and completeness by metre and second; the way to a share.

A run that ends before it has covered a share is *censored*: its way to that share is unknown, or there is none. It is
counted, and where a number is asked for it takes the one that speaks against the agent whose lead is claimed
(:func:`way_ratio`). What an average must not do is leave it out: the agent that gives up early would look fast.
"""

import math
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import numpy as np
from jaxtyping import Float

from vssm_gym.eval.metrics.aggregate import CONDITION, RESAMPLES, Interval, Row, bootstrap_mean, task_key

SHARES = (50, 90, 95, 99)  # % of the coverage that way and time are taken to
GOAL = 90  # % of coverage that a run has succeeded at
EVERY_METRES, EVERY_SECONDS = 2.0, 10.0  # between samples of a curve, whichever comes first
LEAST = {"metres": 0.16, "seconds": 0.2}  # one step: a ratio is finite where the first look shows it all
ENDS = {"metres": "path_length", "seconds": "seconds"}  # of a row: what the whole run took
KNOWN = 0.95  # share of the runs that a point of a mean curve needs: who drops out would bend it
Axis: TypeAlias = Literal["metres", "seconds"]
CURVES = ("coverage", "entropy", "completeness")


@dataclass
class Recorder:
    """Watches one run: its curves, and when it reached which share of coverage.

    Attributes:
        measure: ``() -> (entropy nats, completeness)`` of the agent's map, None each for an agent without; it is only
            called when a sample is due, since it costs as much as a step.
    """

    measure: Callable[[], tuple[float | None, float | None]]
    curve: dict[str, list[Any]] = field(default_factory=lambda: {n: [] for n in ("metres", "seconds", *CURVES)})
    reached: dict[int, tuple[float, float]] = field(default_factory=dict)  # share in %: metres, seconds
    _due: tuple[float, float] = (0.0, 0.0)  # m and s from which on the next sample is taken

    def see(self, metres: float, seconds: float, coverage: float, *, last: bool = False) -> None:
        """Where the run stands now; every step, in order. The last is sampled in any case."""
        for share in SHARES:
            if share not in self.reached and 100.0 * coverage >= share - 1e-9:
                self.reached[share] = round(metres, 4), round(seconds, 3)
        if last and self.curve["seconds"] and self.curve["seconds"][-1] == round(seconds, 3):
            return
        if last or metres >= self._due[0] or seconds >= self._due[1] - 1e-9:
            entropy, completeness = self.measure()
            values = (metres, seconds, coverage, entropy, completeness)
            digits = (3, 3, 4, 1, 4)
            for samples, value, n in zip(self.curve.values(), values, digits, strict=True):
                samples.append(None if value is None else round(value, n))
            self._due = (
                # The first look around costs no metres: a sample as soon as it moves ends it on the curve, too
                EVERY_METRES * (math.floor(metres / EVERY_METRES) + 1) if metres > 0.0 else LEAST["metres"] / 2.0,
                EVERY_SECONDS * (math.floor(seconds / EVERY_SECONDS + 1e-9) + 1),
            )

    def row(self) -> dict[str, Any]:
        """``curve``, and ``metres_50, seconds_50, ...``: None where the run ended before."""
        ways = {f"metres_{s}": self.reached[s][0] if s in self.reached else None for s in SHARES}
        times = {f"seconds_{s}": self.reached[s][1] if s in self.reached else None for s in SHARES}
        return {**ways, **times, "curve": self.curve}


def way_ratio(first: Row, second: Row, share: int = GOAL, axis: Axis = "metres") -> float | None:
    """``T_first / T_second`` of the metres (or seconds) to ``share`` % coverage, or the largest that is still possible.

    - Both got there: their ratio.
    - Only the first did. If time was out for the second after p metres: ``T_first / p``, since ``T_second > p``. If it
      stopped by itself it would never have got there, and the ratio is no more than 1: ``min(1, T_first / p)``.
    - Only the second did: the metres that a robot can drive at all within the time limit stand for ``T_first`` (or the
      time limit itself).
    - Neither did: None; such a pair says nothing, and is counted apart.

    So a ratio below 1 is never owed to a run that was cut short.
    """
    a, b = first[f"{axis}_{share}"], second[f"{axis}_{share}"]
    if a is None and b is None:
        return None
    numerator = first["budget"][axis] if a is None else a
    denominator = second[ENDS[axis]] if b is None else b
    ratio = max(numerator, LEAST[axis]) / max(denominator, LEAST[axis])
    return min(1.0, ratio) if b is None and second["stopped"] else ratio


@dataclass(frozen=True)
class Ratio:
    """The geometric mean of paired ratios with its 95 % interval, and how the pairs came out."""

    interval: Interval  # of the ratio; NaN where no pair says anything
    pairs: int
    shorter: int  # pairs in which the first got there on a shorter way, or alone
    first_missed: int  # runs of the first that did not get there
    second_missed: int

    @property
    def text(self) -> str:
        """Mean and interval."""
        return self.interval.text(2)


def ratio(
    rows: Iterable[Row], first: str, second: str, share: int = GOAL, seed: int = 0, axis: Axis = "metres"
) -> Ratio:
    """``exp(mean(log(T_first / T_second)))`` over starts that both agents ran, resampled by :func:`clusters`.

    Ratios are those of :func:`way_ratio`; pairs in which neither got there are in ``pairs`` only.
    """
    paired = pairs(rows, first, second)
    found = [(a, b, value) for a, b in paired if (value := way_ratio(a, b, share, axis)) is not None]
    logs = bootstrap_mean([math.log(v) for _, _, v in found], clusters([a for a, _, _ in found]), seed)
    mean, low, high = (float(np.exp(v)) for v in (logs.mean, logs.low, logs.high))
    return Ratio(
        Interval(mean, low, high, logs.tasks, logs.episodes),
        len(paired),
        sum(b[f"{axis}_{share}"] is None or value < 1.0 for a, b, value in found if a[f"{axis}_{share}"] is not None),
        sum(a[f"{axis}_{share}"] is None for a, _ in paired),
        sum(b[f"{axis}_{share}"] is None for _, b in paired),
    )


def pairs(rows: Iterable[Row], first: str, second: str) -> list[tuple[Row, Row]]:
    """The runs of two agents from the same start of the same scene under the same noise."""
    names = (*CONDITION, "task", "seed")
    of: dict[str, dict[tuple, Row]] = {first: {}, second: {}}
    for row in rows:
        if row["agent"] in of:
            of[row["agent"]][tuple(row[name] for name in names)] = row
    return [(row, of[second][key]) for key, row in of[first].items() if key in of[second]]


def clusters(rows: Sequence[Row]) -> list[Hashable]:
    """What is resampled together: the scene of each run, or its start where all are of one scene."""
    scenes = [row["scene_hash"] for row in rows]
    return scenes if len(set(scenes)) > 1 else [task_key(row) for row in rows]


def median(values: Sequence[float], units: Sequence[Hashable], seed: int = 0) -> Interval:
    """The median, whose values may be infinite, and its percentile interval, resampling ``units`` whole."""
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
    """The median of sorted ``x`` (n,) under each row of ``weights`` (m, n): of two in the middle their mean."""
    total = np.cumsum(weights, axis=1)
    lower, upper = (
        x[np.argmax(reached, axis=1)] for reached in (2 * total >= total[:, -1:], 2 * total > total[:, -1:])
    )
    return 0.5 * (lower + upper)


def median_way(rows: Sequence[Row], share: int, seed: int = 0, axis: Axis = "metres") -> Interval:
    """The median metres (or seconds) to ``share`` %; a run that did not get there is longer than any that did."""
    ways = [math.inf if row[f"{axis}_{share}"] is None else float(row[f"{axis}_{share}"]) for row in rows]
    return median(ways, clusters(rows), seed)


def at(row: Row, name: str, axis: str, grid: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """A run's curve ``name`` over ``axis`` (``metres`` | ``seconds``), NaN where it is not known.

    Between samples it is linear. After the end of a run that the agent ended it stays: the agent has chosen its map.
    After that of a run for which time was out nobody knows.
    """
    x = np.asarray(row["curve"][axis], dtype=float)
    y = np.array([np.nan if value is None else value for value in row["curve"][name]], dtype=float)
    found = np.interp(grid, x, y)
    return found if row["stopped"] else np.where(grid <= x[-1] + 1e-9, found, np.nan)


def mean_curve(
    rows: Sequence[Row], name: str, axis: str, grid: Float[np.ndarray, "n"], seed: int = 0
) -> Float[np.ndarray, "3 n"]:
    """Mean over runs and its 95 % interval at each point of ``grid``, resampling :func:`clusters`.

    NaN where fewer than ``KNOWN`` of the runs are known. There is no interval with one cluster.
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
        with np.errstate(invalid="ignore"):  # a resample of scenes that are not known there says nothing
            drawn = (weights @ sums[:, enough]) / (weights @ counts[:, enough])
        curve[1:, enough] = np.nanquantile(drawn, [0.025, 0.975], axis=0)
    return curve


def paired_at(
    rows: Iterable[Row], name: str, first: str, second: str, where: float, seed: int = 0, axis: Axis = "metres"
) -> Interval:
    """``mean(first - second)`` of a curve at an equal path length or time, over pairs in which both are known there."""
    paired = pairs(rows, first, second)
    grid = np.array([where])
    values = [float((at(a, name, axis, grid) - at(b, name, axis, grid))[0]) for a, b in paired]
    kept = [i for i, value in enumerate(values) if math.isfinite(value)]
    return bootstrap_mean([values[i] for i in kept], clusters([paired[i][0] for i in kept]), seed)
