"""The tables of explorers : ways to shares of coverage, paired ratios, scene by scene, at equal lengths."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vssm_gym.eval.metrics import exploration as metrics
from vssm_gym.eval.metrics import proportions as shares
from vssm_gym.eval.metrics.aggregate import Interval, Row, bootstrap_mean, group_rows
from vssm_gym.eval.metrics.exploration import GOAL, SHARES, Ratio
from vssm_gym.eval.report.tables import Measures, grouping
from vssm_gym.viz.html import html_table

TIED = 50.0  # nats: tables show tenths of a knat
KNOWN_PAIRS = 0.5  # share of the pairs that a statement at one point needs: who ran out of time before is not there
UNITS: dict[metrics.Axis, str] = {"metres": "m", "seconds": "s"}
# Where maps are compared.
EQUAL: dict[metrics.Axis, tuple[float, ...]] = {
    "metres": (5.0, 10.0, 20.0, 40.0),
    "seconds": (30.0, 60.0, 120.0, 240.0),
}

EXPLORE = Measures("explore")
POOLED = ("accuracy_cm", "completion_cm", "complete_percent", "navigation_success", "navigation_spl")


def pooled(rows: Sequence[Row]) -> tuple[str, ...]:
    """The conditions without scenes, over which the headline counts all runs, and without the agent."""
    return tuple(name for name in grouping(rows) if name not in ("scene", "agent"))


def headline(rows: Sequence[Row], seed: int) -> str:
    """Each agent over all scenes: median ways, shares that got there, touched, mesh, navigation on its maps."""
    by = (*pooled(rows), "agent")
    shown = [name for name in POOLED if any(row.get(name) is not None for row in rows)]
    header = [*(name.replace("_", " ") for name in by), "runs", "scenes", *(f"m to {share} %" for share in SHARES)]
    header += [
        f"s to {GOAL} %",
        f"covered {GOAL} %",
        "covered 99 %",
        "touched %",
        *(EXPLORE.label(name) for name in shown),
    ]
    lines = []
    for group, members in group_rows(rows, by).items():
        line = [*group, str(len(members)), str(len({row["scene_hash"] for row in members}))]
        line += [way(metrics.median_way(members, share, seed)) for share in SHARES]
        line += [way(metrics.median_way(members, GOAL, seed, "seconds"))]
        line += [shares.percent(members, name).text(1) for name in ("covered_90", "covered_99", "touched")]
        line += [EXPLORE.text(name, over_scenes(members, name, seed)) for name in shown]
        lines.append(line)
    return html_table(header, lines, len(by))


def over_scenes(rows: Sequence[Row], name: str, seed: int) -> Interval:
    """Mean over runs, resampling scenes; runs that lack the value are left out."""
    present = [row for row in rows if row.get(name) is not None]
    return bootstrap_mean([float(row[name]) for row in present], metrics.clusters(present), seed)


def way(interval: Interval) -> str:
    """A median way with its interval; ``never`` where a bound is that of a run that did not get there."""
    values = [interval.mean, interval.low, interval.high]
    if np.isnan(interval.mean):
        return "-"
    mean, low, high = ("never" if np.isinf(v) else f"{v:.1f}" for v in values)
    return f"{mean} [-]" if np.isnan(interval.low) else f"{mean} [{low}, {high}]"


def ratios(rows: Sequence[Row], reference: str, seed: int) -> str:
    """The reference's way to a share of coverage over each other agent's, over all scenes; and its time to ``GOAL``."""
    by = pooled(rows)
    header = [*(name.replace("_", " ") for name in by), "ratio of ways", "pairs", "scenes"]
    header += [f"{column} {share} %" for share in (GOAL, 95, 99) for column in ("to", "shorter to", "missed")]
    header.append(f"seconds to {GOAL} %")
    lines = []
    for group, members in group_rows(rows, by).items():
        for other in others(members, reference):
            found = [metrics.ratio(members, reference, other, share, seed) for share in (GOAL, 95, 99)]
            scenes = str(len({a["scene_hash"] for a, _ in metrics.pairs(members, reference, other)}))
            line = [*group, f"{reference} / {other}", str(found[0].pairs), scenes]
            for r in found:
                line += [r.text, f"{r.shorter} of {r.interval.episodes}", f"{r.first_missed} / {r.second_missed}"]
            lines.append([*line, metrics.ratio(members, reference, other, GOAL, seed, "seconds").text])
    return html_table(header, lines, len(by) + 1)


def others(rows: Sequence[Row], reference: str) -> list[str]:
    """The other agents, in the order of the rows."""
    return [name for name in dict.fromkeys(str(row["agent"]) for row in rows) if name != reference]


@dataclass(frozen=True)
class Rival:
    """In one scene, the other agent that the reference leads by least."""

    scene: str
    agent: str
    ratio: Ratio

    @property
    def verdict(self) -> str:
        """Whose way is shorter, as far as the interval over starts tells."""
        low, high = self.ratio.interval.low, self.ratio.interval.high
        if high < 1.0:
            return "shorter"
        return "longer" if low > 1.0 else "not told apart"


def rivals(rows: Sequence[Row], reference: str, seed: int) -> list[Rival]:
    """The hardest other agent of each scene by the ratio of ways to ``GOAL`` %; scenes without a pair are left out."""
    hardest = []
    for (scene,), members in group_rows(rows, ["scene"]).items():
        by_agent = {name: metrics.ratio(members, reference, name, GOAL, seed) for name in others(members, reference)}
        candidates = [Rival(scene, name, found) for name, found in by_agent.items() if found.interval.episodes]
        if candidates:
            hardest.append(max(candidates, key=lambda rival: rival.ratio.interval.mean))
    return hardest


def by_scene(found: Sequence[Rival], reference: str) -> str:
    """One line a scene: the hardest other agent and how the reference compares."""
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
    header = ["scene", "hardest other agent", f"{reference}'s way is", "pairs", f"ratio to {GOAL} %"]
    return html_table([*header, "shorter", "missed"], lines, 3)


@dataclass(frozen=True)
class Compared:
    """``other - reference`` at one path length or time, over the pairs in which both are known there."""

    other: str
    where: float
    unit: str
    pairs: int  # that there are, known or not
    entropy: Interval  # nats
    coverage: Interval

    @property
    def is_known(self) -> bool:
        """Whether enough pairs say something of the maps' entropy."""
        return self.entropy.episodes > 0 and self.entropy.episodes >= KNOWN_PAIRS * self.pairs

    @property
    def is_behind(self) -> bool:
        """Whether, in the mean of the pairs known, the other's map has the lower entropy."""
        return self.entropy.mean < -TIED  # of no pair: NaN, which is not known either


def compared(rows: Sequence[Row], reference: str, seed: int, axis: metrics.Axis) -> list[Compared]:
    """The reference and each other agent at each point of an axis."""
    return [
        Compared(
            other,
            x,
            UNITS[axis],
            len(metrics.pairs(rows, other, reference)),
            metrics.paired_at(rows, "entropy", other, reference, x, seed, axis),
            metrics.paired_at(rows, "coverage", other, reference, x, seed, axis),
        )
        for other in others(rows, reference)
        for x in EQUAL[axis]
    ]


def named(points: Sequence[Compared]) -> str:
    """``frontier_gain at 5, 10 m, frontier_nearest at 40 m``."""
    at: dict[str, list[str]] = {}
    for point in points:
        at.setdefault(point.other, []).append(f"{point.where:g}")
    return ", ".join(f"{other} at {', '.join(where)} {points[0].unit}" for other, where in at.items())


def at_equal(points: Sequence[Compared]) -> str:
    """Differences of map entropy and of coverage at equal path lengths or times: above and below 0 lead."""
    lines = [
        [
            point.other,
            f"{point.where:g} {point.unit}",
            f"{point.coverage.episodes} of {point.pairs}",
            _scaled(point.entropy, 1e-3),
            _scaled(point.coverage, 100.0),
        ]
        for point in points
    ]
    return html_table(["other agent", "at", "pairs known", "entropy, knat", "coverage, %"], lines, 1)


def _scaled(d: Interval, factor: float) -> str:
    return Interval(factor * d.mean, factor * d.low, factor * d.high, d.tasks, d.episodes).text(1)
