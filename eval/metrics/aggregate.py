"""Compute means over tasks with 95 % bootstrap intervals, and paired differences between agents.

The resampled unit is the *task*: episodes of one task under several seeds share their start, goal and corridor and are
not independent, so they enter and leave a resample together (a cluster bootstrap). Policies of one training
(:mod:`vssm_gym.eval.metrics.training_runs`) are resampled with the tasks.
"""

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.row import DEFAULTS, KEY, identified
from vssm_gym.eval.metrics import resampling
from vssm_gym.eval.metrics.metric import Row, check_name
from vssm_gym.eval.metrics.registry import within
from vssm_gym.eval.metrics.resampling import FEW_TASKS, Bounds, Scores
from vssm_gym.eval.metrics.training_runs import run_of

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

    def times(self, factor: float) -> "Interval":
        """Return the interval in another unit, ``factor`` > 0 of which are one of this."""
        return replace(self, mean=factor * self.mean, low=factor * self.low, high=factor * self.high)


def bootstrap_mean(
    values: Sequence[float],
    tasks: Sequence[Hashable],
    seed: int = 0,
    runs: Sequence[Hashable] | None = None,
    within: tuple[float, float] | None = None,
) -> Interval:
    """Compute ``mean(x)`` and its 95 % interval, resampling whole tasks, and the runs of a training with them.

    Args:
        values: one number an episode.
        tasks: the task of each episode; those of one task are resampled together.
        seed: of the resampling; equal seeds give equal intervals.
        runs: the training run of each episode; None: one for all.
        within: the range of the values, where it is known, for an interval that is wide enough over few tasks, and
            where all tasks scored one end of it.

    Returns:
        The :class:`Interval`; its mean is NaN when ``values`` is empty.
    """
    if len(values) != len(tasks):
        raise ValueError(f"{len(values)} values for {len(tasks)} tasks")
    if not len(values):
        return Interval(np.nan, np.nan, np.nan, 0, 0)
    found = resampling.scores(np.asarray(values, np.float64), tasks, [0] * len(values) if runs is None else runs)
    bounds = resampling.bootstrap(resampling.mean, resampling.cells(found), seed, within=within)
    return replace(_interval(bounds, found), mean=float(np.mean(values)))


def _interval(bounds: Bounds, of: Scores) -> Interval:
    return Interval(float(bounds.value[0]), float(bounds.low[0]), float(bounds.high[0]), of.tasks, len(of.values))


def task_key(row: Row) -> tuple[str, int]:
    """Return the identity of a row's task: the apartment's content and the task's number."""
    return str(row["scene_hash"]), int(row["task"])


def mean(rows: Iterable[Row], metric: str, seed: int = 0) -> Interval:
    """Compute the mean of ``metric`` over the tasks of ``rows``; episodes that lack it (None) are left out."""
    present = having(rows, metric)
    values = [float(row[metric]) for row in present]
    return bootstrap_mean(values, list(map(task_key, present)), seed, list(map(run_of, present)), within(metric))


def interquartile_mean(rows: Iterable[Row], metric: str, seed: int = 0) -> Interval:
    """Compute the mean of the middle half of all scores, over tasks and runs together (Agarwal et al., 2021).

    It leaves out the worst and the best quarter of the episodes, so that few outliers move it less than the mean. Its
    interval allows for few tasks as the mean's does. Over many tasks that all scored one end of the range it has no
    width: the rest, which no task met, is less than the quarter that is left out.
    """
    present = having(rows, metric)
    if not present:
        return Interval(np.nan, np.nan, np.nan, 0, 0)
    found = scores_of(present, metric)
    ends = within(metric) if found.tasks < FEW_TASKS else None
    return _interval(resampling.bootstrap(resampling.interquartile_mean, found, seed, within=ends), found)


def profile(rows: Iterable[Row], metric: str, levels: Float[np.ndarray, "n"], seed: int = 0) -> Bounds:
    """``F(tau) = P(x > tau)`` over all episodes, at each of ``levels``, with pointwise 95 % intervals.

    The performance profile of Agarwal et al. (2021). It falls, and of scores in [0, 1] its integral is the mean. With
    no score all is NaN.
    """
    present = having(rows, metric)
    if not present:
        unknown = np.full(len(levels), np.nan)
        return Bounds(unknown, unknown, unknown)
    found = scores_of(present, metric)
    above = replace(found, values=(found.values > levels).astype(np.float64))
    return resampling.bootstrap(resampling.mean, resampling.cells(above), seed)


def having(rows: Iterable[Row], metric: str) -> list[Row]:
    """Return the rows that have a value of a metric."""
    check_name(metric)
    return [row for row in rows if row.get(metric) is not None]


def scores_of(rows: Sequence[Row], metric: str) -> Scores:
    """Return a metric of rows that have it, with their tasks and training runs."""
    values = np.array([float(row[metric]) for row in rows])
    return resampling.scores(values, list(map(task_key, rows)), list(map(run_of, rows)))


def paired_difference(
    rows: Iterable[Row], metric: str, agent: str, reference: str, seed: int = 0, by: str = "agent"
) -> Interval:
    """Compute ``mean(agent - reference)`` over episodes that both ran on the same condition, task and seed.

    The episode seed does not depend on the agent, so both had the same task and noise stream: the interval is far
    tighter than that of the difference of two independent means. Episodes without a partner are left out. Of a method
    with several runs an episode counts that all of them ran; tasks are drawn for both methods together, and the runs of
    each apart.

    Args:
        by: the field whose two values are compared, all others equal; ``"physics"`` compares two simulators.

    Raises:
        InputError: the two share no episode.
    """
    keys, first, second = _shared(rows, metric, agent, reference, by)
    tasks = [task for task, _ in keys]
    ends = (known[0] - known[1], known[1] - known[0]) if (known := within(metric)) else None
    if all(len(runs) == 1 for runs in (*first, *second)):  # episodes with equal values then differ by 0 exactly
        return bootstrap_mean(_differences(first, second), tasks, seed, within=ends)
    of, minus = (resampling.cells(_of_method(each, tasks)) for each in (first, second))
    return replace(_interval(resampling.bootstrap(resampling.mean, of, seed, minus, ends), of), episodes=len(keys))


def paired_values(
    rows: Iterable[Row], metric: str, first: str, second: str, by: str = "agent"
) -> tuple[list[float], list[Hashable]]:
    """Return ``first - second`` of every episode that both ran, and its task; raise like :func:`paired_difference`.

    Of a method with several runs it is the mean over them.
    """
    keys, of_first, of_second = _shared(rows, metric, first, second, by)
    return _differences(of_first, of_second), [task for task, _ in keys]


_Runs = dict[str, float]  # the training run, and the metric of its episode


def _differences(first: Sequence[_Runs], second: Sequence[_Runs]) -> list[float]:
    average = lambda values: sum(values.values()) / len(values)
    return [average(a) - average(b) for a, b in zip(first, second, strict=True)]


def _shared(
    rows: Iterable[Row], metric: str, first: str, second: str, by: str
) -> tuple[list[tuple[Hashable, tuple]], list[_Runs], list[_Runs]]:
    """Return the task and key of each episode that both ran, and what all runs of each had there."""
    check_name(metric)
    rows = list(rows)
    of_first, of_second = (_by_episode(rows, metric, by, value) for value in (first, second))
    complete = [max(map(len, found.values()), default=0) for found in (of_first, of_second)]
    shared = [key for key in of_first if key in of_second and [len(of_first[key]), len(of_second[key])] == complete]
    if not shared:
        both = "agents" if by == "agent" else by
        raise InputError("paired difference", f"{first} - {second}", f"episodes of both {both} that have {metric}")
    return shared, [of_first[key] for key in shared], [of_second[key] for key in shared]


def _of_method(found: Sequence[_Runs], tasks: Sequence[Hashable]) -> Scores:
    """Return the scores of one method; tasks are numbered alike for two methods with the same ``tasks``."""
    each = [(value, task, run) for runs, task in zip(found, tasks, strict=True) for run, value in runs.items()]
    values, of_tasks, of_runs = zip(*each, strict=True)
    return resampling.scores(np.array(values), of_tasks, of_runs)


def _by_episode(rows: Iterable[Row], metric: str, by: str, value: str) -> dict[tuple[Hashable, tuple], _Runs]:
    """Map each episode with ``by == value``, identified by its other fields, to its metric in each training run."""
    same = [name for name in (*CONDITION, "agent") if name != by]
    found: dict[tuple[Hashable, tuple], _Runs] = {}
    for row in rows:
        if identified(row, by) == value and row.get(metric) is not None:
            key = (*(identified(row, name) for name in same), row["task"], row["seed"])
            found.setdefault((task_key(row), key), {})[run_of(row)] = float(row[metric])
    return found


def group_rows(rows: Iterable[Row], by: Sequence[str]) -> dict[tuple[str, ...], list[Row]]:
    """Group rows by the values of the fields ``by``, in the order in which the groups first appear."""
    groups: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(str(identified(row, name)) for name in by), []).append(row)
    return groups
