"""Define what differs between the reports of environments; :mod:`vssm_gym.eval.report.page` assembles the page."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vssm_gym.eval.metrics.metric import Row
from vssm_gym.eval.report import figures, summary, tables
from vssm_gym.eval.report.summary import Column
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.viz import pictures


@dataclass(frozen=True)
class View:
    """Define how the episodes of an environment are measured, drawn and described.

    Attributes:
        conditions: lists of the configuration that the page's header shows.
        measures: the metrics of the tables.
        note: HTML that explains the metrics.
        summary: headings and functions of the columns of the table that a sweep prints, one line an agent.
        headline: HTML of the tables that the page opens with.
        comparison: HTML of a section after the agents' differences.
        curves_by: fields with one figure of curves for each combination of values.
        curves: that figure as SVG.
        plans: HTML of a section drawn from the learned maps, by scene, or from maps in the sweep's folder.
        backgrounds: images that runs are drawn on, by scene, from the same maps.
        drawn_on: a phrase that names these images.
        cut_height: height at which maps are cut for them, m.
        failed: whether a run is drawn in the section of failures.
        failures: the heading of that section.
        such: a phrase that names those runs.
        without_failures: the text of that section without such runs.
        legend: the key to the pictures as SVG.
        picture: one run on its map as WebP.
        condition: a text of a run's scene and noise.
        success: HTML of the outcome of a successful run.
        numbers: a text of a run's steps, times and lengths.
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
    """Return ``backgrounds`` of a view whose runs are drawn on the agents' maps, cut at ``cut_height`` m."""
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
