"""What a sweep says in the end, one line an agent: the few numbers that an environment is judged by."""

from collections.abc import Callable, Mapping, Sequence

from vssm_gym.eval import aggregate, shares
from vssm_gym.eval.aggregate import Row
from vssm_gym.eval.explore_metrics import GOAL, median_way
from vssm_gym.eval.explore_tables import way

Column = Callable[[Sequence[Row]], str]


def _mean(metric: str) -> Column:
    return lambda rows: aggregate.mean(rows, metric).text()


def _percent(metric: str) -> Column:
    return lambda rows: shares.percent(rows, metric).text(1)


def _alone(metric: str, digits: int) -> Column:
    """The mean without its interval."""

    def text(rows: Sequence[Row]) -> str:
        interval = aggregate.mean(rows, metric)
        return f"{interval.mean:.{digits}f}" if interval.episodes else "-"

    return text


def _seconds(rows: Sequence[Row]) -> str:
    return _alone("seconds", 1)([row for row in rows if row["success"]])


SUMMARIES: Mapping[str, Mapping[str, Column]] = {
    "vssm_gym/PointNav-v0": {
        "SPL": _mean("spl"),
        "success": _mean("success"),
        "error m": _alone("location_error_mean", 3),
    },
    "vssm_gym/CarNav-v0": {
        "reached %": _percent("success"),
        "touched %": _percent("touched"),
        "seconds": _seconds,
    },
    "vssm_gym/Explore-v0": {
        f"m to {GOAL} %": lambda rows: way(median_way(rows, GOAL)),
        f"covered {GOAL} %": _percent("success"),
        "touched": lambda rows: str(sum(row["touched"] for row in rows)),
    },
}
"""By environment: heading and text of each column, from the rows of one agent in one condition."""
