"""Register every metric of an episode by name, in the order of columns, for tables, reports and summaries.

A row holds what an episode measured (:mod:`vssm_gym.eval.episodes.row`). Metrics are computed from rows, so that a new
metric also applies to episodes that ran before.
"""

from collections.abc import Mapping
from typing import Any

from vssm_gym.eval.metrics import navigation
from vssm_gym.eval.metrics.collision_rate import COLLISION_RATE
from vssm_gym.eval.metrics.metric import Metric, Row, Value, stored


def _spl(row: Row) -> Value:
    if row.get("geodesic") is None:
        return None
    return float(navigation.spl(row["success"], row["geodesic"], row["path_length"]))


def _collided(row: Row) -> Value:
    if row.get("collided") is not None:
        return bool(row["collided"])
    return None if row.get("collision_events") is None else row["collision_events"] > 0


def _of_successes(row: Row, value: Value) -> Value:
    return value if row["success"] else None


def _path_ratio(row: Row) -> Value:
    return row["path_length"] / row["geodesic"] if row["success"] and row.get("geodesic") else None


def _covered_99(row: Row) -> Value:
    return row["metres_99"] is not None if "metres_99" in row else None


def _metres(level: int) -> Metric:
    return Metric(stored(f"metres_{level}"), f"m to {level} %", 1, "lower", ("explore",))


def _decision(point: str) -> Any:
    """Return a function that reads the 50 % or 95 % point of an episode's whole decisions, ms."""

    def read(row: Row) -> Value:
        total = (row.get("latency") or {}).get("total")
        seconds = total[point] if total else row.get(f"decision_{point}")
        return None if seconds is None else 1e3 * seconds

    return read


def _on_its_map(field: str, factor: float) -> Any:
    """Return a function that reads a mean over the tasks that were driven on an explorer's map."""
    return lambda row: factor * row["navigation"][field] if row.get("navigation") else None


NAVIGATION, CAR, EXPLORE = ("navigation",), ("car",), ("explore",)
EVERY = (*NAVIGATION, *CAR, *EXPLORE)
SHARE_RANGE = (0.0, 1.0)  # of scores and proportions
PERCENT_RANGE = (0.0, 100.0)  # of proportions times 100
METRICS: dict[str, Metric] = {
    "spl": Metric(_spl, "SPL", 2, "higher", NAVIGATION, headline=NAVIGATION, compared=NAVIGATION, score=True),
    "success": Metric(
        stored("success"),
        "success",
        2,
        "higher",
        NAVIGATION,
        headline=NAVIGATION,
        compared=NAVIGATION,
        within=SHARE_RANGE,
    ),
    "soft_spl": Metric(stored("soft_spl"), "SoftSPL", 2, "higher", NAVIGATION, compared=NAVIGATION, score=True),
    "steps": Metric(stored("steps"), "steps", 0, "lower", NAVIGATION),
    "collisions": Metric(stored("collisions"), "collisions", 1, "lower", NAVIGATION),
    "collision_rate": COLLISION_RATE,
    "distance_to_goal": Metric(stored("distance_to_goal"), "to goal m", 2, "lower", NAVIGATION),
    "reached": Metric(stored("success"), "reached %", 1, "higher", CAR, headline=CAR, compared=CAR, proportion=True),
    "covered_90": Metric(stored("success"), "covered 90 %", 1, "higher", EXPLORE, proportion=True),
    "covered_99": Metric(_covered_99, "covered 99 %", 1, "higher", EXPLORE, proportion=True),
    **{f"metres_{level}": _metres(level) for level in (50, 90, 95, 99)},
    "seconds_90": Metric(stored("seconds_90"), "s to 90 %", 1, "lower", EXPLORE),
    "coverage_percent": Metric(
        stored("coverage", 100.0), "coverage %", 1, "higher", EXPLORE, compared=EXPLORE, within=PERCENT_RANGE
    ),
    "known": Metric(stored("entropy", -1e-3), "information, 10^3 nats", 1, "higher", EXPLORE, compared=EXPLORE),
    "complete_percent": Metric(
        stored("completeness", 100.0),
        "surface complete %",
        1,
        "higher",
        EXPLORE,
        compared=EXPLORE,
        within=PERCENT_RANGE,
    ),
    "accuracy_cm": Metric(stored("accuracy", 100.0), "mesh accuracy cm", 2, "lower", EXPLORE),
    "completion_cm": Metric(stored("completion", 100.0), "mesh completion cm", 2, "lower", EXPLORE, compared=EXPLORE),
    "collided": Metric(
        _collided, "collided %", 1, "lower", (*CAR, *EXPLORE), headline=CAR, compared=(*CAR, *EXPLORE), proportion=True
    ),
    "collision_events": Metric(stored("collision_events"), "collision events", 3, "lower", CAR),
    "seconds_driven": Metric(
        lambda row: _of_successes(row, row.get("seconds")), "seconds", 1, "lower", CAR, headline=CAR, compared=CAR
    ),
    "path_ratio": Metric(_path_ratio, "path / bound", 2, "lower", CAR, headline=CAR, compared=CAR),
    "direction_changes": Metric(
        stored("direction_changes"), "direction changes", 2, "lower", CAR, headline=CAR, compared=CAR
    ),
    "heading_error": Metric(stored("heading_error"), "heading error rad", 2, "lower", CAR),
    "location_error_mean": Metric(
        stored("location_error_mean"), "location error m", 3, "lower", EVERY, compared=NAVIGATION
    ),
    "location_error_final": Metric(stored("location_error_final"), "final error m", 3, "lower", NAVIGATION),
    "nees": Metric(stored("nees"), "NEES / dim", 2, "neither", EVERY),
    "in_95": Metric(stored("in_95"), "inside 95 %", 2, "neither", EVERY, within=SHARE_RANGE),
    "control_p50_ms": Metric(_decision("p50"), "control p50 ms", 1, "lower", CAR),
    "control_p95_ms": Metric(_decision("p95"), "control p95 ms", 1, "lower", CAR, headline=CAR),
    "navigation_success": Metric(
        _on_its_map("success", 100.0),
        "navigation success %",
        0,
        "higher",
        EXPLORE,
        compared=EXPLORE,
        within=PERCENT_RANGE,
    ),
    "navigation_spl": Metric(_on_its_map("spl", 1.0), "navigation SPL", 2, "higher", EXPLORE, within=SHARE_RANGE),
    "decision_p95_ms": Metric(_decision("p95"), "decision p95 ms", 0, "lower", EXPLORE),
}


def within(name: str) -> tuple[float, float] | None:
    """Return the range of a metric; None where it is not known, as of a field of rows that is no metric."""
    metric = METRICS.get(name)
    if metric is None:
        return None
    return SHARE_RANGE if metric.proportion or metric.score else metric.within


def shown_in(report: str) -> Mapping[str, Metric]:
    """Return the metrics of a kind of report."""
    return {name: metric for name, metric in METRICS.items() if report in metric.reports}


def measured(row: Row) -> dict[str, Any]:
    """Return a row with every metric added; a value that the row stores under a metric's name takes precedence."""
    return {**{name: metric.function(row) for name, metric in METRICS.items()}, **row}
