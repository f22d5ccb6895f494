"""The tables of a report as HTML: results with intervals, paired differences, latencies, failures by reason."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.eval.metrics import aggregate
from vssm_gym.eval.metrics import proportions as shares
from vssm_gym.eval.metrics.aggregate import Interval, Row
from vssm_gym.eval.metrics.metric import Metric
from vssm_gym.eval.metrics.registry import shown_in
from vssm_gym.viz.html import html_table


@dataclass(frozen=True)
class Measures:
    """The metrics of a kind of report, as its tables show them: ``navigation``, ``car`` or ``explore``."""

    report: str

    @cached_property
    def metrics(self) -> Mapping[str, Metric]:
        """By name, in the order of columns."""
        return shown_in(self.report)

    @property
    def headline(self) -> list[str]:
        """The metrics that the page opens with."""
        return [name for name, metric in self.metrics.items() if self.report in metric.headline]

    @property
    def compared(self) -> list[str]:
        """Those whose paired differences are shown."""
        return [name for name, metric in self.metrics.items() if self.report in metric.compared]

    def label(self, name: str) -> str:
        """The heading of a metric's column."""
        return self.metrics[name].label

    def mean(self, rows: Sequence[Row], name: str, seed: int) -> str:
        """Mean and 95 % interval of a metric, as a cell."""
        share = self.metrics[name].share
        return self.text(name, shares.percent(rows, name) if share else aggregate.mean(rows, name, seed))

    def difference(
        self, rows: Sequence[Row], name: str, first: str, second: str, seed: int, by: str = "agent"
    ) -> Interval | None:
        """Paired ``first - second`` of a metric; None where they share nothing to compare, as with an agent that keeps
        no estimate and so has no location error."""
        try:
            if self.metrics[name].share:
                return shares.paired_percent(rows, name, first, second, by)
            return aggregate.paired_difference(rows, name, first, second, seed, by)
        except InputError:
            return None

    def text(self, name: str, interval: Interval | None) -> str:
        """The cell of an interval, with the metric's digits."""
        return interval.text(self.metrics[name].digits) if interval else "-"

    def directions(self, names: Sequence[str]) -> str:
        """``Higher is better: SPL, success. Lower is better: steps.``"""
        better = {
            word: [self.label(name) for name in names if self.metrics[name].direction == word]
            for word in ("higher", "lower")
        }
        return " ".join(f"{word.capitalize()} is better: {', '.join(of)}." for word, of in better.items() if of)


POINTNAV = Measures("navigation")
# How a failed episode ended, as far as its environment measures it.
ENDS = {"distance_to_goal": "to goal m", "location_error_final": "error m"}
# The order of columns; the constant ones are not shown.
BY = ("scene", "noise", "sensor_noise", "renderer", "physics", "agent")


def grouping(rows: Sequence[Row]) -> tuple[str, ...]:
    """The condition columns that tell rows apart, always with scene, noise and agent."""
    return tuple(
        name for name in BY if name in ("scene", "noise", "agent") or len({str(row[name]) for row in rows}) > 1
    )


def results(
    rows: Sequence[Row],
    seed: int,
    measures: Measures = POINTNAV,
    metrics: Sequence[str] = (),
    by: Sequence[str] | None = None,
) -> str:
    """Mean and 95 % interval of each of ``metrics`` (all that are measured) for each group of rows.

    Args:
        rows: episodes.
        seed: of the resampling.
        measures: how metrics are shown.
        metrics: the columns.
        by: what rows are grouped by: the condition and agent.
    """
    by = grouping(rows) if by is None else by
    shown = known(rows, measures, metrics)
    header = [*(name.replace("_", " ") for name in by), "episodes", *(measures.label(metric) for metric in shown)]
    lines = [
        [*group, str(len(members)), *(measures.mean(members, metric, seed) for metric in shown)]
        for group, members in aggregate.group_rows(rows, by).items()
    ]
    return html_table(header, lines, len(by))


def known(rows: Sequence[Row], measures: Measures, metrics: Sequence[str] = ()) -> list[str]:
    """Those of ``metrics``, or of all that the report shows, of which a row says something."""
    return [metric for metric in metrics or measures.metrics if any(row.get(metric) is not None for row in rows)]


def headline(rows: Sequence[Row], seed: int, measures: Measures, by: Sequence[str]) -> str:
    """The measures that a page opens with, for each group of rows."""
    return results(rows, seed, measures, measures.headline, by)


def reference_agent(rows: Sequence[Row]) -> str | None:
    """The agent that others are compared with: ``astar`` where it ran, else the first; None when alone."""
    agents = list(dict.fromkeys(str(row["agent"]) for row in rows))
    if len(agents) < 2:
        return None
    return "astar" if "astar" in agents else agents[0]


def differences(rows: Sequence[Row], reference: str, seed: int, measures: Measures = POINTNAV) -> str:
    """Paired differences ``reference - other`` over the episodes that both ran."""
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
    return html_table(header, lines, len(by) + 1)


def latencies(rows: Sequence[Row]) -> str:
    """Milliseconds by agent and stage: medians of the episodes' 50 % and 95 % points, and the worst 95 % point."""
    lines = []
    for (agent,), members in aggregate.group_rows(rows, ["agent"]).items():
        for stage in dict.fromkeys(stage for row in members for stage in row.get("latency") or ()):
            p50, p95 = (
                1e3 * np.array([row["latency"][stage][p] for row in members if stage in (row.get("latency") or ())])
                for p in ("p50", "p95")
            )
            lines.append([agent, stage, f"{np.median(p50):.1f}", f"{np.median(p95):.1f}", f"{p95.max():.1f}"])
    return html_table(["agent", "stage", "p50 ms", "p95 ms", "worst p95 ms"], lines, 2)


def kind(reason: str) -> str:
    """The part of a failure's reason before the colon: what failures are counted by."""
    return reason.partition(":")[0]


def failure_counts(rows: Sequence[Row]) -> str:
    """How often each agent failed for each kind of reason, and touched something where that is counted by episode."""
    by = grouping(rows)
    kinds = sorted({kind(row["failure"]) for row in rows if row["failure"]})
    touched = ["touched"] if any(row.get("touched") for row in rows) else []
    lines = []
    for group, members in aggregate.group_rows(rows, by).items():
        counts = Counter(kind(row["failure"]) for row in members if row["failure"])
        failed = f"{counts.total()} of {len(members)}"
        counts.update({name: sum(bool(row[name]) for row in members) for name in touched})
        lines.append([*group, failed, *(str(counts[name]) if counts[name] else "" for name in (*kinds, *touched))])
    header = [*(name.replace("_", " ") for name in by), "failed", *kinds, *touched]
    return html_table(header, lines, len(by))


def failure_list(rows: Sequence[Row]) -> str:
    """Every failed episode with its reason."""
    by, failed = grouping(rows), [row for row in rows if row["failure"]]
    ends = {name: said for name, said in ENDS.items() if any(row.get(name) is not None for row in failed)}
    lines = [
        [
            *(str(row[name]) for name in by),
            str(row["task"]),
            str(row["seed"]),
            row["failure"],
            str(row.get("steps") or "-"),
            *("-" if row.get(name) is None else f"{row[name]:.2f}" for name in ends),
        ]
        for row in failed
    ]
    header = [*(name.replace("_", " ") for name in by), "task", "seed", "reason", "steps", *ends.values()]
    return html_table(header, lines, len(by) + 3)
