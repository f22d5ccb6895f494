"""Write the report of a sweep as one self-contained HTML page: headline, failures first, tables, curves, runs."""

import json
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.log import FILE, read_rows
from vssm_gym.eval.episodes.manifest import LISTS, MANIFEST, read_manifest
from vssm_gym.eval.metrics.aggregate import group_rows
from vssm_gym.eval.metrics.metric import Row
from vssm_gym.eval.metrics.registry import measured
from vssm_gym.eval.protocols.registry import SWEPT_ENVIRONMENTS, view_of
from vssm_gym.eval.report import figures, tables
from vssm_gym.eval.report.view import View
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.output_folders import check_file
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.viz import pictures
from vssm_gym.viz.html import STYLE

ORDERED = ("noise", "sensor_noise", "renderer", "physics", "agent")  # fields in the order of the configuration's lists
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
    view: View = view_of(_environment(manifest, folder))
    rows = [measured(row) for row in _in_config_order(read_rows(folder / FILE), manifest["config"])]
    if not rows:
        raise InputError(folder / FILE, "file", "at least one finished episode")
    page = _page(view, rows, manifest, folder, seed)
    with atomic_write(target) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return target


def _environment(manifest: dict[str, Any], folder: Path) -> str:
    envs = manifest["config"].get("env") or [None]
    if envs[0] not in SWEPT_ENVIRONMENTS:
        raise InputError(folder / MANIFEST, "config.env", f"one of {', '.join(SWEPT_ENVIRONMENTS)}; found {envs[0]!r}")
    return envs[0]


def _in_config_order(rows: list[dict[str, Any]], config: dict[str, Any]) -> list[dict[str, Any]]:
    """Sort rows by scene, by the order of the configuration's lists, then by task and seed."""
    rank = {field: {name: i for i, name in enumerate(config[LISTS[field]])} for field in ORDERED}
    return sorted(
        rows,
        key=lambda row: (row["scene"], *(rank[field][row[field]] for field in ORDERED), row["task"], row["seed"]),
    )


def _page(view: View, rows: Sequence[Row], manifest: dict[str, Any], folder: Path, seed: int) -> str:
    files = {row["scene"]: folder / "maps" / f"{row['scene']}.npz" for row in rows}
    maps = {scene: VoxelMap.load(path) for scene, path in files.items() if path.is_file()}
    backgrounds = view.backgrounds(maps, folder, rows)
    reference = tables.reference_agent(rows)
    sections = [
        _header(view, rows, manifest, seed),
        _failures(view, rows, backgrounds),
        "<h2>Results</h2>",
        f"<p class=note>{view.note} {view.measures.directions(tables.known(rows, view.measures))}</p>",
        f"<div class=wide>{tables.results(rows, seed, view.measures)}</div>",
    ]
    if reference:
        sections += [
            f"<h2>Paired differences to {escape(reference)}</h2>",
            "<p class=note>Same task, same seed, same noise stream; an interval that leaves out 0 is a difference.</p>",
            f"<div class=wide>{tables.differences(rows, reference, seed, view.measures)}</div>",
        ]
    sections += [view.comparison(rows, seed), "<h2>Curves</h2>"]
    for group, members in group_rows(rows, view.curves_by(rows)).items():
        image = pictures.data_url(view.curves(members, seed), "image/svg+xml")
        sections.append(f"<h3>{escape(' · '.join(group))}</h3><img src='{image}' alt='curves of {escape(group[0])}'>")
    if any(row.get("latency") for row in rows):
        sections += [
            "<h2>Latency of a step</h2>",
            "<p class=note>Wall-clock times inside a worker that shares this machine with the others.</p>",
            tables.latencies(rows),
        ]
    sections.append(view.plans(rows, maps, folder))
    if any(row.get("trace") for row in rows):
        successes = figures.choose_successes(rows, SUCCESSES_DRAWN)
        sections += ["<h2>Successful runs</h2>", _runs(view, successes, backgrounds)]
    title = f"vssm-gym: {', '.join(dict.fromkeys(row['scene'] for row in rows))}"
    return (
        f"<!doctype html><html lang=en><head><meta charset=utf-8><title>{escape(title)}</title>"
        f"<meta name=viewport content='width=device-width'><style>{STYLE}</style></head>"
        f"<body>{''.join(sections)}</body></html>\n"
    )


def _header(view: View, rows: Sequence[Row], manifest: dict[str, Any], seed: int) -> str:
    config = manifest["config"]
    facts = {
        "episodes": f"{len(rows)} of {manifest['episodes']}" if len(rows) <= manifest["episodes"] else str(len(rows)),
        "configuration": manifest["config_hash"],
        "version": ", ".join(sorted({row["version"] for row in rows if row.get("version")})),
        "environment": ", ".join(config["env"]),
        **{name.replace("_", " "): ", ".join(config[name]) for name in view.conditions},
        "voxel": f"{config['voxel']} m",
        "ends on": ", ".join(sorted({row["end_on"] for row in rows if row.get("end_on")})),
        "seeds": ", ".join(str(seed) for seed in config["seeds"]),
    }
    line = " · ".join(f"{name} <code>{escape(value)}</code>" for name, value in facts.items() if value)
    unfinished = len(rows) < manifest["episodes"]
    warning = "<p class=bad>The sweep has not ended; continue it with --resume.</p>" if unfinished else ""
    headline = view.headline(rows, seed)
    known = {scene: notice for scene, notice in manifest.get("notices", {}).items() if notice}
    notices = "".join(f"<p class=bad>{escape(scene)}: {escape(notice)}</p>" for scene, notice in known.items())
    raw = escape(json.dumps(config, indent=1))
    return (
        f"<h1>{escape(', '.join(dict.fromkeys(row['scene'] for row in rows)))}: {', '.join(config['agents'])}</h1>"
        f"<p class=note>{line}</p>{warning}{notices}{headline}"
        f"<details><summary>configuration</summary><pre>{raw}</pre></details>"
    )


def _failures(view: View, rows: Sequence[Row], backgrounds: Mapping[str, pictures.Background]) -> str:
    shown = [row for row in rows if view.failed(row)]
    if not shown:
        return f"<h2>{view.failures}</h2><p class=good>{view.without_failures}</p>"
    drawn = figures.choose_failures(rows, FAILURES_DRAWN, FAILURES_OF_ONE, view.failed)
    key = pictures.data_url(view.legend(), "image/svg+xml")
    reasons = (
        f"<details><summary>all {failed} failures</summary><div class=wide>{tables.failure_list(rows)}</div></details>"
        if (failed := sum(map(figures.has_failed, rows)))
        else ""
    )
    counts = f"<h2>{view.failures}</h2><div class=wide>{tables.failure_counts(rows)}</div>"
    if not drawn:
        return f"{counts}{reasons}"
    return (
        f"{counts}<p class=note>{len(drawn)} of {len(shown)} {view.such} are drawn, agents that fail rarely first, "
        f"{view.drawn_on} (dark: cut at {view.cut_height:g} m; grey: never seen).</p>"
        f"<img src='{key}' alt='key'>{_runs(view, drawn, backgrounds)}{reasons}"
    )


def _runs(view: View, rows: Sequence[Row], backgrounds: Mapping[str, pictures.Background]) -> str:
    if not rows:
        return "<p class=note>None.</p>"
    return f"<div class=runs>{''.join(_run(view, row, backgrounds.get(row['scene'])) for row in rows)}</div>"


def _run(view: View, row: Row, background: pictures.Background | None) -> str:
    image = pictures.data_url(view.picture(row, background), "image/webp")
    name = f"{row['agent']} · {view.condition(row)} · task {row['task']} · seed {row['seed']}"
    outcome = f"<span class=bad>{escape(row['failure'])}</span>" if row["failure"] else view.success(row)
    return (
        f"<figure><img src='{image}' alt='{escape(name)}'><figcaption>{escape(name)}<br>{outcome}<br>"
        f"{view.numbers(row)}</figcaption></figure>"
    )
