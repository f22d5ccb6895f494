"""The car's tables (SPEC 7): what its episodes are measured by, and its two simulators side by side."""

from collections.abc import Sequence
from typing import Any

from vssm_gym.eval import aggregate
from vssm_gym.eval.aggregate import Row
from vssm_gym.eval.report_tables import Measures, grouping, html_table

CAR = Measures(
    names={
        "success": "reached %",
        "touched": "touched %",
        "touches": "touches",
        "seconds_driven": "seconds",
        "path_ratio": "path / bound",
        "direction_changes": "direction changes",
        "heading_error": "heading error rad",
        "location_error_mean": "location error m",
        "decision_p50": "control p50 ms",
        "decision_p95": "control p95 ms",
    },
    headline=("success", "touched", "seconds_driven", "path_ratio", "direction_changes", "decision_p95"),
    compared=("success", "touched", "seconds_driven", "path_ratio", "direction_changes"),
    digits={
        "success": 1,
        "touched": 1,
        "touches": 3,
        "seconds_driven": 1,
        "location_error_mean": 3,
        "decision_p50": 1,
        "decision_p95": 1,
    },
    shares=frozenset({"success", "touched"}),
)
SIMULATORS = ("mujoco", "bullet")


def measured(row: Row) -> dict[str, Any]:
    """A row with what follows from it; None where it says nothing.

    ``seconds_driven`` and ``path_ratio`` (path over the shortest Reeds-Shepp curve, obstacles apart, at least 1 up to
    the rounding of its lattice) are of the episodes that reached their target. ``decision_p50, _p95`` (ms) are of whole
    decisions: localisation, plan and command.
    """
    total = row["latency"].get("total")
    return {
        **row,
        "seconds_driven": row["seconds"] if row["success"] else None,
        "path_ratio": row["path_length"] / row["geodesic"] if row["success"] else None,
        **{f"decision_{p}": 1e3 * total[p] if total else None for p in ("p50", "p95")},
    }


def pooled(rows: Sequence[Row]) -> tuple[str, ...]:
    """What the headline groups by: the conditions without scenes and simulators, over which it counts all targets."""
    return tuple(name for name in grouping(rows) if name not in ("scene", "physics"))


def simulators(rows: Sequence[Row], seed: int) -> str | None:
    """Each agent's metrics in one simulator, in the other, and the paired difference; None where one did not run.

    Agents plan on the bicycle's kinematics whichever simulator executes; both run the same targets and seeds.
    """
    first, second = SIMULATORS
    by, names = pooled(rows), [CAR.names[metric] for metric in CAR.compared]
    lines = []
    for group, members in aggregate.group_rows(rows, by).items():
        of = aggregate.group_rows(members, ["physics"])
        if not {(first,), (second,)} <= of.keys():
            continue
        for name in SIMULATORS:
            ran = of[name,]
            lines.append([*group, name, str(len(ran)), *(CAR.mean(ran, metric, seed) for metric in CAR.compared)])
        found = {m: CAR.difference(members, m, second, first, seed, "physics") for m in CAR.compared}
        pairs = max((interval.episodes for interval in found.values() if interval), default=0)
        cells = [CAR.text(metric, interval) for metric, interval in found.items()]
        lines.append([*group, f"{second} - {first}", str(pairs), *cells])
    header = [*(name.replace("_", " ") for name in by), "executed in", "episodes", *names]
    return html_table(header, lines, len(by) + 1) if lines else None
