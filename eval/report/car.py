"""Define the car's report: targets reached, collisions, two simulators, footprints, slices of the cost-to-go."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from vssm_gym.eval.metrics.aggregate import group_rows
from vssm_gym.eval.metrics.metric import Row
from vssm_gym.eval.report import car_figures, car_tables, summary, tables
from vssm_gym.eval.report.ranking import Ranking, by_metric, paired_difference
from vssm_gym.eval.report.value_figures import ValuePainter
from vssm_gym.eval.report.view import Mark, Plan, View, learned
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.viz.html import webp_image

CAR_CUT_HEIGHT = 0.1  # m: cuts all obstacles of the car and lies above the floor
DRAWN_TARGETS = 2  # targets of each scene whose cost-to-go is drawn


def _plans(rows: Sequence[Row], maps: Mapping[str, VoxelMap], folder: Path) -> list[Plan]:
    """Draw slices for the first targets of each scene that has a map, with the first run to each of them."""
    drawn = []
    for (scene,), members in group_rows(rows, ["scene"]).items():
        if scene not in maps:
            continue
        painter = ValuePainter(maps[scene])
        tasks = group_rows([row for row in members if (row.get("trace") or {}).get("poses")], ["task"])
        for (task,), runs in list(tasks.items())[:DRAWN_TARGETS]:
            image, caption = painter.paint(runs[0])
            name = (scene, f"task {task}", f"run of {runs[0]['agent']} in {runs[0]['physics']}")
            drawn.append(Plan(name, webp_image(image) if image else None, caption))
    return drawn


def _success(row: Row) -> list[Mark]:
    return [("reached", "good"), ("collided", "bad")][: 1 + bool(row["collided"])]


def _numbers(row: Row) -> str:
    counts = f"direction changes {row['direction_changes']}, collision events {row['collision_events']}"
    return f"{row['seconds']:.1f} s, {row['path_length']:.1f} m (bound {row['geodesic']:.1f} m), {counts}"


SUMMARY = {
    "reached %": summary.mean("reached"),
    "collided %": summary.mean("collided"),
    "seconds": summary.alone("seconds_driven"),
}

CAR_VIEW = View(
    template="car.html.j2",
    conditions=("physics", "renderer", "robot", "noise", "sensor_noise"),
    measures=car_tables.CAR,
    ranking=Ranking(
        by_metric("reached", "the highest proportion of targets reached", " %"),
        by_metric("seconds_driven", "the fastest", " s"),
        paired_difference("reached"),
        "paired difference in points of %",
        paired_difference("seconds_driven"),
        "paired difference in seconds",
        ("seconds_driven", "collided", "control_p95_ms"),
    ),
    summary=SUMMARY,
    headline=lambda rows, seed, reference: tables.headline(rows, seed, car_tables.CAR, car_tables.pooled(rows)),
    comparison=lambda rows, seed, reference: car_tables.simulators(rows, seed),
    curves_by=tables.pooled,
    curves=car_figures.curves,
    plans=_plans,
    backgrounds=learned(CAR_CUT_HEIGHT),
    failed=lambda row: bool(row["failure"] or row["collided"]),
    legend=car_figures.legend,
    picture=car_figures.run_picture,
    condition=lambda row: (row["scene"], row["physics"], row["noise"]),
    success=_success,
    numbers=_numbers,
    values={"cut_height": f"{CAR_CUT_HEIGHT:g}"},
)
