"""Compute proportions of episodes (reached, collided) with 95 % intervals that also hold for rare events.

A bootstrap of zeros gives [0, 0], however few they are. Here the interval of 0 of n reaches to about 3.7 / n. The unit
is the task, as in :mod:`vssm_gym.eval.metrics.aggregate`: n tasks with several episodes each count as n trials whose
successes are the tasks' mean proportions, which is exact for one episode a task and conservative for more.

The runs of a training are no such trials: where a method has several, tasks and runs are resampled together instead.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from scipy import stats
from scipy.optimize import brentq

from vssm_gym.eval.episodes.row import identified
from vssm_gym.eval.metrics.aggregate import Interval, having, mean, paired_difference, paired_values, task_key
from vssm_gym.eval.metrics.metric import Row
from vssm_gym.eval.metrics.training_runs import has_several

TAIL = 0.025  # probability beyond either end of an interval of 95 %


def clopper_pearson(k: float, n: int) -> tuple[float, float]:
    """Return the interval of p where ``P(X >= k | n, p)`` and ``P(X <= k | n, p)`` are at least 2.5 %, X binomial.

    Never covers less than 95 % (Clopper and Pearson, 1934). ``k`` in [0, n] may be a fraction; ``n`` >= 1.
    """
    low = float(stats.beta.ppf(TAIL, k, n - k + 1)) if k > 0 else 0.0
    high = float(stats.beta.ppf(1.0 - TAIL, k + 1, n - k)) if k < n else 1.0
    return low, high


def tango(gained: float, lost: float, n: int) -> tuple[float, float]:
    """Return the differences ``d`` of paired proportions with ``|b - c - n d| <= 1.96 sqrt(n (2 q + d (1 - d)))``.

    Of n pairs ``b = gained`` hold only for the first and ``c = lost`` only for the second; ``q`` is the most likely
    proportion of the latter if ``d`` is true (Tango, 1998). Without disagreement the interval reaches to 3.8 / (n +
    3.8).
    """
    z = float(stats.norm.ppf(1.0 - TAIL))

    def score(d: float) -> float:
        linear, constant = (2 * n - gained + lost) * d - gained - lost, -lost * d * (1.0 - d)
        q = (np.sqrt(max(linear**2 - 8.0 * n * constant, 0.0)) - linear) / (4.0 * n)
        return (gained - lost - n * d) / np.sqrt(max(n * (2.0 * q + d * (1.0 - d)), 1e-12))

    # The score falls with d, and is 0 at the estimate.
    middle, edge = (gained - lost) / n, 1.0 - 1e-9
    low = brentq(lambda d: score(d) - z, -edge, middle) if middle > -edge and score(-edge) > z else -1.0
    high = brentq(lambda d: score(d) + z, middle, edge) if middle < edge and score(edge) < -z else 1.0
    return float(low), float(high)


def percent(rows: Iterable[Row], metric: str, seed: int = 0) -> Interval:
    """Compute the proportion of episodes with the boolean ``metric``, in %, with Clopper and Pearson's interval.

    Of several runs of a training, with the bootstrap's; ``seed`` is of its resampling.
    """
    present = having(rows, metric)
    if not present:
        return Interval(np.nan, np.nan, np.nan, 0, 0)
    if has_several(present):
        return mean(present, metric, seed).times(100.0)
    values, n = [float(row[metric]) for row in present], len(set(map(task_key, present)))
    proportion = float(np.mean(values))
    low, high = clopper_pearson(proportion * n, n)
    return Interval(100.0 * proportion, 100.0 * low, 100.0 * high, n, len(values))


def paired_percent(
    rows: Iterable[Row], metric: str, first: str, second: str, seed: int = 0, by: str = "agent"
) -> Interval:
    """Compute ``first - second`` in points of % over episodes that both ran, with Tango's interval.

    Where one of them has several runs, with that of :func:`vssm_gym.eval.metrics.aggregate.paired_difference`. Raises
    like it.
    """
    rows = list(rows)
    if any(has_several(row for row in rows if identified(row, by) == name) for name in (first, second)):
        return paired_difference(rows, metric, first, second, seed, by).times(100.0)
    differences, tasks = paired_values(rows, metric, first, second, by)
    n = len(set(tasks))
    weight = n / len(differences)
    low, high = tango(weight * _count(differences, 1.0), weight * _count(differences, -1.0), n)
    return Interval(100.0 * float(np.mean(differences)), 100.0 * low, 100.0 * high, n, len(differences))


def _count(differences: Sequence[float], sign: float) -> int:
    return int(np.count_nonzero(np.asarray(differences) == sign))
