"""Write the results page from ``eval/baselines``: what its README says of each folder, and figures of its rows.

A sweep gives the headline metrics of its report, with 95 % intervals, for each agent and condition: the mean, and of a
score the interquartile mean too. Policies of one training are one line, over tasks and training seeds. A run of the
benchmark gives the scores of its entries in each track. A study gives the means that it has stored with an interval.
"""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from vssm_gym.eval.benchmark import manifest as benchmark_manifest
from vssm_gym.eval.benchmark import results as benchmark_results
from vssm_gym.eval.benchmark.suite import read_suite, suite_file
from vssm_gym.eval.episodes.log import FILE, read_rows
from vssm_gym.eval.episodes.manifest import MANIFEST, read_manifest
from vssm_gym.eval.metrics.registry import measured
from vssm_gym.eval.metrics.training_runs import by_method
from vssm_gym.eval.protocols.registry import view_of
from vssm_gym.eval.report import tables

BASELINES = Path(__file__).resolve().parents[2] / "eval" / "baselines"
LABELS = ("model", "seconds", "steps")  # fields that tell the rows of a study apart
SPACE = "\N{NO-BREAK SPACE}"
LISTED = 40  # figures of a study, at most


def results() -> str:
    """Return a section for each row of the README's table."""
    return "\n".join(section(*cells) for cells in described())


def described() -> Iterator[tuple[list[str], str, str]]:
    """Yield the folders or files, the commit and the text of every row of the README's table."""
    for line in (BASELINES / "README.md").read_text().splitlines():
        if line.startswith("| `"):
            names, commit, text = (cell.strip() for cell in line.strip("|").split(" | ", 2))
            first, *others = re.findall(r"`([\w/.-]+)`", names)
            folder = first.rpartition("/")[0]
            yield [first, *(f"{folder}/{other}" if folder else other for other in others)], commit, text


def section(names: list[str], commit: str, text: str) -> str:
    """Return the section of one row: its heading, commit, text and figures."""
    heading = ", ".join(f"`{name}`" for name in names)
    said = f"Commit {commit}: {text.replace('](../../docs/', '](')}.\n"
    found = [(name, figures(BASELINES / name)) for name in names]
    labelled = [f"`{name}`:\n\n{text}" if len(names) > 1 and text else text for name, text in found]
    return "\n".join([f"## {heading}\n", said, *labelled])


def figures(path: Path) -> str:
    """Return the tables of one folder or file; nothing where no figure has an interval."""
    if (path / FILE).is_file():
        return sweep(path)
    if (path / benchmark_manifest.MANIFEST).is_file():
        return benchmark(path)
    files = [path] if path.is_file() else sorted(path.glob("*.json"))
    found = [(name, text) for file in files for name, text in intervals(json.loads(file.read_text()))]
    found = list(dict.fromkeys(found))[:LISTED]
    return table(["figure", "mean [95 % interval]"], found) if found else ""


def sweep(folder: Path) -> str:
    """Return the headline metrics of a sweep, one line an agent and condition; scenes are pooled.

    Levels of noise are in the order of the configuration.
    """
    config = read_manifest(folder / MANIFEST)["config"]
    view, levels = view_of(config["env"][0]), config["noise"]
    rows = by_method(measured(row) for row in read_rows(folder / FILE))
    rows = sorted(rows, key=lambda row: levels.index(row["noise"]))
    by = [*tables.pooled(rows), "agent"]
    found = tables.results(rows, 0, view.measures, view.measures.headline, by)
    return table(list(found.header), found.lines)


def benchmark(folder: Path) -> str:
    """Return the scores of the entries of a run of the benchmark, one line a track and entry."""
    suite = read_suite(suite_file(benchmark_manifest.read_manifest(folder).suite))
    lines = [
        [found.name, f"`{place.line.entry}`", found.score.label, place.line.score.text(found.score.digits)]
        for found in benchmark_results.tables(suite, folder, {})
        for place in found.places
    ]
    return table(["track", "entry", "score", "mean [95 % interval]"], lines)


def intervals(found: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, str]]:
    """Yield the name and text of every mean with an interval in the JSON of a study."""
    if isinstance(found, dict) and {"mean", "low", "high"} <= found.keys():
        if found["low"] is None or not found["low"] <= found["mean"] <= found["high"]:
            return  # bounds of something else
        yield (
            ", ".join(path).removeprefix("figures, ").removeprefix("rows, "),
            f"{found['mean']:.3g} [{found['low']:.3g}, {found['high']:.3g}]",
        )
    elif isinstance(found, dict):
        label = tuple(
            str(found[name]) if name == "model" else f"{found[name]} {name}" for name in LABELS if name in found
        )
        for name, value in found.items():
            yield from intervals(value, (*path, *label, name))
    elif isinstance(found, list):
        for value in found:
            yield from intervals(value, path)


def table(header: list[str], lines: Any) -> str:
    """Return a Markdown table; a mean and its interval stay on one line."""
    rows = [header, ["---"] * len(header), *([cell.replace(" ", SPACE) for cell in cells] for cells in lines)]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in rows) + "\n"
