"""Build the explorers' tables: path lengths to levels of coverage, paired ratios, scene by scene, at equal lengths."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vssm_gym.eval.metrics import exploration
from vssm_gym.eval.metrics.aggregate import Interval, bootstrap_mean, group_rows, having
from vssm_gym.eval.metrics.exploration import COVERAGE_GOAL, COVERAGE_LEVELS, Axis, Ratio
from vssm_gym.eval.metrics.metric import Row
from vssm_gym.eval.metrics.training_runs import run_of
from vssm_gym.eval.report.tables import Measures, pooled
from vssm_gym.viz.html import Table

TIED = 50.0  # nats: smaller differences vanish in the tables, which show tenths of 10^3 nats
KNOWN_PAIRS = 0.5  # proportion of pairs that a statement at one point needs: others ran out of time before it
UNITS: dict[Axis, str] = {"metres": "m", "seconds": "s"}
# Path lengths (m) and times (s) at which maps are compared.
EQUAL: dict[Axis, tuple[float, ...]] = {
    "metres": (5.0, 10.0, 20.0, 40.0),
    "seconds": (30.0, 60.0, 120.0, 240.0),
}

EXPLORE = Measures("explore")
POOLED = ("accuracy_cm", "completion_cm", "complete_percent", "navigation_success", "navigation_spl")


def headline(rows: Sequence[Row], seed: int) -> Table:
    """Tabulate each agent over all scenes: median path lengths, coverage, collisions, mesh, navigation on its maps."""
    by = (*pooled(rows), "agent")
    shown = [name for name in POOLED if any(row.get(name) is not None for row in rows)]
    header = [
        *(name.replace("_", " ") for name in by),
        "runs",
        "scenes",
        *(f"m to {level} %" for level in COVERAGE_LEVELS),
    ]
    header += [
        f"s to {COVERAGE_GOAL} %",
        f"covered {COVERAGE_GOAL} %",
        "covered 99 %",
        "collided %",
        *(EXPLORE.label(name) for name in shown),
    ]
    lines = []
    for group, members in group_rows(rows, by).items():
        line = [*group, str(len(members)), str(len({row["scene_hash"] for row in members}))]
        line += [median_text(exploration.median_to_level(members, level, seed)) for level in COVERAGE_LEVELS]
        line += [median_text(exploration.median_to_level(members, COVERAGE_GOAL, seed, "seconds"))]
        line += [EXPLORE.mean(members, name, seed) for name in ("covered_90", "covered_99", "collided")]
        line += [EXPLORE.text(name, over_scenes(members, name, seed)) for name in shown]
        lines.append(line)
    return Table(header, lines, len(by))


def over_scenes(rows: Sequence[Row], name: str, seed: int) -> Interval:
    """Compute the mean over runs, resampling scenes and policies; runs that lack the value are left out."""
    present = having(rows, name)
    values = [float(row[name]) for row in present]
    return bootstrap_mean(values, exploration.clusters(present), seed, list(map(run_of, present)))


def median_text(interval: Interval) -> str:
    """Format a median with its interval; ``never`` where a bound is that of a run that did not reach the level."""
    values = [interval.mean, interval.low, interval.high]
    if np.isnan(interval.mean):
        return "-"
    mean, low, high = ("never" if np.isinf(v) else f"{v:.1f}" for v in values)
    return f"{mean} [-]" if np.isnan(interval.low) else f"{mean} [{low}, {high}]"


def ratios(rows: Sequence[Row], reference: str, seed: int) -> Table:
    """Tabulate the reference's path length to levels of coverage over each other agent's, and its time to the goal."""
    by = pooled(rows)
    header = [*(name.replace("_", " ") for name in by), "ratio of path lengths", "pairs", "scenes"]
    header += [f"{column} {level} %" for level in (COVERAGE_GOAL, 95, 99) for column in ("to", "shorter to", "missed")]
    header.append(f"seconds to {COVERAGE_GOAL} %")
    lines = []
    for group, members in group_rows(rows, by).items():
        for other in others(members, reference):
            found = [exploration.ratio(members, reference, other, level, seed) for level in (COVERAGE_GOAL, 95, 99)]
            scenes = str(len({a["scene_hash"] for a, _ in exploration.pairs(members, reference, other)}))
            line = [*group, f"{reference} / {other}", str(found[0].pairs), scenes]
            for r in found:
                line += [r.text, f"{r.shorter} of {r.interval.episodes}", f"{r.first_missed} / {r.second_missed}"]
            lines.append([*line, exploration.ratio(members, reference, other, COVERAGE_GOAL, seed, "seconds").text])
    return Table(header, lines, len(by) + 1)


def others(rows: Sequence[Row], reference: str) -> list[str]:
    """Return the other agents, in the order of the rows."""
    return [name for name in dict.fromkeys(str(row["agent"]) for row in rows) if name != reference]


@dataclass(frozen=True)
class Rival:
    """Hold the strongest other agent of a scene: the one that the reference leads by least."""

    scene: str
    agent: str
    ratio: Ratio

    @property
    def verdict(self) -> str:
        """Return whether the reference's path is shorter or longer, by the interval over starts."""
        low, high = self.ratio.interval.low, self.ratio.interval.high
        if high < 1.0:
            return "shorter"
        return "longer" if low > 1.0 else "undecided"


def rivals(rows: Sequence[Row], reference: str, seed: int) -> list[Rival]:
    """Find the strongest other agent of each scene by the ratio of path lengths to ``COVERAGE_GOAL`` %."""
    strongest = []
    for (scene,), members in group_rows(rows, ["scene"]).items():
        by_agent = {
            name: exploration.ratio(members, reference, name, COVERAGE_GOAL, seed)
            for name in others(members, reference)
        }
        candidates = [Rival(scene, name, found) for name, found in by_agent.items() if found.interval.episodes]
        if candidates:
            strongest.append(max(candidates, key=lambda rival: rival.ratio.interval.mean))
    return strongest


def by_scene(found: Sequence[Rival], reference: str) -> Table:
    """Tabulate the strongest other agent of each scene and how the reference compares."""
    lines = [
        [
            rival.scene,
            rival.agent,
            rival.verdict,
            str(rival.ratio.pairs),
            rival.ratio.text,
            f"{rival.ratio.shorter} of {rival.ratio.interval.episodes}",
            f"{rival.ratio.first_missed} / {rival.ratio.second_missed}",
        ]
        for rival in found
    ]
    header = ["scene", "strongest other agent", f"{reference}'s path is", "pairs", f"ratio to {COVERAGE_GOAL} %"]
    return Table([*header, "shorter", "missed"], lines, 3)


@dataclass(frozen=True)
class PointComparison:
    """Hold ``other - reference`` at one path length or time, over the pairs in which both are known there."""

    other: str
    where: float  # m or s
    unit: str
    pairs: int  # all pairs, known or not
    entropy: Interval  # nats
    coverage: Interval

    @property
    def is_known(self) -> bool:
        """Return whether the entropy of enough pairs is known."""
        return self.entropy.episodes > 0 and self.entropy.episodes >= KNOWN_PAIRS * self.pairs

    @property
    def is_behind(self) -> bool:
        """Return whether the other's map has the lower entropy on average over the known pairs."""
        return self.entropy.mean < -TIED  # False for NaN, the mean of no pairs


def compared(rows: Sequence[Row], reference: str, seed: int, axis: Axis) -> list[PointComparison]:
    """Compare the reference with each other agent at each point of an axis."""
    return [
        PointComparison(
            other,
            x,
            UNITS[axis],
            len(exploration.pairs(rows, other, reference)),
            exploration.paired_at(rows, "entropy", other, reference, x, seed, axis),
            exploration.paired_at(rows, "coverage", other, reference, x, seed, axis),
        )
        for other in others(rows, reference)
        for x in EQUAL[axis]
    ]


def named(points: Sequence[PointComparison]) -> list[str]:
    """Format points as ``["frontier_gain at 5, 10 m", "frontier_nearest at 40 m"]``."""
    at: dict[str, list[str]] = {}
    for point in points:
        at.setdefault(point.other, []).append(f"{point.where:g}")
    return [f"{other} at {', '.join(where)} {points[0].unit}" for other, where in at.items()]


def at_equal(points: Sequence[PointComparison]) -> Table:
    """Tabulate differences of map entropy and coverage at equal path lengths or times."""
    lines = [
        [
            point.other,
            f"{point.where:g} {point.unit}",
            f"{point.coverage.episodes} of {point.pairs}",
            point.entropy.times(1e-3).text(1),
            point.coverage.times(100.0).text(1),
        ]
        for point in points
    ]
    return Table(["other agent", "at", "pairs known", "entropy, 10^3 nats", "coverage, %"], lines, 1)
