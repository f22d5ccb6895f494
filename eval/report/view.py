"""What tells the reports of environments apart; :mod:`vssm_gym.eval.report.page` puts the page together from it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vssm_gym.eval.metrics.aggregate import Row
from vssm_gym.eval.report import figures, summary, tables
from vssm_gym.eval.report.summary import Column
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.viz import pictures


@dataclass(frozen=True)
class View:
    """How the episodes of an environment are measured, drawn and told of.

    Attributes:
        conditions: lists of the configuration that the page opens with.
        measures: of the tables.
        note: HTML, what the results' numbers are.
        summary: heading and text of each column of the table that ends a sweep, from the rows of one agent.
        headline: HTML of the tables that the page opens with.
        comparison: HTML of a section after the agents' differences.
        curves_by: fields with one figure of curves for each combination.
        curves: that figure as SVG.
        plans: HTML of a section drawn from the learned maps, by scene, or from others in the sweep's folder.
        backgrounds: what runs are drawn on, by scene, from the same.
        drawn_on: what that is called.
        cut_height: m, of it.
        failed: whether a run belongs to those that are drawn first.
        failures: the heading of their section.
        such: what those runs are called.
        without_failures: what is said where there are none.
        legend: the key to the pictures as SVG.
        picture: one run on its map as WebP.
        condition: where and how a run took place.
        success: HTML, the outcome of a run that succeeded.
        numbers: what a run took.
    """

    conditions: tuple[str, ...]
    measures: tables.Measures
    note: str
    summary: Mapping[str, Column]
    headline: Callable[[Sequence[Row], int], str]
    comparison: Callable[[Sequence[Row], int], str]
    curves_by: Callable[[Sequence[Row]], Sequence[str]]
    curves: Callable[[Sequence[Row], int], bytes]
    plans: Callable[[Sequence[Row], Mapping[str, VoxelMap], Path], str]
    backgrounds: Callable[[Mapping[str, VoxelMap], Path, Sequence[Row]], Mapping[str, pictures.Background]]
    drawn_on: str
    cut_height: float
    failed: Callable[[Row], bool]
    failures: str
    such: str
    without_failures: str
    legend: Callable[[], bytes]
    picture: Callable[[Row, pictures.Background | None], bytes]
    condition: Callable[[Row], str]
    success: Callable[[Row], str]
    numbers: Callable[[Row], str]


def learned(
    cut_height: float,
) -> Callable[[Mapping[str, VoxelMap], Path, Sequence[Row]], dict[str, pictures.Background]]:
    """``backgrounds`` of a view whose runs are drawn on the maps that agents were given, cut at ``cut_height`` m."""
    return lambda maps, folder, rows: {scene: pictures.topdown(m, cut_height) for scene, m in maps.items()}


SUMMARY = {
    "SPL": summary.mean("spl"),
    "success": summary.mean("success"),
    "error m": summary.alone("location_error_mean"),
}

POINTNAV_VIEW = View(
    conditions=("renderer", "robot", "noise", "sensor_noise"),
    measures=tables.POINTNAV,
    note="Means over tasks; in brackets the 95 % percentile bootstrap interval, resampling tasks. "
    "Location error is measured by the harness against the simulator's pose, at every step.",
    summary=SUMMARY,
    headline=lambda rows, seed: tables.headline(rows, seed, tables.POINTNAV, tables.grouping(rows)),
    comparison=lambda rows, seed: "",
    curves_by=lambda rows: tables.grouping(rows)[:-1],
    curves=figures.curves,
    plans=lambda rows, maps, folder: "",
    backgrounds=learned(pictures.CUT_HEIGHT),
    drawn_on="on the map that the agents were given",
    cut_height=pictures.CUT_HEIGHT,
    failed=figures.has_failed,
    failures="Failures",
    such="failed episodes",
    without_failures="None: every episode succeeded.",
    legend=figures.legend,
    picture=figures.run_picture,
    condition=lambda row: f"{row['scene']} · {row['noise']}",
    success=lambda row: f"<span class=good>success</span>, SPL {row['spl']:.2f}",
    numbers=lambda row: f"{row['steps']} steps, {row['path_length']:.1f} m of {row['geodesic']:.1f} m",
)
