"""The tables of a report as HTML: results with intervals, paired differences, latencies, failures by reason."""

from collections import Counter
from collections.abc import Sequence
from html import escape

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.eval import aggregate
from vssm_gym.eval.aggregate import Row

METRICS = {
    "spl": "SPL",
    "success": "success",
    "soft_spl": "SoftSPL",
    "steps": "steps",
    "collisions": "collisions",
    "touched": "touched",
    "seconds": "seconds",
    "direction_changes": "direction changes",
    "heading_error": "heading error rad",
    "distance_to_goal": "to goal m",
    "location_error_mean": "location error m",
    "location_error_final": "final error m",
}
DIGITS = {"steps": 0, "collisions": 1, "location_error_mean": 3, "location_error_final": 3}
DIFFERENCES = ("spl", "success", "soft_spl", "location_error_mean")
# The order of columns; the constant ones are not shown.
BY = ("scene", "noise", "sensor_noise", "renderer", "physics", "agent")


def html_table(header: Sequence[str], lines: Sequence[Sequence[str]], numbers_from: int) -> str:
    """A table whose columns from ``numbers_from`` on are right-aligned; cells are escaped here."""
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = "".join(
        "<tr>"
        + "".join(f"<td{' class=n' if i >= numbers_from else ''}>{escape(cell)}</td>" for i, cell in enumerate(line))
        + "</tr>"
        for line in lines
    )
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def grouping(rows: Sequence[Row]) -> tuple[str, ...]:
    """The condition columns that tell rows apart, always with scene, noise and agent."""
    return tuple(
        name for name in BY if name in ("scene", "noise", "agent") or len({str(row[name]) for row in rows}) > 1
    )


def results(rows: Sequence[Row], seed: int, metrics: Sequence[str] = tuple(METRICS)) -> str:
    """Mean and 95 % interval of each metric for each condition and agent."""
    by = grouping(rows)
    metrics = [metric for metric in metrics if any(row.get(metric) is not None for row in rows)]
    header = [*(name.replace("_", " ") for name in by), "episodes", *(METRICS[metric] for metric in metrics)]
    lines = [
        [*line.group, str(line.episodes), *(line.values[m].text(DIGITS.get(m, 2)) for m in metrics)]
        for line in aggregate.table(rows, metrics, by, seed)
    ]
    return html_table(header, lines, len(by))


def reference_agent(rows: Sequence[Row]) -> str | None:
    """The agent that others are compared with: ``astar`` where it ran, else the first; None when alone."""
    agents = list(dict.fromkeys(str(row["agent"]) for row in rows))
    if len(agents) < 2:
        return None
    return "astar" if "astar" in agents else agents[0]


def differences(rows: Sequence[Row], reference: str, seed: int) -> str:
    """Paired differences ``reference - other`` over the episodes that both ran."""
    by = grouping(rows)[:-1]
    header = [*(name.replace("_", " ") for name in by), "difference", "pairs", *(METRICS[m] for m in DIFFERENCES)]
    lines = []
    for group, members in aggregate.group_rows(rows, by).items():
        for other in dict.fromkeys(str(row["agent"]) for row in members):
            if other == reference:
                continue
            intervals = [_difference(members, metric, reference, other, seed) for metric in DIFFERENCES]
            pairs = max((interval.episodes for interval in intervals if interval), default=0)
            cells = [i.text(DIGITS.get(m, 2)) if i else "-" for m, i in zip(DIFFERENCES, intervals, strict=True)]
            lines.append([*group, f"{reference} - {other}", str(pairs), *cells])
    return html_table(header, lines, len(by) + 1)


def _difference(rows: Sequence[Row], metric: str, agent: str, other: str, seed: int) -> aggregate.Interval | None:
    try:
        return aggregate.paired_difference(rows, metric, agent, other, seed)
    except InputError:  # an agent that keeps no estimate has no location error to compare
        return None


def latencies(rows: Sequence[Row]) -> str:
    """Milliseconds by agent and stage: medians of the episodes' 50 % and 95 % points, and the worst 95 % point."""
    lines = []
    for (agent,), members in aggregate.group_rows(rows, ["agent"]).items():
        for stage in dict.fromkeys(stage for row in members for stage in row["latency"]):
            p50, p95 = (
                1e3 * np.array([row["latency"][stage][p] for row in members if stage in row["latency"]])
                for p in ("p50", "p95")
            )
            lines.append([agent, stage, f"{np.median(p50):.1f}", f"{np.median(p95):.1f}", f"{p95.max():.1f}"])
    return html_table(["agent", "stage", "p50 ms", "p95 ms", "worst p95 ms"], lines, 2)


def kind(reason: str) -> str:
    """The part of a failure's reason before the colon: what failures are counted by."""
    return reason.partition(":")[0]


def failure_counts(rows: Sequence[Row]) -> str:
    """How often each agent failed for each kind of reason."""
    by = grouping(rows)
    kinds = sorted({kind(row["failure"]) for row in rows if row["failure"]})
    lines = []
    for group, members in aggregate.group_rows(rows, by).items():
        counts = Counter(kind(row["failure"]) for row in members if row["failure"])
        failed = f"{counts.total()} of {len(members)}"
        lines.append([*group, failed, *(str(counts[name]) if counts[name] else "" for name in kinds)])
    return html_table([*(name.replace("_", " ") for name in by), "failed", *kinds], lines, len(by))


def failure_list(rows: Sequence[Row]) -> str:
    """Every failed episode with its reason."""
    by = grouping(rows)
    lines = [
        [
            *(str(row[name]) for name in by),
            str(row["task"]),
            str(row["seed"]),
            row["failure"],
            str(row["steps"]),
            f"{row['distance_to_goal']:.2f}",
            "-" if row["location_error_final"] is None else f"{row['location_error_final']:.2f}",
        ]
        for row in rows
        if row["failure"]
    ]
    header = [*(name.replace("_", " ") for name in by), "task", "seed", "reason", "steps", "to goal m", "error m"]
    return html_table(header, lines, len(by) + 3)
