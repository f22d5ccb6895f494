"""Define what differs between the reports of environments; :mod:`vssm_gym.eval.report.page` collects the page."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vssm_gym.eval.episodes.row import identified
from vssm_gym.eval.metrics.metric import Row
from vssm_gym.eval.report import figures, summary, tables
from vssm_gym.eval.report.ranking import Ranking, by_metric, paired_difference
from vssm_gym.eval.report.scene_plans import scene_plans
from vssm_gym.eval.report.summary import Column
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.viz import pictures
from vssm_gym.viz.html import Image, Table

LONGEST_FILE_NAME = 255  # bytes: a system call with a longer one fails

Mark = tuple[str, str]
"""A text, and how it is set off: ``good``, ``bad``, or empty where it is not."""


@dataclass(frozen=True)
class View:
    """Define how the episodes of an environment are measured, drawn and described.

    Attributes:
        template: of the page (:mod:`vssm_gym.viz.html`), which holds all explanations.
        values: further values that the template names.
        voxel_maps: whether the learned maps of the sweep's folder are voxel maps, on which runs are drawn.
        conditions: lists of the configuration that the page's header shows.
        measures: the metrics of the tables.
        ranking: by what agents are ordered, and which of the best one's metrics the page's tiles show.
        summary: headings and functions of the columns of the table that a sweep prints, one line an agent.
        headline: what follows the tiles: a table, or what else the template shows there; from the rows, the seed of the
            resampling and the agent that others are compared with (None with one agent).
        comparison: what the template shows after the agents' differences, from the same.
        curves_by: fields with one figure of curves for each combination of values.
        curves: that figure as SVG.
        plans: what is drawn from the learned maps, by scene, or from maps in the sweep's folder.
        backgrounds: images that runs are drawn on, by scene, from the same maps.
        failed: whether a run is drawn in the section of failures.
        legend: the key to the pictures as SVG.
        picture: one run on its map as WebP.
        condition: a run's scene and noise.
        success: the outcome of a successful run.
        numbers: a text of a run's steps, times and lengths.
    """

    template: str
    conditions: tuple[str, ...]
    measures: tables.Measures
    ranking: Ranking
    summary: Mapping[str, Column]
    headline: Callable[[Sequence[Row], int, str | None], Any]
    comparison: Callable[[Sequence[Row], int, str | None], Any]
    curves_by: Callable[[Sequence[Row]], Sequence[str]]
    curves: Callable[[Sequence[Row], int], bytes]
    plans: Callable[[Sequence[Row], Mapping[str, VoxelMap], Path], Any]
    backgrounds: Callable[[Mapping[str, VoxelMap], Path, Sequence[Row]], Mapping[str, pictures.Background]]
    failed: Callable[[Row], bool]
    legend: Callable[[], bytes]
    picture: Callable[[Row, pictures.Background | None], bytes]
    condition: Callable[[Row], tuple[str, ...]]
    success: Callable[[Row], list[Mark]]
    numbers: Callable[[Row], str]
    values: Mapping[str, Any] = field(default_factory=dict)
    voxel_maps: bool = True


@dataclass(frozen=True)
class Plan:
    """Hold a picture of a map with the run that it belongs to; ``image`` is None where there is nothing to draw."""

    name: tuple[str, ...]
    image: Image | None
    caption: str


def map_file(folder: Path, name: str) -> Path | None:
    """Return the file ``name`` in ``folder``; None where there is none, or where a row's name leads elsewhere."""
    plain = name == Path(name).name and len(os.fsencode(name)) <= LONGEST_FILE_NAME
    return folder / name if plain and (folder / name).is_file() else None


def learned(
    cut_height: float,
) -> Callable[[Mapping[str, VoxelMap], Path, Sequence[Row]], dict[str, pictures.Background]]:
    """Return ``backgrounds`` of a view whose runs are drawn on the agents' maps, cut at ``cut_height`` m."""
    return lambda maps, folder, rows: {scene: pictures.topdown(m, cut_height) for scene, m in maps.items()}


def _learned_or_true(maps: Mapping[str, VoxelMap], folder: Path, rows: Sequence[Row]) -> dict[str, pictures.Background]:
    """Return ``backgrounds`` of PointNav: the agents' maps, and the scene itself where no agent was given one."""
    return scene_plans(folder, rows, maps) | learned(pictures.CUT_HEIGHT)(maps, folder, rows)


def _headline(rows: Sequence[Row], seed: int, reference: str | None) -> Table | None:
    """Return the table of conditions; None with one, whose metrics the ranking and the results show."""
    del reference
    by = tables.grouping(rows)
    if len({tuple(str(identified(row, name)) for name in by[:-1]) for row in rows}) < 2:
        return None
    return tables.headline(rows, seed, tables.POINTNAV, by)


SUMMARY = {
    "SPL": summary.mean("spl"),
    "success": summary.mean("success"),
    "error m": summary.alone("location_error_mean"),
}

POINTNAV_VIEW = View(
    template="pointnav.html.j2",
    conditions=("renderer", "robot", "noise", "sensor_noise", "direction_frame"),
    measures=tables.POINTNAV,
    ranking=Ranking(
        by_metric("spl", "the highest SPL"),
        by_metric("success", "the one with the highest success rate"),
        paired_difference("spl"),
        "paired difference of SPL",
        paired_difference("success"),
        "paired difference of success",
        ("success", "collision_rate", "location_error_mean"),
    ),
    summary=SUMMARY,
    headline=_headline,
    comparison=lambda rows, seed, reference: None,
    curves_by=tables.pooled,
    curves=figures.curves,
    plans=lambda rows, maps, folder: None,
    backgrounds=_learned_or_true,
    failed=figures.has_failed,
    legend=figures.legend,
    picture=figures.run_picture,
    condition=lambda row: (row["scene"], row["noise"]),
    success=lambda row: [("success", "good"), (f"SPL {row['spl']:.2f}", "")],
    numbers=lambda row: f"{row['steps']} steps, {row['path_length']:.1f} m of {row['geodesic']:.1f} m",
    values={"cut_height": f"{pictures.CUT_HEIGHT:g}"},
)
