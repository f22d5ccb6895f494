"""Rank the agents of a sweep by the main metric of its environment, and summarise it: what a page opens with.

Agents that are no contestants stand last: one that acts at random, and one that is given what the others estimate.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from vssm_gym.errors import InputError
from vssm_gym.eval.metrics import aggregate, exploration, proportions
from vssm_gym.eval.metrics.aggregate import Interval
from vssm_gym.eval.metrics.metric import Row
from vssm_gym.eval.metrics.registry import METRICS
from vssm_gym.viz.html import Tile

# Bounds of a score: they order nothing.
BASELINES = ("oracle", "slam_nav_true_pose", "random", "random_walk", "random_viewpoint")
NO_DIFFERENCE, DIFFERENCE, UNKNOWN = "no clear difference", "a difference", "too few pairs for an interval"

Measure = Callable[[Sequence[Row], int], Interval]


@dataclass(frozen=True)
class Criterion:
    """Define a measure by which agents are ordered.

    Attributes:
        label: heading.
        best: the superlative of a sentence, such as ``the highest SPL``.
        unit: what follows the number there.
        digits: after the point.
        higher: whether higher values are better.
        value: of the rows of one agent, with a seed of the resampling.
    """

    label: str
    best: str
    unit: str
    digits: int
    higher: bool
    value: Measure

    def key(self, rows: Sequence[Row]) -> float:
        """Return a number that is lower for better rows; unknown values are last."""
        mean = self.value(rows, 0).mean
        if math.isnan(mean):
            return math.inf
        return -mean if self.higher else mean

    def text(self, interval: Interval) -> str:
        """Format a value as a cell; ``never`` where a run that did not reach a level bounds it."""
        if math.isinf(interval.mean) or math.isinf(interval.high):
            shown = ("never" if math.isinf(v) else f"{v:.{self.digits}f}" for v in _values(interval))
            mean, low, high = shown
            return f"{mean} [-]" if math.isnan(interval.low) else f"{mean} [{low}, {high}]"
        return interval.text(self.digits)


def by_metric(name: str, best: str = "", unit: str = "") -> Criterion:
    """Return the criterion of a metric's mean, or of its proportion in %."""
    metric = METRICS[name]
    of = proportions.percent if metric.proportion else aggregate.mean
    value: Measure = lambda rows, seed: of(rows, name, seed)
    return Criterion(metric.label, best, unit, metric.digits, metric.direction == "higher", value)


def by_median(level: int) -> Criterion:
    """Return the criterion of explorers: the median path length to ``level`` % of coverage, m."""
    best = f"the shortest median path to {level} % coverage"
    value: Measure = lambda rows, seed: exploration.median_to_level(rows, level, seed)
    return Criterion(f"m to {level} %", best, " m", 1, False, value)


@dataclass(frozen=True)
class Versus:
    """Hold the paired comparison of the leader with the next agent, as text."""

    text: str
    verdict: str


Comparison = Callable[[Sequence[Row], str, str, int], Versus | None]


def paired_difference(name: str) -> Comparison:
    """Return a comparison by the paired difference of a metric, over the episodes that both agents ran."""

    def compare(rows: Sequence[Row], first: str, second: str, seed: int) -> Versus | None:
        paired = proportions.paired_percent if METRICS[name].proportion else aggregate.paired_difference
        try:
            found = paired(rows, name, first, second, seed)
        except InputError:  # they share no episode
            return None
        return _versus(found, METRICS[name].digits + 1, 0.0)

    return compare


def paired_ratio(level: int) -> Comparison:
    """Return a comparison by the ratio of path lengths to ``level`` % of coverage."""

    def compare(rows: Sequence[Row], first: str, second: str, seed: int) -> Versus | None:
        found = exploration.ratio(rows, first, second, level, seed).interval
        return _versus(found, 2, 1.0) if found.episodes else None

    return compare


def _versus(found: Interval, digits: int, same: float) -> Versus:
    if math.isnan(found.low):
        return Versus(found.text(digits), UNKNOWN)
    return Versus(found.text(digits), NO_DIFFERENCE if found.low <= same <= found.high else DIFFERENCE)


@dataclass(frozen=True)
class Ranking:
    """Define how the agents of an environment are ranked.

    Attributes:
        main: what a report of the environment is about.
        then: what orders agents that are equal in it.
        compare: the leader with the next agent, by the main measure.
        compared: name of the number that ``compare`` returns.
        compare_then, compared_then: the same by ``then``, for agents that are equal.
        shown: metrics of the leader that tiles show.
    """

    main: Criterion
    then: Criterion
    compare: Comparison
    compared: str
    compare_then: Comparison
    compared_then: str
    shown: tuple[str, ...]

    def order(self, rows: Sequence[Row]) -> list[str]:
        """Return the agents, best first and baselines last; equal ones keep the order of the rows."""
        groups = {name: members for (name,), members in aggregate.group_rows(rows, ["agent"]).items()}
        rank = lambda name: (name in BASELINES, self.main.key(groups[name]), self.then.key(groups[name]))
        return sorted(groups, key=rank)


@dataclass(frozen=True)
class Bar:
    """Hold mean and interval in % of the width of the chart, as text."""

    mean: str
    low: str
    width: str


@dataclass(frozen=True)
class Standing:
    """Hold one line of the ranking."""

    agent: str
    text: str
    episodes: int
    is_baseline: bool
    bar: Bar | None


@dataclass(frozen=True)
class Summary:
    """Hold what a page opens with.

    Attributes:
        standings: all agents, best first.
        leader: the best agent that is no baseline, or the first of the baselines.
        others: the number of its rivals.
        tied: the number of rivals whose main measure equals the leader's.
        best, unit: of the main measure (:class:`Criterion`).
        label: its heading.
        second: the standing after the leader; None where there is no rival.
        versus: the two compared in pairs; None where no pair ran.
        compared: what ``versus`` states.
        then: of what orders equal agents, the superlative, and the values of the leader and the second.
        tiles: the numbers.
    """

    standings: list[Standing]
    leader: Standing
    others: int
    tied: int
    best: str
    unit: str
    label: str
    second: Standing | None
    versus: Versus | None
    compared: str
    then: tuple[str, str, str]
    tiles: list[Tile]


def summarise(ranking: Ranking, rows: Sequence[Row], seed: int) -> Summary:
    """Summarise a sweep.

    Args:
        ranking: of the environment.
        rows: finished episodes.
        seed: of the resampling.
    """
    groups = {name: members for (name,), members in aggregate.group_rows(rows, ["agent"]).items()}
    values = {name: ranking.main.value(groups[name], seed) for name in ranking.order(rows)}
    ends = [v for interval in values.values() for v in _values(interval) if math.isfinite(v)]
    most = max(ends, default=0.0)
    standings = [
        Standing(name, ranking.main.text(value), len(groups[name]), name in BASELINES, _bar(value, most))
        for name, value in values.items()
    ]
    contest = [standing for standing in standings if not standing.is_baseline] or standings
    leader, rivals = contest[0], contest[1:]
    tied = sum(values[rival.agent].mean == values[leader.agent].mean for rival in rivals)
    compare = ranking.compare_then if tied else ranking.compare
    then = [ranking.then.text(ranking.then.value(groups[one.agent], seed)) + ranking.then.unit for one in contest[:2]]
    return Summary(
        standings,
        leader,
        len(rivals),
        tied,
        ranking.main.best,
        ranking.main.unit,
        ranking.main.label,
        rivals[0] if rivals else None,
        compare(rows, leader.agent, rivals[0].agent, seed) if rivals else None,
        ranking.compared_then if tied else ranking.compared,
        (ranking.then.best, then[0], then[-1]),
        _tiles(ranking, leader, groups[leader.agent], len(rivals), tied, seed),
    )


def _tiles(ranking: Ranking, leader: Standing, members: Sequence[Row], rivals: int, tied: int, seed: int) -> list[Tile]:
    best = f"best of {rivals + 1} by {ranking.main.label}" if rivals else "the only agent"
    if tied:
        best += f", then {ranking.then.label}"
    failed = sum(bool(row["failure"]) for row in members)
    tiles = [
        Tile("agent", leader.agent, best, is_word=True),
        _measured(ranking.main.label, leader.text, "main"),
        *(
            _measured(criterion.label, criterion.text(criterion.value(members, seed)))
            for criterion in map(by_metric, ranking.shown)
        ),
        Tile("failures", str(failed), f"of its {len(members)} episodes", "bad" if failed else "good"),
    ]
    return [tile for tile in tiles if tile.value != "-"]


def _measured(label: str, text: str, kind: str = "") -> Tile:
    mean, _, interval = text.partition(" [")
    return Tile(label, mean, f"[{interval}" if interval and interval != "-]" else "", kind)


def _bar(interval: Interval, most: float) -> Bar | None:
    """Scale an interval to the chart; None where its mean is unknown, infinite or negative."""
    if not 0.0 <= interval.mean < math.inf or most <= 0.0:
        return None
    known = replace(interval, low=interval.mean, high=interval.mean) if math.isnan(interval.low) else interval
    low, high = (min(max(100.0 * v / most, 0.0), 100.0) for v in (known.low, known.high))
    return Bar(f"{100.0 * known.mean / most:.1f}", f"{low:.1f}", f"{high - low:.1f}")


def _values(interval: Interval) -> tuple[float, float, float]:
    return interval.mean, interval.low, interval.high
