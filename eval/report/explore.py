"""The explorers' part of a report (SPEC 8): ways and their ratios, scene by scene, curves, runs, maps that are left."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from vssm_gym.eval.metrics.aggregate import Row, group_rows
from vssm_gym.eval.metrics.exploration import GOAL, KNOWN, LEAST, Axis, Ratio, median_way, ratio
from vssm_gym.eval.report import explore_figures as figures
from vssm_gym.eval.report import explore_tables as tables
from vssm_gym.eval.report import summary
from vssm_gym.eval.report.tables import reference_agent
from vssm_gym.eval.report.view import View
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.viz import pictures

SCENES_SHOWN = 3  # whose maps are drawn, one an agent
FRONTIER = "frontier"  # what the names of the baselines that the claim is about begin with
# The claim (SPEC 8): the mean ratio of ways is no more than this, and its interval below 1. None is made of times.
TARGET = 0.85

NOTE = (
    "Scene by scene. Metres and seconds to a share of coverage are means of the runs that got there, which "
    "flatters agents that often do not: the headline's medians and ratios count the others. <b>Coverage</b>: of "
    "the area that can be seen at all from where the robot can get. <b>Information</b>: by how much the entropy "
    "of the map's occupancy is below the prior's. <b>Surface complete</b>: the share of the surface that could be "
    "seen which the map shows within 10 cm. <b>Mesh</b>: mean distance of the map's surface from the scene "
    "(accuracy), and of what could be seen from the map's surface, 50 cm at most (completion). <b>Navigation</b>: "
    "PointNav tasks of the scene, driven by <code>astar</code> on the map that the run left. <b>Touched</b>: runs "
    "in which the robot touched anything. In brackets 95 % intervals: of shares by Clopper and Pearson, else the "
    "percentile bootstrap over starts."
)
CENSORED = (
    f"A run that ended below {GOAL} % (or 95 or 99 %) is censored, and counts: in medians as longer than any that got "
    "there, in ratios with the value that speaks against the first agent. If time was out for the other agent the "
    "metres that it had driven stand for its way, which would have been longer; if it stopped by itself the ratio "
    "counts as 1 at most; if the first agent did not get there, all the metres that a robot can drive in the time "
    "stand for its way. Pairs in which neither got there say nothing. Ratios are geometric means over pairs of "
    "the same scene, start and noise; intervals resample whole scenes (with one scene: starts). <i>Missed</i>: "
    "runs of the first / of the other agent that did not get there. Seconds are simulated, "
    f"{LEAST['seconds']:g} s a step: the time that an agent thinks is not in them; see decision p95 and the latencies."
)
EQUAL = (
    "Other agent less {reference}, over pairs in which both are known there: an agent that stopped keeps its map, one "
    "for which time was out before is not known. Entropy above 0 and coverage below 0 speak for {reference}. Read the "
    "two tables together. A further image of a cell that n images have shown lowers its entropy by 1/(2n) nats, and "
    "turning on the spot costs no metres: at equal path length entropy rewards who takes more images a metre, even "
    "where both have seen the same. Coverage does not, and at equal time all that still run have taken as many images."
)


def _headline(rows: Sequence[Row], seed: int) -> str:
    reference = reference_agent(rows)
    page = f"<div class=wide>{tables.headline(rows, seed)}</div>"
    if reference:
        page += f"<div class=wide>{tables.ratios(rows, reference, seed)}</div>{_verdict(rows, reference, seed)}"
    return f"{page}<p class=note>{CENSORED}</p>"


def _verdict(rows: Sequence[Row], reference: str, seed: int) -> str:
    """What the ratios say of the reference and the baselines that are frontier explorers, and where it is not so."""
    baselines = [name for name in tables.others(rows, reference) if name.startswith(FRONTIER)]
    found = {name: ratio(rows, reference, name, GOAL, seed) for name in baselines}
    found = {name: r for name, r in found.items() if r.interval.episodes}
    said = ""
    if found:
        said = _leads(f"To {GOAL} % coverage {reference} drives", "the way", found, TARGET)
        times = {name: ratio(rows, reference, name, GOAL, seed, "seconds") for name in found}
        said += _leads("It takes", "the simulated time, without thinking,", times)
    behind = [rival for rival in tables.rivals(rows, reference, seed) if rival.ratio.interval.mean >= 1.0]
    where = ", ".join(f"{rival.scene} ({rival.agent}, {rival.ratio.text})" for rival in behind)
    said += f"<p class=bad>{escape(reference)} is not the best in: {escape(where)}.</p>" if behind else ""
    return said + _entropy(rows, reference)


def _leads(claim: str, what: str, found: Mapping[str, Ratio], target: float | None = None) -> str:
    """One line of the ratio to the baseline that is hardest to beat; red where it is not what is asked for.

    Its interval has to be below 1, and its mean no more than ``target``.
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
    """Where the reference's map does not have the lowest entropy at equal path length, and where nobody knows."""
    scenes = group_rows(rows, ["scene"]).items()
    found = {scene: tables.compared(members, reference, 0, "metres") for (scene,), members in scenes}
    behind = {scene: [point for point in points if point.is_behind] for scene, points in found.items()}
    unknown = {scene: [point for point in points if not point.is_known] for scene, points in found.items()}
    said = ""
    for claim, where in (
        ("Its map's entropy at equal path length is not the lowest in", behind),
        ("Fewer than half of the pairs tell whose entropy is the lower one in", unknown),
    ):
        listed = "; ".join(f"{scene} ({tables.named(points)})" for scene, points in where.items() if points)
        said += f"<p class=bad>{claim}: {escape(listed)}.</p>" if listed else ""
    return said


def _comparison(rows: Sequence[Row], seed: int) -> str:
    reference = reference_agent(rows)
    page = ""
    if reference:
        page = (
            f"<h2>Scene by scene</h2><p class=note>The other agent whose way to {GOAL} % is the shortest against "
            f"{escape(reference)}'s; intervals over starts.</p>"
            f"<div class=wide>{tables.by_scene(tables.rivals(rows, reference, seed), reference)}</div>"
            f"<h2>At equal path length and time</h2><p class=note>{EQUAL.format(reference=escape(reference))}</p>"
            f"<div class=beside>{_at_equal(rows, reference, seed, 'metres')}"
            f"{_at_equal(rows, reference, seed, 'seconds')}</div>"
        )
    return (
        f"{page}<h2>Runs that got there</h2>{_image(figures.reached(rows), 'share of runs that had covered a share')}"
        f"<h2>Coverage in each scene</h2>{_image(figures.scenes(rows, seed), 'coverage in each scene')}"
        f"<p class=note>Curves of means: an agent that stops keeps its map; one for which time is out is unknown after "
        f"that, and a mean needs {100 * KNOWN:.0f} % of the runs. Entropy is that of the map's occupancy in nats, "
        "relative to the prior: H(M) - H(prior).</p>"
    )


def _at_equal(rows: Sequence[Row], reference: str, seed: int, axis: Axis) -> str:
    """The table of one axis, and what of it rests on few pairs."""
    points = tables.compared(rows, reference, seed, axis)
    few = tables.named([point for point in points if not point.is_known])
    note = f"<p class=note>Fewer than half of the pairs are known of {escape(few)}.</p>" if few else ""
    return f"<div class=wide>{tables.at_equal(points)}{note}</div>"


def _image(content: bytes, name: str) -> str:
    return f"<img src='{pictures.data_url(content, 'image/svg+xml')}' alt='{escape(name)}'>"


def _backgrounds(maps: Mapping[str, VoxelMap], folder: Path, rows: Sequence[Row]) -> dict[str, pictures.Background]:
    """Of each scene the map of widest coverage that a run has left; one is in memory at a time."""
    del maps  # explorers are given none
    kept = group_rows([row for row in rows if _kept(folder, row)], ["scene"])
    best = {scene: max(members, key=lambda row: row["coverage"]) for (scene,), members in kept.items()}
    return {scene: figures.plan_of(VoxelMap.load(_file(folder, row))) for scene, row in best.items()}


def _file(folder: Path, row: Row) -> Path:
    return folder / "explored" / str(row["explored"])


def _kept(folder: Path, row: Row) -> bool:
    return bool(row.get("explored")) and _file(folder, row).is_file()


def _plans(rows: Sequence[Row], maps: Mapping[str, VoxelMap], folder: Path) -> str:
    """The maps that the agents have left in the first scenes, with the runs that made them."""
    del maps
    kept = group_rows([row for row in rows if _kept(folder, row)], ["scene"])
    drawn = []
    for (scene,), members in list(kept.items())[:SCENES_SHOWN]:
        for row in members:
            image = figures.run_picture(row, figures.plan_of(VoxelMap.load(_file(folder, row))))
            name = f"{scene} · {row['agent']} · start {row['task']}"
            url = pictures.data_url(image, "image/webp")
            drawn.append(
                f"<figure><img src='{url}' alt='{escape(name)}'><figcaption>{escape(name)}<br>{_numbers(row)}"
                "</figcaption></figure>"
            )
    if not drawn:
        return ""
    note = f"From above, cut at {figures.CUT_HEIGHT:g} m; grey was never seen. The files are in explored/."
    return f"<h2>Maps that are left</h2><p class=note>{note}</p><div class=runs>{''.join(drawn)}</div>"


def _success(row: Row) -> str:
    said = f"<span class=good>{100.0 * row['coverage']:.0f} % covered</span>, {escape(row['status'])}"
    return said + (", <span class=bad>touched</span>" if row["touched"] else "")


def _numbers(row: Row) -> str:
    way = "-" if row["metres_90"] is None else f"{row['metres_90']:.1f}"
    return f"{GOAL} % after {way} m; {row['path_length']:.1f} m and {row['seconds']:.0f} s in all"


SUMMARY = {
    f"m to {GOAL} %": lambda rows: tables.way(median_way(rows, GOAL)),
    f"covered {GOAL} %": summary.mean("covered_90"),
    "touched": lambda rows: str(sum(bool(row["touched"]) for row in rows)),
}

EXPLORE_VIEW = View(
    conditions=("renderer", "robot", "noise", "sensor_noise"),
    measures=tables.EXPLORE,
    note=NOTE,
    summary=SUMMARY,
    headline=_headline,
    comparison=_comparison,
    curves_by=tables.pooled,
    curves=figures.curves,
    plans=_plans,
    backgrounds=_backgrounds,
    drawn_on="on the map of widest coverage that an explorer left there",
    cut_height=figures.CUT_HEIGHT,
    failed=lambda row: bool(row["failure"] or row["touched"]),
    failures="Failures and touches",
    such=f"runs that ended below {GOAL} % or touched something",
    without_failures=f"None: every run covered {GOAL} %, nothing was touched.",
    legend=figures.legend,
    picture=figures.run_picture,
    condition=lambda row: f"{row['scene']} · {row['noise']}",
    success=_success,
    numbers=_numbers,
)
