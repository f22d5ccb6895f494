"""Score the rows of each track: one headline number, its interval over tasks, and what explains it.

    SPL             success l / max(p, l): shortest path length over path length
    timely success  success t_min / t: the time of the shortest curve at full speed, obstacles apart, over the time
    explored        1/T int_0^T coverage dt over the time limit T; coverage stays where the agent has stopped
    ATE             RMSE of positions after SE(3) alignment, at most that of a camera that never moves
    nats            mean log density of a pixel 1 s and 3 s ahead; of a failure, that of who knows nothing

A fault of an entry is worth the worst of these: 0, 0, 0, standing still, and knowing nothing.
"""

import math
from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from vssm_gym.eval.benchmark.prediction.levels import UNINFORMED
from vssm_gym.eval.metrics.aggregate import Interval, bootstrap_mean, task_key
from vssm_gym.eval.metrics.exploration import at
from vssm_gym.eval.metrics.failure import FAULT
from vssm_gym.eval.metrics.metric import Row
from vssm_gym.eval.metrics.registry import METRICS
from vssm_gym.geometry.car import Car

ORDER = ("scene_hash", "task", "noise", "sensor_noise", "physics", "seed")  # of the rows of an entry
COVERAGE_STEP = 1.0  # s between the points at which a run's coverage is averaged
NOT_RUN = "not run yet: --resume runs it"


@dataclass(frozen=True)
class Score:
    """Define a track's headline number: of a row, with its label, its better direction and its digits."""

    function: Callable[[Row], float]
    label: str
    direction: Literal["higher", "lower"]
    digits: int
    within: tuple[float, float]  # that a score lies in
    worst: float | None = None  # of an episode without a row; None where each has its own


def _spl(row: Row) -> float:
    return float(METRICS["spl"].function(row) or 0.0)


def _timely(row: Row) -> float:
    if not row["success"]:
        return 0.0
    return min(1.0, row["geodesic"] / Car().max_speed / row["seconds"])


def _explored(row: Row) -> float:
    if str(row["failure"] or "").startswith(FAULT):
        return 0.0
    grid = np.arange(0.0, row["budget"]["seconds"], COVERAGE_STEP)
    return float(np.mean(np.nan_to_num(at(row, "coverage", "seconds", grid))))


def _stored(row: Row) -> float:
    return float(row["score"])


SCORES: dict[str, Score] = {
    "spl": Score(_spl, "SPL", "higher", 3, (0.0, 1.0), 0.0),
    "timely": Score(_timely, "timely success", "higher", 3, (0.0, 1.0), 0.0),
    "explored": Score(_explored, "explored", "higher", 3, (0.0, 1.0), 0.0),
    "ate": Score(_stored, "ATE, m", "lower", 4, (0.0, math.inf)),
    "nats": Score(_stored, "nats a pixel", "higher", 2, (UNINFORMED, math.inf), UNINFORMED),
}


@dataclass(frozen=True)
class Line:
    """Hold what a track's table says of one entry.

    Attributes:
        entry: its label.
        score: with its interval over tasks; of explorers and world models over scenes, where there is more than one;
            NaN where an interrupted run has left recordings.
        success: share of the episodes; of recordings, those whose error is small; of drives, those that ran.
        collisions: steps in contact an episode, of a car collisions; None where nothing can collide.
        p95: s, 95 % point of a decision's time, the median over episodes; None where nothing was measured.
        episodes: that the suite has, run or not.
        faults: how many failed by the entry's own fault, by reason.
        versions: of the package that made the rows.
    """

    entry: str
    score: Interval
    success: float
    collisions: float | None
    p95: float | None
    episodes: int
    faults: dict[str, int]
    versions: tuple[str, ...]


def line(entry: str, rows: Sequence[dict[str, Any]], score: Score, episodes: int) -> Line:
    """Summarise the rows of an entry; episodes without a row are those that an interrupted run has left.

    Args:
        entry: label.
        rows: of its episodes, recordings or drives.
        score: of the track.
        episodes: how many the suite has.
    """
    left = episodes - len(rows)
    rows = sorted(rows, key=_place)  # they are kept as they ended, and resamples depend on their order
    values = [score.function(row) for row in rows]
    units: list[Hashable] = [_cluster(row) for row in rows]
    if len(set(units)) == 1:
        units = [task_key(row) if "task" in row else row["unit"] for row in rows]
    if score.worst is not None:
        values += [score.worst] * left
        units += [("left", k) for k in range(left)]
    elif left:  # recordings differ too much for some of them to stand for all
        values, units = [], []
    reasons = [_reason(row) for row in rows]
    faults = Counter(reason for reason in reasons if reason is not None)
    if left:
        faults[NOT_RUN] += left
    times = [seconds for row in rows if (seconds := _p95(row)) is not None]
    contacts = [float(n) for row in rows if (n := _contacts(row)) is not None]
    return Line(
        entry=entry,
        score=bootstrap_mean(values, units, within=score.within),
        success=float(np.sum([row["success"] for row in rows])) / max(episodes, 1),
        collisions=float(np.mean(contacts)) if contacts else None,
        p95=float(np.median(times)) if times else None,  # the first episode compiles
        episodes=episodes,
        faults=dict(faults),
        versions=tuple(dict.fromkeys(str(row.get("version")) for row in rows)),
    )


def _place(row: Row) -> tuple[str, ...]:
    """Return what rows are ordered by."""
    return (row["unit"],) if "unit" in row else tuple(str(row.get(field)) for field in ORDER)


def _cluster(row: Row) -> Hashable:
    """Return what is drawn together of a row: of explorers and world models a scene, else the task or the recording."""
    if "task" not in row:
        return row.get("scene") or row["unit"]
    return row["scene_hash"] if "curve" in row else task_key(row)


def _reason(row: Row) -> str | None:
    """Return why a row's entry failed by its own fault; None where it did not."""
    if "unit" in row:
        reason = row["fault"]
        return None if reason is None else str(reason)
    kind, _, reason = str(row["failure"] or "").partition(": ")
    return reason if kind == FAULT else None


def _p95(row: Row) -> float | None:
    if "unit" in row:
        return None if row["p95"] is None else float(row["p95"])
    found = METRICS["decision_p95_ms"].function(row)
    return None if found is None else 1e-3 * float(found)


def _contacts(row: Row) -> float | None:
    for field in ("collision_events", "collisions"):
        if row.get(field) is not None:
            return float(row[field])
    return None
