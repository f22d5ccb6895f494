"""Write the outcome of a study: its figures as JSON, one picture, and one self-contained HTML page."""

import contextlib
import json
import os
import platform
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.output_folders import Owner, check_new_file, owned_folder
from vssm_gym.progress import OnProgress
from vssm_gym.version import package_version
from vssm_gym.viz.html import Table, render, svg_image

SUFFIXES = ("json", "svg", "html")


@dataclass(frozen=True)
class Study:
    """Hold the outcome of a study."""

    name: str  # of the files
    question: str  # the page's heading
    answer: str  # one paragraph, from the figures
    header: tuple[str, ...]  # of the table
    lines: Sequence[Sequence[str]]  # of the table; the first column names what is compared
    picture: bytes  # SVG
    setting: dict[str, Any]  # sequence, sizes, rates: what is needed to repeat the study
    figures: dict[str, Any]  # every number behind table and picture
    notes: tuple[str, ...] = field(default=())  # how it was measured, one paragraph each


def labelled(on_progress: OnProgress | None, label: str) -> OnProgress | None:
    """Return a callback that reports ``label`` instead of the stage, so that each of many runs has its own bar."""
    return None if on_progress is None else lambda _, done, total: on_progress(label, done, total)


@contextlib.contextmanager
def study_folder(name: str, out: Path, resume: bool = False) -> Iterator[None]:
    """Own the folder ``out`` while a study runs and is written; it may hold the outcomes of other studies.

    Args:
        name: of the study.
        out: its folder.
        resume: True for a study that continues its own outcome.

    Raises:
        InputError: it holds an outcome of this study, or anything else; another run writes to it.
    """
    for suffix in SUFFIXES if out.is_dir() and not resume else ():
        check_new_file(out / f"{name}.{suffix}")  # before the folder's manifest is written anew
    with owned_folder(out, Owner("study", "study.json", {"version": package_version()}, identity=())):
        yield


def write_study(study: Study, out: Path) -> Path:
    """Write ``NAME.json``, ``NAME.svg`` and ``NAME.html`` under ``out``, each whole or not at all; return the page.

    Args:
        study: its outcome.
        out: folder, of :func:`study_folder`.
    """
    out.mkdir(parents=True, exist_ok=True)
    machine = {"cores": os.cpu_count(), "processor": platform.machine()}
    stored = {"version": package_version(), "machine": machine, "setting": study.setting, "figures": study.figures}
    contents = (
        (json.dumps(stored, indent=1, allow_nan=False) + "\n").encode(),
        study.picture,
        page(study, stored).encode(),
    )
    for suffix, content in zip(SUFFIXES, contents, strict=True):
        with atomic_write(out / f"{study.name}.{suffix}") as temporary:
            temporary.write_bytes(content)
    return out / f"{study.name}.html"


def page(study: Study, stored: dict[str, Any]) -> str:
    """Build the HTML page of a study."""
    return render(
        "study.html.j2",
        study=study,
        picture=svg_image(study.picture),
        table=Table(study.header, study.lines, 1),
        measured={name: value for name, value in stored.items() if name != "figures"},
    )
