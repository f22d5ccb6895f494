"""Lay out the car's report: targets reached, collisions, two simulators, footprints, slices of the cost-to-go."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from vssm_gym.eval.metrics.aggregate import group_rows
from vssm_gym.eval.metrics.metric import Row
from vssm_gym.eval.report import car_figures, car_tables, summary, tables
from vssm_gym.eval.report.value_figures import ValuePainter
from vssm_gym.eval.report.view import View, learned
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.viz import pictures

CAR_CUT_HEIGHT = 0.1  # m: cuts all obstacles of the car and lies above the floor
DRAWN_TARGETS = 2  # targets of each scene whose cost-to-go is drawn

NOTE = (
    "<b>Reached</b>: within 0.10 m of the target, and 15 deg of its heading where a pose is asked, inside the time "
    "limit. <b>Collided</b>: the proportion of episodes in which the car collided; collision events are how often "
    "contact began in an episode. Seconds and path / bound are of the episodes that reached; the bound is the "
    "shortest Reeds-Shepp curve into the target's region, obstacles ignored. Control: the 50 % and 95 % points of "
    "an episode's decisions, wall-clock, with localisation. In brackets 95 % intervals: of proportions by Clopper "
    "and Pearson, and of their paired differences by Tango, in which a task counts once however many episodes it "
    "has; else the percentile bootstrap, resampling tasks."
)


def _comparison(rows: Sequence[Row], seed: int) -> str:
    table = car_tables.simulators(rows, seed)
    if table is None:
        return ""
    return (
        "<h2>Sim to sim</h2><p class=note>Planned on the bicycle's kinematics, executed in each simulator: the same "
        "targets, starts and seeds. Differences are paired, over all scenes; proportions in points of %.</p>"
        f"<div class=wide>{table}</div>"
    )


def _plans(rows: Sequence[Row], maps: Mapping[str, VoxelMap], folder: Path) -> str:
    """Draw slices for the first targets of each scene that has a map, with the first run to each of them."""
    drawn = []
    for (scene,), members in group_rows(rows, ["scene"]).items():
        if scene not in maps:
            continue
        painter = ValuePainter(maps[scene])
        tasks = group_rows([row for row in members if (row.get("trace") or {}).get("poses")], ["task"])
        for (task,), runs in list(tasks.items())[:DRAWN_TARGETS]:
            image, caption = painter.paint(runs[0])
            name = f"{scene} · task {task} · run of {runs[0]['agent']} in {runs[0]['physics']}"
            picture = f"<img src='{pictures.data_url(image, 'image/webp')}' alt='{escape(name)}'>" if image else ""
            drawn.append(f"<figure>{picture}<figcaption>{escape(f'{name}: {caption}')}</figcaption></figure>")
    if not drawn:
        return ""
    return (
        "<h2>Cost-to-go</h2><p class=note>Value iteration on the learned map, as the agents' critic runs it: the least "
        "over all headings, then one heading each, turned by 0, 90, 180 and -90 deg from the target's (the white "
        "outline at the target). Dark: occupied; grey: the footprint would collide, or no path leads to the "
        f"target. White: start and true path.</p>{''.join(drawn)}"
    )


def _success(row: Row) -> str:
    return "<span class=good>reached</span>" + (", <span class=bad>collided</span>" if row["collided"] else "")


def _numbers(row: Row) -> str:
    counts = f"direction changes {row['direction_changes']}, collision events {row['collision_events']}"
    return f"{row['seconds']:.1f} s, {row['path_length']:.1f} m (bound {row['geodesic']:.1f} m), {counts}"


SUMMARY = {
    "reached %": summary.mean("reached"),
    "collided %": summary.mean("collided"),
    "seconds": summary.alone("seconds_driven"),
}

CAR_VIEW = View(
    conditions=("physics", "renderer", "robot", "noise", "sensor_noise"),
    measures=car_tables.CAR,
    note=NOTE,
    summary=SUMMARY,
    headline=lambda rows, seed: tables.headline(rows, seed, car_tables.CAR, car_tables.pooled(rows)),
    comparison=_comparison,
    curves_by=lambda rows: [name for name in tables.grouping(rows) if name not in ("scene", "agent")],
    curves=car_figures.curves,
    plans=_plans,
    backgrounds=learned(CAR_CUT_HEIGHT),
    drawn_on="on the map that the agents were given",
    cut_height=CAR_CUT_HEIGHT,
    failed=lambda row: bool(row["failure"] or row["collided"]),
    failures="Failures and collisions",
    such="episodes that failed or collided",
    without_failures="None: every target was reached without a collision.",
    legend=car_figures.legend,
    picture=car_figures.run_picture,
    condition=lambda row: f"{row['scene']} · {row['physics']} · {row['noise']}",
    success=_success,
    numbers=_numbers,
)
