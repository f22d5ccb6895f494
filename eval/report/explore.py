"""Define the explorers' report: path lengths and their ratios, scene by scene, curves, runs, and the final maps."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vssm_gym.eval.metrics.aggregate import Interval, group_rows
from vssm_gym.eval.metrics.exploration import COVERAGE_GOAL, KNOWN, ONE_STEP, Axis, Ratio, median_to_level, ratio
from vssm_gym.eval.metrics.metric import Row
from vssm_gym.eval.report import explore_figures, explore_tables, summary, tables
from vssm_gym.eval.report.explore_tables import PointComparison, Rival
from vssm_gym.eval.report.ranking import Ranking, by_median, by_metric, paired_difference, paired_ratio
from vssm_gym.eval.report.view import Mark, Plan, View, map_file
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.viz import pictures
from vssm_gym.viz.html import Image, Table, svg_image, webp_image

SCENES_SHOWN = 3  # scenes whose final maps are drawn, one an agent
FRONTIER = "frontier"  # prefix of the names of the baselines that the reference is compared with
# The project's own criterion: the mean ratio of path lengths is at most TARGET and its interval below 1; for ratios of
# times only the interval counts.
TARGET = 0.85


@dataclass(frozen=True)
class Lead:
    """Hold the ratio of the reference to the frontier baseline that is best in a measure, and whether it leads."""

    agent: str
    interval: Interval
    target: float | None  # the most that the mean may be; None: only the interval counts

    @property
    def is_below(self) -> bool:
        """Return whether the interval is below 1."""
        return self.interval.high < 1.0

    @property
    def is_low(self) -> bool:
        """Return whether the mean is no more than the target."""
        return self.target is None or self.interval.mean <= self.target

    @property
    def holds(self) -> bool:
        """Return whether the criterion is met."""
        return self.is_below and self.is_low


@dataclass(frozen=True)
class Headline:
    """Hold what the page opens with; all but ``table`` needs a second agent.

    Attributes:
        table: each agent over all scenes.
        reference: the agent that the others are compared with.
        ratios: the reference over each other agent.
        path, time: the leads over the frontier baselines, where a pair with one is known.
        behind: scenes where the reference is not the best.
        higher_entropy: scenes where the reference's map has not the lowest entropy at equal path length, and where.
        unknown_entropy: scenes where it is unknown, likewise.
    """

    table: Table
    reference: str | None = None
    ratios: Table | None = None
    path: Lead | None = None
    time: Lead | None = None
    behind: Sequence[Rival] = ()
    higher_entropy: Mapping[str, list[str]] | None = None
    unknown_entropy: Mapping[str, list[str]] | None = None


def headline(rows: Sequence[Row], seed: int, reference: str | None) -> Headline:
    """Compare the reference with the frontier baselines, and find the scenes where it is not the best."""
    table = explore_tables.headline(rows, seed)
    if not reference:
        return Headline(table)
    baselines = [name for name in explore_tables.others(rows, reference) if name.startswith(FRONTIER)]
    found = {name: ratio(rows, reference, name, COVERAGE_GOAL, seed) for name in baselines}
    found = {name: r for name, r in found.items() if r.interval.episodes}
    times = {name: ratio(rows, reference, name, COVERAGE_GOAL, seed, "seconds") for name in found}
    scenes = group_rows(rows, ["scene"]).items()
    points = {scene: explore_tables.compared(members, reference, 0, "metres") for (scene,), members in scenes}
    rivals = explore_tables.rivals(rows, reference, seed)
    return Headline(
        table,
        reference,
        explore_tables.ratios(rows, reference, seed),
        _lead(found, TARGET),
        _lead(times, None),
        [rival for rival in rivals if rival.ratio.interval.mean >= 1.0],
        _where(points, lambda point: point.is_behind),
        _where(points, lambda point: not point.is_known),
    )


def _lead(found: Mapping[str, Ratio], target: float | None) -> Lead | None:
    """Return the lead over the strongest baseline, that with the largest mean."""
    if not found:
        return None
    best = max(found, key=lambda name: found[name].interval.mean)
    return Lead(best, found[best].interval, target)


def _where(
    found: Mapping[str, list[PointComparison]], holds: Callable[[PointComparison], bool]
) -> Mapping[str, list[str]]:
    """Name the points for which a statement holds, in each scene that has some."""
    chosen = {scene: [point for point in points if holds(point)] for scene, points in found.items()}
    return {scene: explore_tables.named(points) for scene, points in chosen.items() if points}


@dataclass(frozen=True)
class AtEqual:
    """Hold the comparison along one axis: its table, and the points that rest on few pairs."""

    table: Table
    few: list[str]


@dataclass(frozen=True)
class Comparison:
    """Hold the section after the tables of metrics; what names the reference needs a second agent."""

    reached: Image
    coverage: Image
    reference: str | None = None
    scenes: Table | None = None
    by_path: AtEqual | None = None
    by_time: AtEqual | None = None


def comparison(rows: Sequence[Row], seed: int, reference: str | None) -> Comparison:
    """Compare agents scene by scene, at equal path length and time, and by their curves."""
    reached, coverage = svg_image(explore_figures.reached(rows)), svg_image(explore_figures.scenes(rows, seed))
    if not reference:
        return Comparison(reached, coverage)
    scenes = explore_tables.by_scene(explore_tables.rivals(rows, reference, seed), reference)
    by_path, by_time = (_at_equal(rows, reference, seed, axis) for axis in ("metres", "seconds"))
    return Comparison(reached, coverage, reference, scenes, by_path, by_time)


def _at_equal(rows: Sequence[Row], reference: str, seed: int, axis: Axis) -> AtEqual:
    points = explore_tables.compared(rows, reference, seed, axis)
    few = explore_tables.named([point for point in points if not point.is_known])
    return AtEqual(explore_tables.at_equal(points), few)


def _backgrounds(maps: Mapping[str, VoxelMap], folder: Path, rows: Sequence[Row]) -> dict[str, pictures.Background]:
    """Draw the final map of widest coverage of each scene; one map is in memory at a time."""
    del maps  # explorers are given none
    kept = group_rows([row for row in rows if _map_file(folder, row)], ["scene"])
    best = {scene: max(members, key=lambda row: row["coverage"]) for (scene,), members in kept.items()}
    return {scene: _plan(folder, row) for scene, row in best.items()}


def _map_file(folder: Path, row: Row) -> Path | None:
    return map_file(folder / "explored", row["explored"]) if row.get("explored") else None


def _plan(folder: Path, row: Row) -> pictures.Background:
    file = _map_file(folder, row)
    assert file is not None
    return explore_figures.plan_of(VoxelMap.load(file))


def _plans(rows: Sequence[Row], maps: Mapping[str, VoxelMap], folder: Path) -> list[Plan]:
    """Draw the agents' final maps in the first scenes, with the runs that made them."""
    del maps
    kept = group_rows([row for row in rows if _map_file(folder, row)], ["scene"])
    drawn = []
    for (scene,), members in list(kept.items())[:SCENES_SHOWN]:
        for row in members:
            image = explore_figures.run_picture(row, _plan(folder, row))
            drawn.append(Plan((scene, row["agent"], f"start {row['task']}"), webp_image(image), _numbers(row)))
    return drawn


def _success(row: Row) -> list[Mark]:
    marks = [(f"{100.0 * row['coverage']:.0f} % covered", "good"), (row["status"], ""), ("collided", "bad")]
    return marks if row["collided"] else marks[:2]


def _numbers(row: Row) -> str:
    metres = "-" if row["metres_90"] is None else f"{row['metres_90']:.1f}"
    return f"{COVERAGE_GOAL} % after {metres} m; {row['path_length']:.1f} m and {row['seconds']:.0f} s in all"


SUMMARY = {
    f"m to {COVERAGE_GOAL} %": lambda rows: explore_tables.median_text(median_to_level(rows, COVERAGE_GOAL)),
    f"covered {COVERAGE_GOAL} %": summary.mean("covered_90"),
    "collided": lambda rows: str(sum(bool(row["collided"]) for row in rows)),
}

EXPLORE_VIEW = View(
    template="explore.html.j2",
    conditions=("renderer", "robot", "noise", "sensor_noise", "direction_frame"),
    measures=explore_tables.EXPLORE,
    ranking=Ranking(
        by_median(COVERAGE_GOAL),
        by_metric("coverage_percent", "the one with the highest coverage", " %"),
        paired_ratio(COVERAGE_GOAL),
        "paired ratio of path lengths",
        paired_difference("coverage_percent"),
        "paired difference in points of %",
        ("coverage_percent", "collided", "decision_p95_ms"),
    ),
    summary=SUMMARY,
    headline=headline,
    comparison=comparison,
    curves_by=tables.pooled,
    curves=explore_figures.curves,
    plans=_plans,
    backgrounds=_backgrounds,
    failed=lambda row: bool(row["failure"] or row["collided"]),
    legend=explore_figures.legend,
    picture=explore_figures.run_picture,
    condition=lambda row: (row["scene"], row["noise"]),
    success=_success,
    numbers=_numbers,
    values={
        "cut_height": f"{pictures.CUT_HEIGHT:g}",
        "goal": COVERAGE_GOAL,
        "known_percent": f"{100 * KNOWN:.0f}",
        "step_seconds": f"{ONE_STEP['seconds']:g}",
    },
)
