"""Columns of the table that a sweep ends with, one line an agent."""

from collections.abc import Callable, Sequence

from vssm_gym.eval.metrics import aggregate
from vssm_gym.eval.metrics import proportions as shares
from vssm_gym.eval.metrics.aggregate import Row
from vssm_gym.eval.metrics.registry import METRICS

Column = Callable[[Sequence[Row]], str]


def mean(name: str) -> Column:
    """The mean of a metric, or the share in %, with its 95 % interval."""
    metric = METRICS[name]
    if metric.share:
        return lambda rows: shares.percent(rows, name).text(metric.digits)
    return lambda rows: aggregate.mean(rows, name).text(metric.digits)


def alone(name: str) -> Column:
    """The mean of a metric without its interval."""

    def text(rows: Sequence[Row]) -> str:
        interval = aggregate.mean(rows, name)
        return f"{interval.mean:.{METRICS[name].digits}f}" if interval.episodes else "-"

    return text
