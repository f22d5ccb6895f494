"""Resample tasks and training runs together: the bootstrap behind every interval of a mean or an interquartile mean.

    theta* = theta under weights w_t v_r,    w ~ Multinomial(T, 1/T),    v ~ Multinomial(R - 1, 1/R)
    [theta + k (q_2.5 - theta), theta + k (q_97.5 - theta)],    k = t_nu / t_inf,    nu = (R - 1) (V / V_R)^2

Tasks ``t`` and runs ``r`` of a training are crossed: every run meets every task. An episode counts as often as its task
and its run were drawn ("pigeonhole bootstrap", Owen, 2007), so the interval is for other tasks and other trainings.
With one run v = 1 and k = 1: tasks alone are resampled.

Runs are few. R - 1 draws of R runs make the variance between them unbiased (Rao and Wu, 1988), and the percentile
interval is stretched by Student's quantile over the normal one, the more the larger the part V_R between runs of the
variance V of theta* is (Satterthwaite, 1946). What neither task nor run explains of a single episode is counted up to
three times (Owen), which errs on the safe side. A resample that draws no task which one of its runs has is left out.

With few tasks the same holds of them. Where the range of the scores is known and T < 15, deviations of the resamples
are enlarged by sqrt(T / (T - 1)), which makes their variance unbiased, and Student's quantile counts the tasks' part of
the variance with its T - 1. The ends then lie within the range, not within the scores that happened to be found.

If all T tasks scored one end of that range, resamples do not differ. Any other score has at most the probability q,
(1 - q)^T = 0.025, so the interval reaches from that end over the part q of the range: as far as Clopper and Pearson's.
"""

from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

RESAMPLES = 4000  # the Monte Carlo error of a 2.5 % quantile is then below 0.3 % of probability
TRIMMED = 0.25  # fraction of the scores that an interquartile mean leaves out at either end
FEW_TASKS = 15  # below which an interval of scores of a known range is widened; above it would be by less than 13 %
_ENDS = (0.025, 0.975)  # probabilities below the two ends of an interval
_CHUNK = 500  # resamples that are weighted at once: 500 of 3,000 scores have 12 MB


@dataclass(frozen=True)
class Scores:
    """Hold numbers with the task and the run that they belong to.

    Attributes:
        values: of each row, in columns whose statistics are independent of each other.
        episodes: the number of episodes that a row stands for; its values are their means.
        task: index of each row's task.
        run: index of each row's training run.
        tasks: number of tasks.
        runs: number of runs.
    """

    values: Float[np.ndarray, "scores columns"]
    episodes: Float[np.ndarray, "scores"]
    task: Int[np.ndarray, "scores"]
    run: Int[np.ndarray, "scores"]
    tasks: int
    runs: int


Statistic = Callable[[Scores, Float[np.ndarray, "resamples scores"]], Float[np.ndarray, "resamples columns"]]


@dataclass(frozen=True)
class Bounds:
    """Hold a statistic of each column and the ends of its 95 % interval; NaN with fewer than two tasks."""

    value: Float[np.ndarray, "columns"]
    low: Float[np.ndarray, "columns"]
    high: Float[np.ndarray, "columns"]


def scores(values: np.ndarray, tasks: Sequence[Hashable], runs: Sequence[Hashable]) -> Scores:
    """Number tasks and runs in order of appearance.

    Args:
        values: ``(n,)`` or ``(n, columns)``, one row an episode, n >= 1.
        tasks: the task of each.
        runs: the training run of each; all equal where there is one.
    """
    x = np.asarray(values, np.float64).reshape(len(values), -1)
    task, run = _numbered(tasks), _numbered(runs)
    return Scores(x, np.ones(len(x)), task, run, int(task.max()) + 1, int(run.max()) + 1)


def mean(of: Scores, weights: Float[np.ndarray, "resamples scores"]) -> Float[np.ndarray, "resamples columns"]:
    """``sum(w x) / sum(w)`` under each row of weights."""
    counted = weights * of.episodes
    total = counted.sum(axis=1, keepdims=True)
    return np.divide(
        counted @ of.values, total, out=np.full((len(weights), of.values.shape[1]), np.nan), where=total > 0
    )


def interquartile_mean(
    of: Scores, weights: Float[np.ndarray, "resamples scores"]
) -> Float[np.ndarray, "resamples columns"]:
    """Return the mean of the middle half of the scores, each repeated as often as its weight says.

    Of N scores floor(N / 4) are left out at either end (Agarwal et al., 2021). Every row stands for one episode.
    """
    found = np.empty((len(weights), of.values.shape[1]))
    for column, x in enumerate(of.values.T):
        order = np.argsort(x)
        upper = np.cumsum(weights[:, order], axis=1)
        left_out = np.floor(TRIMMED * upper[:, -1:])
        ends = np.clip(upper, left_out, upper[:, -1:] - left_out) - left_out  # scores of the middle half so far
        kept = np.diff(ends, axis=1, prepend=0.0)
        total = kept.sum(axis=1)
        found[:, column] = np.divide(kept @ x[order], total, out=np.full(len(weights), np.nan), where=total > 0)
    return found


def bootstrap(
    statistic: Statistic,
    of: Scores,
    seed: int = 0,
    minus: Scores | None = None,
    within: tuple[float, float] | None = None,
) -> Bounds:
    """Compute a statistic of each column, or its difference ``of - minus``, with the module's interval.

    Args:
        statistic: :func:`mean` or :func:`interquartile_mean`.
        of: the scores; one row an episode, or for a mean one row a cell (:func:`cells`).
        seed: of the resampling; equal seeds give equal intervals.
        minus: the scores of another method on the same tasks, with equal indices: each task is drawn for both, and
            each method's runs apart.
        within: the least and the largest value that a score, and so the statistic, can have, or a difference of two
            scores; None: not known.
    """
    groups = [of] if minus is None else [of, minus]
    signs = (1.0, -1.0)[: len(groups)]
    of_all = [statistic(one, np.ones((1, len(one.task))))[0] for one in groups]
    value = np.sum([sign * one for sign, one in zip(signs, of_all, strict=True)], axis=0)
    if of.tasks < 2:
        return Bounds(value, np.full_like(value, np.nan), np.full_like(value, np.nan))
    drawn = np.zeros((RESAMPLES, len(value)))
    for stream, (sign, one) in enumerate(zip(signs, groups, strict=True)):
        parts = [statistic(one, weights) for weights in _weights(one, seed, stream)]
        drawn += sign * np.concatenate(parts)
    drawn = drawn[np.isfinite(drawn).all(axis=1)]
    between = [(_between_runs(statistic, one), one.runs) for one in groups]
    variance = drawn.var(axis=0)
    least, most = (_sum_of_ends(groups, end) for end in (np.min, np.max))
    if within is not None and of.tasks < FEW_TASKS:
        unbiased = of.tasks / (of.tasks - 1)
        drawn, variance = value + np.sqrt(unbiased) * (drawn - value), unbiased * variance
        between.append((np.maximum(variance - np.sum([part for part, _ in between], axis=0), 0.0), of.tasks))
        least, most = (np.full_like(value, end) for end in within)
    low, high = np.quantile(drawn, _ENDS, axis=0)
    stretch = _stretch(variance, between)
    low, high = (np.clip(end + (stretch - 1.0) * (end - value), least, most) for end in (low, high))
    if within is not None and minus is None and np.isfinite(within).all():
        unseen = (1.0 - _ENDS[0] ** (1.0 / of.tasks)) * (within[1] - within[0])
        low = np.where((of.values == within[1]).all(axis=0), within[1] - unseen, low)
        high = np.where((of.values == within[0]).all(axis=0), within[0] + unseen, high)
    return Bounds(value, low, high)


def cells(of: Scores) -> Scores:
    """Return one row for each pair of task and run: what a mean needs of the scores."""
    pair, member = np.unique(of.task * of.runs + of.run, return_inverse=True)
    episodes = np.bincount(member, weights=of.episodes)
    sums = np.zeros((len(pair), of.values.shape[1]))
    np.add.at(sums, member, of.values * of.episodes[:, None])
    task, run = np.divmod(pair, of.runs)
    return Scores(sums / episodes[:, None], episodes, task, run, of.tasks, of.runs)


def _numbered(names: Sequence[Hashable]) -> np.ndarray:
    number: dict[Hashable, int] = {}
    return np.array([number.setdefault(name, len(number)) for name in names])


def _weights(of: Scores, seed: int, stream: int) -> Iterator[np.ndarray]:
    """Yield the weights of the rows in chunks of resamples; those of tasks do not depend on ``stream``."""
    w = _draws(of.tasks, of.tasks, (seed, of.tasks))
    v = None if of.runs == 1 else _draws(of.runs, of.runs - 1, (seed, of.runs, 1 + stream))
    for first in range(0, RESAMPLES, _CHUNK):
        chunk = slice(first, first + _CHUNK)
        yield w[chunk, of.task] if v is None else w[chunk, of.task] * v[chunk, of.run]


@lru_cache(maxsize=16)
def _draws(units: int, number: int, key: tuple[int, ...]) -> np.ndarray:
    """Draw ``(resamples, units)`` counts of each unit; one set serves every metric of a table."""
    rng = np.random.default_rng(np.random.SeedSequence(key))
    return rng.multinomial(number, np.full(units, 1.0 / units), size=RESAMPLES).astype(np.float64)


def _between_runs(statistic: Statistic, of: Scores) -> np.ndarray:
    """Estimate the variance of the statistic over trainings, ``V_R``; 0 with one run."""
    if of.runs == 1:
        return np.zeros(of.values.shape[1])
    alone = (of.run[None, :] == np.arange(of.runs)[:, None]).astype(np.float64)
    return statistic(of, alone).var(axis=0, ddof=1) / of.runs


def _stretch(variance: np.ndarray, between: Sequence[tuple[np.ndarray, int]]) -> np.ndarray:
    """Return ``k`` of each column."""
    whole = np.maximum(variance, np.sum([part for part, _ in between], axis=0))
    inverse = np.sum([part**2 / (runs - 1) for part, runs in between if runs > 1] or [np.zeros_like(whole)], axis=0)
    freedom = np.divide(whole**2, inverse, out=np.full_like(whole, np.inf), where=inverse > 0.0)
    return stats.t.ppf(_ENDS[1], freedom) / stats.t.ppf(_ENDS[1], np.inf)  # 1 exactly where no part counts


def _sum_of_ends(groups: Sequence[Scores], end: Callable[..., np.ndarray]) -> np.ndarray:
    """Return the least or largest value that a mean of the scores, or a difference of two means, can have."""
    other = np.max if end is np.min else np.min
    ends = end(groups[0].values, axis=0)
    return ends - other(groups[1].values, axis=0) if len(groups) > 1 else ends
