"""Read what the folder of a benchmark states: suite, entries and their code, and the versions that have run it.

:mod:`vssm_gym.eval.benchmark.run` writes it before the first row; a run goes on with the same entries only.
"""

from pathlib import Path
from typing import Any, Literal

from vssm_gym.envs.validation import StrictModel, validated
from vssm_gym.errors import InputError
from vssm_gym.files.json_file import read_json
from vssm_gym.files.output_folders import ADVICE

MANIFEST = "benchmark.json"


class Entrant(StrictModel):
    """Hold what a manifest states of an entry: what it is, what it is given, a hash of its own code, and its tracks."""

    label: str
    kind: Literal["agent", "slam", "predictor"]
    needs_pose: bool = False
    needs_map: bool = False
    code: str | None = None
    tracks: tuple[str, ...]


class Part(StrictModel):
    """Hold by which version and where a part of a run was made."""

    version: str
    machine: dict[str, Any]
    load: float | None = None  # processes that ran or waited when it began: times on a busy machine are longer
    workers: int | None = None  # processes of its own; None in files of versions that did not state it


class Manifest(StrictModel):
    """Hold what a benchmark's folder states: suite, hashes of its tracks, entries, and what has run it."""

    suite: str
    suite_hash: str
    tracks: dict[str, str]
    entries: tuple[Entrant, ...]
    version: str
    machine: dict[str, Any]
    load: float | None = None
    workers: int | None = None
    resumed: tuple[Part, ...] = ()  # that have run what the one before has left

    @property
    def parts(self) -> tuple[Part, ...]:
        """Return all parts, the first one first."""
        first = Part(version=self.version, machine=self.machine, load=self.load, workers=self.workers)
        return first, *self.resumed


def read_manifest(folder: Path) -> Manifest:
    """Return what a benchmark's folder states; raise :class:`InputError` for another folder."""
    path = folder / MANIFEST
    return validated(Manifest, read_json(path, expected="the JSON that a benchmark wrote"), path)


def check_entries(out: Path, now: Manifest) -> None:
    """Raise :class:`InputError` where a folder's run of the same suite has other entries, or other code of them."""
    if not (out / MANIFEST).is_file():
        return
    there = read_manifest(out)
    if there.suite_hash != now.suite_hash or there.entries == now.entries:
        return
    labels, wanted = ([one.label for one in of.entries] for of in (there, now))
    if labels != wanted:
        expected = f"{', '.join(labels)}, as the run in this folder has; found {', '.join(wanted)}"
        raise InputError(out / MANIFEST, "entries", f"{expected} ({ADVICE})")
    for before, entrant in zip(there.entries, now.entries, strict=True):
        if before != entrant:
            expected = "the code that the run in this folder began with: Python files of its package, or beside it,"
            raise InputError(out / MANIFEST, f"entries.{entrant.label}", f"{expected} have changed ({ADVICE})")
