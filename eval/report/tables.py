"""Build the tables of a report: results with intervals, paired differences, latencies, failures by reason."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.row import identified
from vssm_gym.eval.metrics import aggregate, proportions
from vssm_gym.eval.metrics.aggregate import Interval
from vssm_gym.eval.metrics.metric import Metric, Row, check_name
from vssm_gym.eval.metrics.registry import shown_in
from vssm_gym.eval.metrics.training_runs import RUN, run_of
from vssm_gym.viz.html import Table


@dataclass(frozen=True)
class Measures:
    """Select and format the metrics of a kind of report: ``navigation``, ``car`` or ``explore``."""

    report: str

    @cached_property
    def metrics(self) -> Mapping[str, Metric]:
        """The metrics by name, in the order of columns."""
        return shown_in(self.report)

    @property
    def headline(self) -> list[str]:
        """The metrics that the page opens with."""
        return [name for name, metric in self.metrics.items() if self.report in metric.headline]

    @property
    def compared(self) -> list[str]:
        """The metrics whose paired differences are shown."""
        return [name for name, metric in self.metrics.items() if self.report in metric.compared]

    def label(self, name: str) -> str:
        """Return the heading of a metric's column."""
        return self.metrics[check_name(name)].label

    def mean(self, rows: Sequence[Row], name: str, seed: int) -> str:
        """Format the mean and 95 % interval of a metric as a cell."""
        value = proportions.percent if self.metrics[check_name(name)].proportion else aggregate.mean
        return self.text(name, value(rows, name, seed))

    def columns(self, names: Sequence[str]) -> dict[str, Callable[[Sequence[Row], int], str]]:
        """Return the heading of each column, and what formats its cells from rows and a seed.

        A score has two columns, its mean and its interquartile mean (IQM).
        """
        found: dict[str, Callable[[Sequence[Row], int], str]] = {}
        for name in names:
            found[self.label(name)] = partial(self._cell, name)
            if self.metrics[name].score:
                found[f"{self.label(name)} IQM"] = partial(self._middle, name)
        return found

    def _cell(self, name: str, rows: Sequence[Row], seed: int) -> str:
        return self.mean(rows, name, seed)

    def _middle(self, name: str, rows: Sequence[Row], seed: int) -> str:
        return self.text(name, aggregate.interquartile_mean(rows, name, seed))

    def scores(self, rows: Sequence[Row]) -> dict[str, str]:
        """Return the labels of the scores for which a row has a value, by name."""
        return {name: self.label(name) for name in known(rows, self) if self.metrics[name].score}

    def difference(
        self, rows: Sequence[Row], name: str, first: str, second: str, seed: int, by: str = "agent"
    ) -> Interval | None:
        """Compute the paired difference ``first - second`` of a metric; None where no shared episode has it."""
        try:
            paired = proportions.paired_percent if self.metrics[name].proportion else aggregate.paired_difference
            return paired(rows, name, first, second, seed, by)
        except InputError:
            return None

    def text(self, name: str, interval: Interval | None) -> str:
        """Format an interval with the metric's digits."""
        return interval.text(self.metrics[name].digits) if interval else "-"

    def directions(self, names: Sequence[str]) -> str:
        """Return a text like ``Higher is better: SPL, success. Lower is better: steps.``"""
        better = {
            word: [self.label(name) for name in names if self.metrics[name].direction == word]
            for word in ("higher", "lower")
        }
        return " ".join(f"{word.capitalize()} is better: {', '.join(of)}." for word, of in better.items() if of)


POINTNAV = Measures("navigation")
# Fields that the list of failures shows, where the environment measures them.
ENDS = {"distance_to_goal": "to goal m", "location_error_final": "error m"}
# Columns of the condition, in order; constant ones are not shown.
BY = ("scene", "noise", "sensor_noise", "renderer", "physics", "direction_frame", "agent")


def grouping(rows: Sequence[Row]) -> tuple[str, ...]:
    """Return the condition columns that vary over rows, and always scene and agent."""
    varies = lambda name: len({str(identified(row, name)) for row in rows}) > 1
    return tuple(name for name in BY if name in ("scene", "agent") or varies(name))


def pooled(rows: Sequence[Row]) -> tuple[str, ...]:
    """Return the condition columns that vary over rows, without scenes, which are pooled, and without the agent."""
    return tuple(name for name in grouping(rows) if name not in ("scene", "agent"))


def results(
    rows: Sequence[Row],
    seed: int,
    measures: Measures = POINTNAV,
    metrics: Sequence[str] = (),
    by: Sequence[str] | None = None,
) -> Table:
    """Tabulate mean and 95 % interval of each of ``metrics`` (all that are measured) for each group of rows.

    Args:
        rows: episodes.
        seed: of the resampling.
        measures: selects and formats metrics.
        metrics: the columns.
        by: fields that rows are grouped by; None: condition and agent.
    """
    by = grouping(rows) if by is None else by
    shown = measures.columns(known(rows, measures, [check_name(name) for name in metrics]))
    header = [*(name.replace("_", " ") for name in by), "episodes", *shown]
    lines = [
        [*group, str(len(members)), *(cell(members, seed) for cell in shown.values())]
        for group, members in aggregate.group_rows(rows, by).items()
    ]
    return Table(header, lines, len(by))


def of_each_run(rows: Sequence[Row], seed: int, measures: Measures) -> Table | None:
    """Tabulate the headline's metrics of each policy of the methods that have several; None without any.

    A policy by itself has an interval over tasks alone.
    """
    rows = [{**row, "agent": run_of(row), RUN: ""} for row in rows if run_of(row)]
    return results(rows, seed, measures, measures.headline) if rows else None


def known(rows: Sequence[Row], measures: Measures, metrics: Sequence[str] = ()) -> list[str]:
    """Return those of ``metrics``, or of all that the report shows, for which a row has a value."""
    return [metric for metric in metrics or measures.metrics if any(row.get(metric) is not None for row in rows)]


def headline(rows: Sequence[Row], seed: int, measures: Measures, by: Sequence[str]) -> Table:
    """Tabulate the metrics that a page opens with, for each group of rows."""
    return results(rows, seed, measures, measures.headline, by)


def reference_agent(rows: Sequence[Row]) -> str | None:
    """Return the agent that others are compared with: ``astar``, or the first; None with one agent.

    Rows are in the order of the configuration: a comparison with whichever agent did best would flatter it.
    """
    agents = list(dict.fromkeys(str(row["agent"]) for row in rows))
    if len(agents) < 2:
        return None
    return "astar" if "astar" in agents else agents[0]


def differences(rows: Sequence[Row], reference: str, seed: int, measures: Measures = POINTNAV) -> Table:
    """Tabulate paired differences ``reference - other`` over the episodes that both ran."""
    by = grouping(rows)[:-1]
    compared = known(rows, measures, measures.compared)
    names = [measures.label(metric) for metric in compared]
    header = [*(name.replace("_", " ") for name in by), "difference", "pairs", *names]
    lines = []
    for group, members in aggregate.group_rows(rows, by).items():
        for other in dict.fromkeys(str(row["agent"]) for row in members):
            if other == reference:
                continue
            found = {metric: measures.difference(members, metric, reference, other, seed) for metric in compared}
            pairs = max((interval.episodes for interval in found.values() if interval), default=0)
            cells = [measures.text(metric, interval) for metric, interval in found.items()]
            lines.append([*group, f"{reference} - {other}", str(pairs), *cells])
    return Table(header, lines, len(by) + 1)


def latencies(rows: Sequence[Row]) -> Table:
    """Tabulate latencies (ms) by agent and stage: medians of the episodes' 50 % and 95 % points, the largest 95 %."""
    lines = []
    for (agent,), members in aggregate.group_rows(rows, ["agent"]).items():
        for stage in dict.fromkeys(stage for row in members for stage in row.get("latency") or ()):
            p50, p95 = (
                1e3 * np.array([row["latency"][stage][p] for row in members if stage in (row.get("latency") or ())])
                for p in ("p50", "p95")
            )
            lines.append([agent, stage, f"{np.median(p50):.1f}", f"{np.median(p95):.1f}", f"{p95.max():.1f}"])
    return Table(["agent", "stage", "p50 ms", "p95 ms", "worst p95 ms"], lines, 2)


def responses(rows: Sequence[Row]) -> Table | None:
    """Tabulate the responses to failures an episode, over all scenes; None where no row has counted any."""
    totals = sum((Counter(row.get("responses") or {}) for row in rows), Counter[str]())
    if not totals:
        return None
    by = [name for name in grouping(rows) if name != "scene"]
    names = [name for name, _ in totals.most_common()]
    lines = []
    for group, members in aggregate.group_rows(rows, by).items():
        counting = [row["responses"] for row in members if row.get("responses") is not None]
        mean = lambda name, of: f"{sum(row.get(name, 0) for row in of) / len(of):.3f}" if of else "-"
        means = [mean(name, counting) for name in names]
        lines.append([*group, str(len(members)), *means])
    return Table([*(name.replace("_", " ") for name in by), "episodes", *names], lines, len(by))


def kind(reason: str) -> str:
    """Return the kind of a failure, the part of its reason before the colon."""
    return reason.partition(":")[0]


def failure_counts(rows: Sequence[Row]) -> Table:
    """Count each agent's failures by kind, and its episodes with a collision where rows have that field.

    Groups without any are left out.
    """
    by = grouping(rows)
    kinds = sorted({kind(row["failure"]) for row in rows if row["failure"]})
    collided = ["collided"] if any(row.get("collided") for row in rows) else []
    lines = []
    for group, members in aggregate.group_rows(rows, by).items():
        counts = Counter(kind(row["failure"]) for row in members if row["failure"])
        failed = f"{counts.total()} of {len(members)}"
        counts.update({name: sum(bool(row[name]) for row in members) for name in collided})
        if not counts.total():
            continue
        lines.append([*group, failed, *(str(counts[name]) if counts[name] else "" for name in (*kinds, *collided))])
    header = [*(name.replace("_", " ") for name in by), "failed", *kinds, *collided]
    return Table(header, lines, len(by))


def failure_list(rows: Sequence[Row]) -> Table:
    """List every failed episode with its reason."""
    by, failed = grouping(rows), [row for row in rows if row["failure"]]
    ends = {name: label for name, label in ENDS.items() if any(row.get(name) is not None for row in failed)}
    lines = [
        [
            *(str(identified(row, name)) for name in by[:-1]),
            run_of(row) or str(row["agent"]),
            str(row["task"]),
            str(row["seed"]),
            row["failure"],
            str(row.get("steps") or "-"),
            *("-" if row.get(name) is None else f"{row[name]:.2f}" for name in ends),
        ]
        for row in failed
    ]
    header = [*(name.replace("_", " ") for name in by), "task", "seed", "reason", "steps", *ends.values()]
    return Table(header, lines, len(by) + 3, sentences=("reason",))
