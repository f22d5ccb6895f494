"""Compute means over tasks with 95 % bootstrap intervals, and paired differences between agents.

The resampled unit is the *task*: episodes of one task under several seeds share their start, goal and corridor and are
not independent, so they enter and leave a resample together (a cluster bootstrap).
"""

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.row import DEFAULTS, KEY, identified
from vssm_gym.eval.metrics.metric import Row, check_name

RESAMPLES = 4000  # the Monte Carlo error of a 2.5 % quantile is then below 0.3 % of probability
# Fields that the two episodes of a pair share.
CONDITION = tuple(name for name in (*KEY, *DEFAULTS) if name not in ("task", "seed", "agent"))


@dataclass(frozen=True)
class Interval:
    """Hold a mean and its 95 % percentile interval; bounds are NaN with fewer than two tasks to resample."""

    mean: float
    low: float
    high: float
    tasks: int  # independent clusters behind the mean
    episodes: int

    def text(self, digits: int = 2) -> str:
        """Return ``mean [low, high]``; a dash where there is no mean or interval."""
        if not np.isfinite(self.mean):
            return "-"
        mean, low, high = (f"{value:z.{digits}f}" for value in (self.mean, self.low, self.high))  # z: no "-0.00"
        return f"{mean} [{low}, {high}]" if np.isfinite(self.low) else f"{mean} [-]"


def bootstrap_mean(values: Sequence[float], tasks: Sequence[Hashable], seed: int = 0) -> Interval:
    """Compute ``mean(x)`` and the 95 % interval of ``sum_c w_c S_c / sum_c w_c n_c``, w ~ Multinomial(C, 1/C).

    Args:
        values: one number an episode.
        tasks: the task of each episode; those of one task are resampled together (S_c their sum, n_c their count).
        seed: of the resampling; equal seeds give equal intervals.

    Returns:
        The :class:`Interval`; its mean is NaN when ``values`` is empty.
    """
    if len(values) != len(tasks):
        raise ValueError(f"{len(values)} values for {len(tasks)} tasks")
    if not len(values):
        return Interval(np.nan, np.nan, np.nan, 0, 0)
    x = np.asarray(values, dtype=np.float64)
    cluster_of: dict[Hashable, int] = {}
    cluster = np.array([cluster_of.setdefault(task, len(cluster_of)) for task in tasks])
    sums, counts = np.bincount(cluster, weights=x), np.bincount(cluster)
    if len(cluster_of) < 2:
        return Interval(float(x.mean()), np.nan, np.nan, 1, len(x))
    weights = _resamples(len(cluster_of), seed)
    means = (weights @ sums) / (weights @ counts)
    low, high = np.quantile(means, [0.025, 0.975])
    return Interval(float(x.mean()), float(low), float(high), len(cluster_of), len(x))


@lru_cache(maxsize=8)
def _resamples(clusters: int, seed: int) -> np.ndarray:
    """Draw ``(resamples, clusters)`` counts of each cluster; one set serves every metric of a table."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, clusters]))
    return rng.multinomial(clusters, np.full(clusters, 1.0 / clusters), size=RESAMPLES).astype(np.float64)


def task_key(row: Row) -> tuple[str, int]:
    """Return the identity of a row's task: the apartment's content and the task's number."""
    return str(row["scene_hash"]), int(row["task"])


def mean(rows: Iterable[Row], metric: str, seed: int = 0) -> Interval:
    """Compute the mean of ``metric`` over the tasks of ``rows``; episodes that lack it (None) are left out."""
    check_name(metric)
    present = [row for row in rows if row.get(metric) is not None]
    return bootstrap_mean([float(row[metric]) for row in present], [task_key(row) for row in present], seed)


def paired_difference(
    rows: Iterable[Row], metric: str, agent: str, reference: str, seed: int = 0, by: str = "agent"
) -> Interval:
    """Compute ``mean(agent - reference)`` over episodes that both ran on the same condition, task and seed.

    The episode seed does not depend on the agent, so both had the same task and noise stream: the interval is far
    tighter than that of the difference of two independent means. Episodes without a partner are left out.

    Args:
        by: the field whose two values are compared, all others equal; ``"physics"`` compares two simulators.

    Raises:
        InputError: the two share no episode.
    """
    return bootstrap_mean(*paired_values(rows, metric, agent, reference, by), seed)


def paired_values(
    rows: Iterable[Row], metric: str, first: str, second: str, by: str = "agent"
) -> tuple[list[float], list[Hashable]]:
    """Return ``first - second`` of every episode that both ran, and its task; raise like :func:`paired_difference`."""
    check_name(metric)
    rows = list(rows)
    of_first, of_second = _by_episode(rows, metric, by, first), _by_episode(rows, metric, by, second)
    shared = [key for key in of_first if key in of_second]
    if not shared:
        both = "agents" if by == "agent" else by
        raise InputError("paired difference", f"{first} - {second}", f"episodes of both {both} that have {metric}")
    return [of_first[key][0] - of_second[key][0] for key in shared], [of_first[key][1] for key in shared]


def _by_episode(rows: Iterable[Row], metric: str, by: str, value: str) -> dict[tuple, tuple[float, Hashable]]:
    """Map each episode with ``by == value``, identified by its other fields, to its metric and task."""
    same = [name for name in (*CONDITION, "agent") if name != by]
    return {
        (*(identified(row, name) for name in same), row["task"], row["seed"]): (float(row[metric]), task_key(row))
        for row in rows
        if identified(row, by) == value and row.get(metric) is not None
    }


def group_rows(rows: Iterable[Row], by: Sequence[str]) -> dict[tuple[str, ...], list[Row]]:
    """Group rows by the values of the fields ``by``, in the order in which the groups first appear."""
    groups: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(str(identified(row, name)) for name in by), []).append(row)
    return groups
