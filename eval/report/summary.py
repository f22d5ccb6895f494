"""Format the columns of the table that a sweep prints at its end, one line an agent."""

from collections.abc import Callable, Sequence

from vssm_gym.eval.metrics import aggregate, proportions
from vssm_gym.eval.metrics.metric import Row, check_name
from vssm_gym.eval.metrics.registry import METRICS

Column = Callable[[Sequence[Row]], str]


def mean(name: str) -> Column:
    """Return a column of a metric's mean, or proportion in %, with its 95 % interval."""
    metric = METRICS[check_name(name)]
    if metric.proportion:
        return lambda rows: proportions.percent(rows, name).text(metric.digits)
    return lambda rows: aggregate.mean(rows, name).text(metric.digits)


def alone(name: str) -> Column:
    """Return a column of a metric's mean without its interval."""

    def text(rows: Sequence[Row]) -> str:
        interval = aggregate.mean(rows, name)
        return f"{interval.mean:.{METRICS[name].digits}f}" if interval.episodes else "-"

    return text
