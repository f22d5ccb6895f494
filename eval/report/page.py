"""Write the report of a sweep as one self-contained HTML page: summary, failures first, tables, curves, runs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vssm_gym.errors import InputError, one_of
from vssm_gym.eval.episodes.log import FILE, read_rows
from vssm_gym.eval.episodes.manifest import LISTS, MANIFEST, read_manifest
from vssm_gym.eval.episodes.row import DEFAULTS, identified
from vssm_gym.eval.metrics.aggregate import group_rows
from vssm_gym.eval.metrics.metric import Row
from vssm_gym.eval.metrics.registry import measured
from vssm_gym.eval.metrics.training_runs import by_method, run_of
from vssm_gym.eval.protocols.registry import SWEPT_ENVIRONMENTS, view_of
from vssm_gym.eval.report import figures, ranking, tables
from vssm_gym.eval.report.view import Mark, View, map_file
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.output_folders import check_file
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.viz import pictures
from vssm_gym.viz.html import Image, Table, render, svg_image, webp_image

# Fields in the order of the configuration's lists
ORDERED = ("noise", "sensor_noise", "renderer", "physics", "direction_frame", "agent")
FAILURES_DRAWN, FAILURES_OF_ONE, SUCCESSES_DRAWN = 24, 6, 10  # a page stays below 5 MB


def write_report(folder: Path, seed: int = 0, out: Path | None = None) -> Path:
    """Write ``folder/report.html`` from ``episodes.jsonl``, ``sweep.json`` and ``maps/``; return its path.

    The page needs no other file and no network. It appears whole or not at all. It leaves out what the folder lacks:
    pictures of rows without a trace, latencies, maps.

    Args:
        folder: of a sweep.
        seed: of the bootstrap resampling.
        out: the file to write; None: in the folder.

    Raises:
        InputError: ``out`` cannot be written, the folder holds no sweep, or no episode of it has ended.
    """
    target = folder / "report.html" if out is None else out
    if out is not None:
        check_file(out, (".html",))
    manifest = read_manifest(folder / MANIFEST)
    manifest["config"] = {name: [value] for name, value in DEFAULTS.items()} | manifest["config"]
    view: View = view_of(_environment(manifest, folder))
    rows = read_rows(folder / FILE)
    _check(manifest["config"], rows, view, folder)
    rows = by_method(measured(row) for row in _in_config_order(rows, manifest["config"]))
    if not rows:
        raise InputError(folder / FILE, "file", "at least one finished episode")
    reference = tables.reference_agent(rows)
    page = _page(view, _best_first(view, rows), reference, manifest, folder, seed)
    with atomic_write(target) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return target


def _environment(manifest: dict[str, Any], folder: Path) -> str:
    envs = manifest["config"].get("env")
    envs = envs if isinstance(envs, list) and envs else [None]
    if not isinstance(envs[0], str) or envs[0] not in SWEPT_ENVIRONMENTS:
        expected = one_of(SWEPT_ENVIRONMENTS, envs[0])
        raise InputError(folder / MANIFEST, "config.env", expected)
    return envs[0]


def _check(config: dict[str, Any], rows: list[dict[str, Any]], view: View, folder: Path) -> None:
    """Raise InputError for a configuration that lacks what the page shows, and for rows that are not of it."""
    lists = {"scenes", "seeds", *view.conditions, *(LISTS[field] for field in ORDERED)}
    for name in sorted(lists):
        if not isinstance(config.get(name), list):
            raise InputError(folder / MANIFEST, f"config.{name}", f"a list; found {config.get(name)!r:.80}")
    if not isinstance(config.get("voxel"), int | float):
        raise InputError(folder / MANIFEST, "config.voxel", f"metres; found {config.get('voxel')!r:.80}")
    for row in rows:
        for field in ORDERED:
            if (value := identified(row, field)) not in config[LISTS[field]]:
                expected = f"a value of config.{LISTS[field]} in {MANIFEST}; found {value!r:.80}"
                raise InputError(folder / FILE, field, expected)


def _in_config_order(rows: list[dict[str, Any]], config: dict[str, Any]) -> list[dict[str, Any]]:
    """Sort rows by scene, by the order of the configuration's lists, then by task and seed."""
    rank = {field: {name: i for i, name in enumerate(config[LISTS[field]])} for field in ORDERED}
    order = lambda row: (rank[field][identified(row, field)] for field in ORDERED)
    return sorted(rows, key=lambda row: (row["scene"], *order(row), row["task"], row["seed"]))


def _best_first(view: View, rows: Sequence[Row]) -> list[Row]:
    """Sort the agents of each condition by the view's ranking; all else keeps its order."""
    rank = {agent: i for i, agent in enumerate(view.ranking.order(rows))}
    groups = group_rows(rows, [name for name in tables.BY if name != "agent"]).values()
    return [row for members in groups for row in sorted(members, key=lambda row: rank[str(row["agent"])])]


def _page(
    view: View, rows: Sequence[Row], reference: str | None, manifest: dict[str, Any], folder: Path, seed: int
) -> str:
    files = {row["scene"]: map_file(folder / "maps", f"{row['scene']}.npz") for row in rows}
    maps = {scene: VoxelMap.load(path) for scene, path in files.items() if path is not None and view.voxel_maps}
    backgrounds = view.backgrounds(maps, folder, rows)
    successes = None
    if any(row.get("trace") for row in rows):
        successes = _runs(view, figures.choose_successes(rows, SUCCESSES_DRAWN), backgrounds)
    return render(
        view.template,
        environment=_environment(manifest, folder).partition("/")[2],
        scenes=list(files),
        agents=view.ranking.order(rows),
        summary=ranking.summarise(view.ranking, rows, seed),
        known=_facts(view, rows, manifest),
        unfinished=len(rows) < manifest["episodes"],
        notices={scene: notice for scene, notice in manifest.get("notices", {}).items() if notice},
        headline=view.headline(rows, seed, reference),
        config=manifest["config"],
        failures=_failures(view, rows, backgrounds),
        directions=view.measures.directions(tables.known(rows, view.measures)),
        results=tables.results(rows, seed, view.measures),
        each_run=tables.of_each_run(rows, seed, view.measures),
        reference=reference,
        differences=tables.differences(rows, reference, seed, view.measures) if reference else None,
        comparison=view.comparison(rows, seed, reference),
        curves=[
            (group, svg_image(view.curves(members, seed)))
            for group, members in group_rows(rows, view.curves_by(rows)).items()
        ],
        profiles=_profiles(view, rows, seed),
        latencies=tables.latencies(rows) if any(row.get("latency") for row in rows) else None,
        responses=tables.responses(rows),
        plans=view.plans(rows, maps, folder),
        successes=successes,
        **view.values,
    )


def _profiles(view: View, rows: Sequence[Row], seed: int) -> list[tuple[tuple[str, ...], Image]]:
    """Draw the profiles of the scores for each condition, scenes pooled; none where no score is measured."""
    labels = view.measures.scores(rows)
    return [
        (group, svg_image(figures.profiles(members, labels, seed)))
        for group, members in group_rows(rows, tables.pooled(rows)).items()
        if labels
    ]


def _facts(view: View, rows: Sequence[Row], manifest: dict[str, Any]) -> dict[str, Sequence[Any]]:
    """Return what stands under the heading: names, and the values of each."""
    config = manifest["config"]
    finished = f"{len(rows)} of {manifest['episodes']}" if len(rows) <= manifest["episodes"] else str(len(rows))
    return {
        "episodes": [finished],
        "scenes": list(dict.fromkeys(row["scene"] for row in rows)),
        "configuration": [manifest["config_hash"]],
        "version": sorted({row["version"] for row in rows if row.get("version")}),
        "environment": config["env"],
        **{name.replace("_", " "): config[name] for name in view.conditions},
        "voxel": [f"{config['voxel']} m"],
        "ends on": sorted({row["end_on"] for row in rows if row.get("end_on")}),
        "seeds": config["seeds"],
    }


@dataclass(frozen=True)
class Run:
    """Hold the picture of a run and its caption."""

    image: Image
    name: tuple[str, ...]
    outcome: list[Mark]
    numbers: str


@dataclass(frozen=True)
class Failures:
    """Hold the section of runs that failed, or that the view counts among them.

    Attributes:
        shown: the number of such runs.
        counts: failures by kind.
        drawn: some of the runs.
        key: to their pictures.
        listed: every failed episode with its reason, where one failed.
    """

    shown: int
    counts: Table
    drawn: list[Run]
    key: Image
    listed: Table | None


def _failures(view: View, rows: Sequence[Row], backgrounds: Mapping[str, pictures.Background]) -> Failures | None:
    shown = sum(map(view.failed, rows))
    if not shown:
        return None
    drawn = figures.choose_failures(rows, FAILURES_DRAWN, FAILURES_OF_ONE, view.failed)
    return Failures(
        shown,
        tables.failure_counts(rows),
        _runs(view, drawn, backgrounds),
        svg_image(view.legend()),
        tables.failure_list(rows) if any(map(figures.has_failed, rows)) else None,
    )


def _runs(view: View, rows: Sequence[Row], backgrounds: Mapping[str, pictures.Background]) -> list[Run]:
    return [
        Run(
            webp_image(view.picture(row, backgrounds.get(row["scene"]))),
            (run_of(row) or row["agent"], *view.condition(row), f"task {row['task']}", f"seed {row['seed']}"),
            [(row["failure"], "bad")] if row["failure"] else view.success(row),
            view.numbers(row),
        )
        for row in rows
    ]
