"""Lay out the explorers' report: path lengths and their ratios, scene by scene, curves, runs, and the final maps."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from vssm_gym.eval.metrics.aggregate import group_rows
from vssm_gym.eval.metrics.exploration import COVERAGE_GOAL, KNOWN, ONE_STEP, Axis, Ratio, median_to_level, ratio
from vssm_gym.eval.metrics.metric import Row
from vssm_gym.eval.report import explore_figures, explore_tables, summary
from vssm_gym.eval.report.tables import reference_agent
from vssm_gym.eval.report.view import View
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.viz import pictures

SCENES_SHOWN = 3  # scenes whose final maps are drawn, one an agent
FRONTIER = "frontier"  # prefix of the names of the baselines that the reference is compared with
# The project's own criterion: the mean ratio of path lengths is at most TARGET and its interval below 1; for ratios of
# times only the interval counts.
TARGET = 0.85

NOTE = (
    "Scene by scene. Metres and seconds to a level of coverage are means of the runs that reached it, which "
    "flatters agents that often do not: the headline's medians and ratios count the others. <b>Coverage</b>: of the "
    "area that can be seen from where the robot can get. <b>Information</b>: by how much the entropy of the map's "
    "occupancy is below the prior's. <b>Surface complete</b>: the proportion of the observable surface that the map "
    "shows within 10 cm. <b>Mesh</b>: mean distance of the map's surface from the scene (accuracy), and of the "
    "observable surface from the map's surface, 50 cm at most (completion). <b>Navigation</b>: PointNav tasks of "
    "the scene, driven by <code>astar</code> on the map of the run. <b>Collided</b>: runs with a collision. In "
    "brackets 95 % intervals: of proportions by Clopper and Pearson, else the percentile bootstrap over starts."
)
CENSORED = (
    f"A run that ended below {COVERAGE_GOAL} % (or 95 or 99 %) is censored, and counts: in medians as longer than any "
    "run that reached the level, in ratios with the value that is least favourable to the first agent. If the other "
    "agent ran out of time, the metres that it had driven replace its path length, which would have been longer; if "
    "it stopped by itself, the ratio counts as 1 at most; if the first agent did not reach the level, all the "
    "metres that a robot can drive in the time replace its path length. Pairs in which neither reached it are left "
    "out. Ratios are geometric means over pairs of the same scene, start and noise; intervals resample whole scenes "
    "(with one scene: starts). <i>Missed</i>: runs of the first / of the other agent that did not reach the level. "
    f"Seconds are simulated, {ONE_STEP['seconds']:g} s a step, without the agents' computing time: see decision p95 "
    "and the latencies."
)
EQUAL = (
    "Other agent minus {reference}, over pairs in which both are known there: an agent that stopped keeps its map, "
    "one that ran out of time before is unknown. Entropy above 0 and coverage below 0 favour {reference}. Read the "
    "two tables together. A further image of a cell that n images have shown lowers its entropy by 1/(2n) nats, and "
    "turning on the spot costs no metres: at equal path length entropy rewards more images a metre, even where both "
    "have seen the same. Coverage does not, and at equal time all running agents have taken as many images."
)


def _headline(rows: Sequence[Row], seed: int) -> str:
    reference = reference_agent(rows)
    page = f"<div class=wide>{explore_tables.headline(rows, seed)}</div>"
    if reference:
        page += f"<div class=wide>{explore_tables.ratios(rows, reference, seed)}</div>"
        page += _verdict(rows, reference, seed)
    return f"{page}<p class=note>{CENSORED}</p>"


def _verdict(rows: Sequence[Row], reference: str, seed: int) -> str:
    """State how the reference compares with the frontier baselines, and the scenes where it is not the best."""
    baselines = [name for name in explore_tables.others(rows, reference) if name.startswith(FRONTIER)]
    found = {name: ratio(rows, reference, name, COVERAGE_GOAL, seed) for name in baselines}
    found = {name: r for name, r in found.items() if r.interval.episodes}
    said = ""
    if found:
        said = _leads(f"To {COVERAGE_GOAL} % coverage {reference} drives", "the path", found, TARGET)
        times = {name: ratio(rows, reference, name, COVERAGE_GOAL, seed, "seconds") for name in found}
        said += _leads("It takes", "the simulated time, without computing time,", times)
    behind = [rival for rival in explore_tables.rivals(rows, reference, seed) if rival.ratio.interval.mean >= 1.0]
    where = ", ".join(f"{rival.scene} ({rival.agent}, {rival.ratio.text})" for rival in behind)
    said += f"<p class=bad>{escape(reference)} is not the best in: {escape(where)}.</p>" if behind else ""
    return said + _entropy(rows, reference)


def _leads(claim: str, what: str, found: Mapping[str, Ratio], target: float | None = None) -> str:
    """State the ratio to the strongest baseline in one line, red where the criterion is missed.

    The interval has to be below 1, and the mean no more than ``target``.
    """
    best = max(found, key=lambda name: found[name].interval.mean)
    interval = found[best].interval
    below, low = interval.high < 1.0, target is None or interval.mean <= target
    said = f"{claim} {interval.text(3)} of {what} of the frontier baseline that is best in it, {best}. "
    said += "" if target is None else f"A mean of at most {target:g}: {_met(low)}. "
    said += f"An interval below 1: {_met(below)}."
    return f"<p class={'good' if below and low else 'bad'}>{escape(said)}</p>"


def _met(holds: bool) -> str:
    return "met" if holds else "missed"


def _entropy(rows: Sequence[Row], reference: str) -> str:
    """List scenes where the reference's map has not the lowest entropy at equal path length, or where it is unknown."""
    scenes = group_rows(rows, ["scene"]).items()
    found = {scene: explore_tables.compared(members, reference, 0, "metres") for (scene,), members in scenes}
    behind = {scene: [point for point in points if point.is_behind] for scene, points in found.items()}
    unknown = {scene: [point for point in points if not point.is_known] for scene, points in found.items()}
    said = ""
    for claim, where in (
        ("Its map's entropy at equal path length is not the lowest in", behind),
        ("Fewer than half of the pairs show whose entropy is lower in", unknown),
    ):
        listed = "; ".join(f"{scene} ({explore_tables.named(points)})" for scene, points in where.items() if points)
        said += f"<p class=bad>{claim}: {escape(listed)}.</p>" if listed else ""
    return said


def _comparison(rows: Sequence[Row], seed: int) -> str:
    reference = reference_agent(rows)
    page = ""
    if reference:
        page = (
            f"<h2>Scene by scene</h2><p class=note>The other agent whose path to {COVERAGE_GOAL} % is the shortest "
            f"relative to {escape(reference)}'s; intervals over starts.</p>"
            f"<div class=wide>{explore_tables.by_scene(explore_tables.rivals(rows, reference, seed), reference)}</div>"
            f"<h2>At equal path length and time</h2><p class=note>{EQUAL.format(reference=escape(reference))}</p>"
            f"<div class=beside>{_at_equal(rows, reference, seed, 'metres')}"
            f"{_at_equal(rows, reference, seed, 'seconds')}</div>"
        )
    return (
        f"{page}<h2>Runs that reached a coverage</h2>"
        f"{_image(explore_figures.reached(rows), 'proportion of runs that had reached a coverage')}"
        f"<h2>Coverage in each scene</h2>{_image(explore_figures.scenes(rows, seed), 'coverage in each scene')}"
        f"<p class=note>Curves of means: an agent that stops keeps its map; one that runs out of time is unknown after "
        f"that, and a mean needs {100 * KNOWN:.0f} % of the runs. Entropy is that of the map's occupancy in nats, "
        "relative to the prior: H(M) - H(prior).</p>"
    )


def _at_equal(rows: Sequence[Row], reference: str, seed: int, axis: Axis) -> str:
    """Build the table of one axis, with a note of the points that rest on few pairs."""
    points = explore_tables.compared(rows, reference, seed, axis)
    few = explore_tables.named([point for point in points if not point.is_known])
    note = f"<p class=note>Fewer than half of the pairs are known of {escape(few)}.</p>" if few else ""
    return f"<div class=wide>{explore_tables.at_equal(points)}{note}</div>"


def _image(content: bytes, name: str) -> str:
    return f"<img src='{pictures.data_url(content, 'image/svg+xml')}' alt='{escape(name)}'>"


def _backgrounds(maps: Mapping[str, VoxelMap], folder: Path, rows: Sequence[Row]) -> dict[str, pictures.Background]:
    """Draw the final map of widest coverage of each scene; one map is in memory at a time."""
    del maps  # explorers are given none
    kept = group_rows([row for row in rows if _kept(folder, row)], ["scene"])
    best = {scene: max(members, key=lambda row: row["coverage"]) for (scene,), members in kept.items()}
    return {scene: explore_figures.plan_of(VoxelMap.load(_file(folder, row))) for scene, row in best.items()}


def _file(folder: Path, row: Row) -> Path:
    return folder / "explored" / str(row["explored"])


def _kept(folder: Path, row: Row) -> bool:
    return bool(row.get("explored")) and _file(folder, row).is_file()


def _plans(rows: Sequence[Row], maps: Mapping[str, VoxelMap], folder: Path) -> str:
    """Draw the agents' final maps in the first scenes, with the runs that made them."""
    del maps
    kept = group_rows([row for row in rows if _kept(folder, row)], ["scene"])
    drawn = []
    for (scene,), members in list(kept.items())[:SCENES_SHOWN]:
        for row in members:
            image = explore_figures.run_picture(row, explore_figures.plan_of(VoxelMap.load(_file(folder, row))))
            name = f"{scene} · {row['agent']} · start {row['task']}"
            url = pictures.data_url(image, "image/webp")
            drawn.append(
                f"<figure><img src='{url}' alt='{escape(name)}'><figcaption>{escape(name)}<br>{_numbers(row)}"
                "</figcaption></figure>"
            )
    if not drawn:
        return ""
    note = f"From above, cut at {pictures.CUT_HEIGHT:g} m; grey was never seen. The files are in explored/."
    return f"<h2>Final maps</h2><p class=note>{note}</p><div class=runs>{''.join(drawn)}</div>"


def _success(row: Row) -> str:
    said = f"<span class=good>{100.0 * row['coverage']:.0f} % covered</span>, {escape(row['status'])}"
    return said + (", <span class=bad>collided</span>" if row["collided"] else "")


def _numbers(row: Row) -> str:
    metres = "-" if row["metres_90"] is None else f"{row['metres_90']:.1f}"
    return f"{COVERAGE_GOAL} % after {metres} m; {row['path_length']:.1f} m and {row['seconds']:.0f} s in all"


SUMMARY = {
    f"m to {COVERAGE_GOAL} %": lambda rows: explore_tables.median_text(median_to_level(rows, COVERAGE_GOAL)),
    f"covered {COVERAGE_GOAL} %": summary.mean("covered_90"),
    "collided": lambda rows: str(sum(bool(row["collided"]) for row in rows)),
}

EXPLORE_VIEW = View(
    conditions=("renderer", "robot", "noise", "sensor_noise"),
    measures=explore_tables.EXPLORE,
    note=NOTE,
    summary=SUMMARY,
    headline=_headline,
    comparison=_comparison,
    curves_by=explore_tables.pooled,
    curves=explore_figures.curves,
    plans=_plans,
    backgrounds=_backgrounds,
    drawn_on="on the final map of widest coverage of that scene",
    cut_height=pictures.CUT_HEIGHT,
    failed=lambda row: bool(row["failure"] or row["collided"]),
    failures="Failures and collisions",
    such=f"runs that ended below {COVERAGE_GOAL} % or collided",
    without_failures=f"None: every run covered {COVERAGE_GOAL} % without a collision.",
    legend=explore_figures.legend,
    picture=explore_figures.run_picture,
    condition=lambda row: f"{row['scene']} · {row['noise']}",
    success=_success,
    numbers=_numbers,
)
