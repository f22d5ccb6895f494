"""The car's part of a report (SPEC 7): reached and touched, two simulators, footprints, slices of the cost-to-go."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from vssm_gym.eval.metrics.aggregate import Row, group_rows
from vssm_gym.eval.report import car_figures as figures
from vssm_gym.eval.report import car_tables as tables
from vssm_gym.eval.report import summary
from vssm_gym.eval.report import tables as report_tables
from vssm_gym.eval.report.value_figures import ValuePainter
from vssm_gym.eval.report.view import View, learned
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.viz import pictures

CUT_HEIGHT = 0.1  # m: through all that the car can run into, and above the floor
TARGETS = 2  # of each scene, whose cost-to-go is drawn

NOTE = (
    "<b>Reached</b>: within 0.10 m of the target, and 15 deg of its heading where a pose is asked, inside the time "
    "limit. <b>Touched</b>: the share of episodes in which the car came to touch anything; touches are how often an "
    "episode did. Seconds and path / bound are of the episodes that reached; the bound is the shortest Reeds-Shepp "
    "curve into the target's region, obstacles apart. Control: the 50 % and 95 % points of an episode's decisions, "
    "wall-clock, with localisation. In brackets 95 % intervals: of shares by Clopper and Pearson, and of their paired "
    "differences by Tango, in which a task counts once however many episodes it has; else the percentile "
    "bootstrap, resampling tasks."
)


def _comparison(rows: Sequence[Row], seed: int) -> str:
    table = tables.simulators(rows, seed)
    if table is None:
        return ""
    return (
        "<h2>Sim to sim</h2><p class=note>Planned on the bicycle's kinematics, executed in each simulator: the same "
        "targets, starts and seeds. Differences are paired, over all scenes; shares in points of %.</p>"
        f"<div class=wide>{table}</div>"
    )


def _plans(rows: Sequence[Row], maps: Mapping[str, VoxelMap], folder: Path) -> str:
    """Slices for the first targets of each scene that has a map, with the first run to each drawn over them."""
    drawn = []
    for (scene,), members in group_rows(rows, ["scene"]).items():
        if scene not in maps:
            continue
        painter = ValuePainter(maps[scene])
        tasks = group_rows([row for row in members if (row.get("trace") or {}).get("poses")], ["task"])
        for (task,), runs in list(tasks.items())[:TARGETS]:
            image, caption = painter.paint(runs[0])
            name = f"{scene} · task {task} · run of {runs[0]['agent']} in {runs[0]['physics']}"
            picture = f"<img src='{pictures.data_url(image, 'image/webp')}' alt='{escape(name)}'>" if image else ""
            drawn.append(f"<figure>{picture}<figcaption>{escape(f'{name}: {caption}')}</figcaption></figure>")
    if not drawn:
        return ""
    return (
        "<h2>Cost-to-go</h2><p class=note>Value iteration on the learned map, as the agents' critic runs it: the least "
        "over all headings, then one heading each, turned by 0, 90, 180 and -90 deg from the target's (the white "
        "outline at the target). Dark: occupied; grey: the footprint would touch something, or no way leads to the "
        f"target. White: start and true path.</p>{''.join(drawn)}"
    )


def _success(row: Row) -> str:
    return "<span class=good>reached</span>" + (", <span class=bad>touched</span>" if row["touched"] else "")


def _numbers(row: Row) -> str:
    counts = f"direction changes {row['direction_changes']}, touches {row['touches']}"
    return f"{row['seconds']:.1f} s, {row['path_length']:.1f} m (bound {row['geodesic']:.1f} m), {counts}"


SUMMARY = {
    "reached %": summary.mean("reached"),
    "touched %": summary.mean("touched"),
    "seconds": summary.alone("seconds_driven"),
}

CAR_VIEW = View(
    conditions=("physics", "renderer", "robot", "noise", "sensor_noise"),
    measures=tables.CAR,
    note=NOTE,
    summary=SUMMARY,
    headline=lambda rows, seed: report_tables.headline(rows, seed, tables.CAR, tables.pooled(rows)),
    comparison=_comparison,
    curves_by=lambda rows: [name for name in report_tables.grouping(rows) if name not in ("scene", "agent")],
    curves=figures.curves,
    plans=_plans,
    backgrounds=learned(CUT_HEIGHT),
    drawn_on="on the map that the agents were given",
    cut_height=CUT_HEIGHT,
    failed=lambda row: bool(row["failure"] or row["touched"]),
    failures="Failures and touches",
    such="episodes that failed or touched something",
    without_failures="None: every target was reached, nothing was touched.",
    legend=figures.legend,
    picture=figures.run_picture,
    condition=lambda row: f"{row['scene']} · {row['physics']} · {row['noise']}",
    success=_success,
    numbers=_numbers,
)
