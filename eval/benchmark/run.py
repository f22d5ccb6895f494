"""Run a suite for some entries, and write the tables: ``vssm-gym benchmark SUITE --entry ENTRY --out DIR``.

The folder holds ``benchmark.json`` (suite, entries, versions, machines), a folder a track, and ``results.json`` and
``results.md``. The folder of a driving track is that of a sweep, which ``vssm-gym report`` shows.
"""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path

from vssm_gym.agents.registry import agent_type
from vssm_gym.errors import InputError, one_of
from vssm_gym.eval.benchmark import page
from vssm_gym.eval.benchmark.entries import Entry, find_entries
from vssm_gym.eval.benchmark.machine import described, load, machine
from vssm_gym.eval.benchmark.manifest import MANIFEST, Entrant, Manifest, Part, check_entries, read_manifest
from vssm_gym.eval.benchmark.prediction.levels import UNINFORMED
from vssm_gym.eval.benchmark.prediction.run import PredictionUnit, run_drive
from vssm_gym.eval.benchmark.results import (
    as_json,
    differing_content,
    left_out,
    references_of,
    tables,
    unfinished,
    without_references,
)
from vssm_gym.eval.benchmark.slam.run import SlamUnit, ensure_recording, run_recording, standing_still
from vssm_gym.eval.benchmark.suite import DrivingTrack, PredictionTrack, SlamTrack, Suite, check_frozen, read_suite
from vssm_gym.eval.benchmark.times import Took, read_times, timed
from vssm_gym.eval.benchmark.units import run_units
from vssm_gym.eval.studies.calibration.rows import MAP_VOXEL
from vssm_gym.eval.sweep.config import check_names
from vssm_gym.eval.sweep.runner import leave_unguarded_import, run_sweep
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.output_folders import Owner, check_at_least, check_folder, owned_folder
from vssm_gym.files.shipped import MAPS, shipped
from vssm_gym.progress import OnProgress
from vssm_gym.slam.map_building import ensure_map
from vssm_gym.version import package_version

RESULTS, PAGE = "results.json", "results.md"


def run_benchmark(
    suite_path: Path,
    references: Sequence[str],
    out: Path,
    *,
    tracks: Sequence[str] = (),
    resume: bool = False,
    workers: int = 2,
    on_progress: OnProgress | None = None,
) -> Path:
    """Run what is not yet in ``out``; return the page of the results.

    Args:
        suite_path: the suite's file.
        references: of the entries, see :mod:`vssm_gym.eval.benchmark.entries`.
        out: new or empty folder, or with ``resume`` that of the same suite and entries.
        tracks: names of the tracks to run; empty: all that an entry is for.
        resume: continue.
        workers: number of processes that run episodes, recordings and drives.
        on_progress: as of sweeps, and with ("runs", done, total).

    Raises:
        InputError: a suite that has changed, an entry that cannot enter, or a folder of another run.
        OutputError: a full disk or the like; what has ended is kept.
    """
    leave_unguarded_import()
    check_at_least("benchmark", "workers", workers, 1)
    check_folder(out)
    suite = read_suite(suite_path)
    if unknown := [name for name in tracks if name not in suite.tracks]:
        raise InputError("benchmark", "tracks", one_of(suite.tracks, unknown[0]))
    entries = find_entries(tuple(references), suite)
    wanted = [name for name in suite.tracks if not tracks or name in tracks]
    chosen = {name: [entry for entry in entries if name in entry.tracks(suite)] for name in wanted}
    chosen = {name: entering for name, entering in chosen.items() if entering}
    if not chosen:
        raise InputError("benchmark", "tracks", f"a track that an entry is for; found {', '.join(tracks)}")
    check_frozen(suite, suite_path, chosen)
    manifest = Manifest(
        suite=suite.name,
        suite_hash=suite.hash,
        tracks={name: suite.track_hash(name) for name in suite.tracks},
        entries=tuple(_entrant(entry, suite) for entry in entries),
        version=package_version(),
        machine=machine(),
        load=load(),
        workers=workers,
    )
    content = manifest.model_dump(mode="json")
    owner = Owner("benchmark", MANIFEST, content, identity=("suite_hash", "entries"), resumed=tuple(suite.tracks))
    check_entries(out, manifest)
    with owned_folder(out, owner, resume):
        _keep_part(suite, out, manifest.parts[0], chosen)
        for name, entering in chosen.items():
            with timed(out, name):
                _run_track(suite, suite_path.parent, name, entering, out / name, workers, on_progress)
        return _write(suite, out)


def _entrant(entry: Entry, suite: Suite) -> Entrant:
    """Return what the manifest states of an entry."""
    kind = agent_type(entry.label_of_sweep) if entry.kind == "agent" else None
    return Entrant(
        label=entry.label,
        kind=entry.kind,
        needs_pose=kind is not None and kind.needs_pose,
        needs_map=kind is not None and kind.needs_map,
        code=entry.code,
        tracks=entry.tracks(suite),
    )


def _keep_part(suite: Suite, out: Path, part: Part, names: Iterable[str]) -> None:
    """State in the manifest what continues the tracks, before their next row, if any is left."""
    own = read_manifest(out)
    if part not in own.parts and unfinished(suite, out, names):
        own = own.model_copy(update={"resumed": (*own.resumed, part)})
        with atomic_write(out / MANIFEST) as temporary:
            temporary.write_text(own.model_dump_json(indent=1) + "\n", encoding="utf-8")


def _run_track(
    suite: Suite,
    beside: Path,
    name: str,
    entries: Sequence[Entry],
    folder: Path,
    workers: int,
    on_progress: OnProgress | None,
) -> None:
    """Run a track for the entries that it is for."""
    track = suite.tracks[name]
    if isinstance(track, SlamTrack):
        recordings = {one: ensure_recording(one, folder / "recordings", on_progress) for one in track.located(beside)}
        runs = [
            SlamUnit(entry.label, entry.reference, one, path, track.seconds)
            for entry in entries
            for one, path in recordings.items()
        ]
        run_units(runs, run_recording, standing_still, folder, workers, on_progress)
    elif isinstance(track, PredictionTrack):
        drives = [
            PredictionUnit(entry.label, entry.reference, scene, k, track.drives, track.seed, map_file, track.seconds)
            for scene in track.located(beside)
            for map_file in [_map_of(track, scene, folder, on_progress)]
            for entry in entries
            for k in range(track.drives)
        ]
        run_units(drives, run_drive, lambda _: UNINFORMED, folder, workers, on_progress)
    else:
        _drive(track, beside, entries, folder, workers, on_progress)


def _drive(
    track: DrivingTrack,
    beside: Path,
    entries: Sequence[Entry],
    folder: Path,
    workers: int,
    on_progress: OnProgress | None,
) -> None:
    """Run the sweep of a track."""
    config = track.config(tuple(entry.label_of_sweep for entry in entries), beside)
    check_names(config, "benchmark", {"agents": "entry"})
    run_sweep(
        config,
        folder,
        resume=True,
        workers=workers,
        map_file=None if track.map is None else shipped(track.map, MAPS),
        agent_seconds=track.seconds,
        on_progress=on_progress,
    )


def _map_of(track: PredictionTrack, scene: str, folder: Path, on_progress: OnProgress | None) -> Path:
    """Return the map that models are given: the shipped one, or one that is learned."""
    if track.map is not None:
        return shipped(track.map, MAPS)
    return ensure_map(scene, folder, voxel=MAP_VOXEL, seed=track.seed, on_progress=on_progress)


def _write(suite: Suite, out: Path) -> Path:
    """Write the results of all tracks that the folder holds; return the page."""
    own, beside = read_manifest(out), references_of(suite, out)
    _, *machines = dict.fromkeys(described(part.machine) for part in own.parts)
    _, *versions = dict.fromkeys(part.version for part in own.parts)
    notices = [f"A part was run on another machine: {one}." for one in machines]
    notices += [f"A part was run by another version: {one}." for one in versions]
    found = tables(suite, out, beside)
    stated = {name: value for name, value in own.model_dump(mode="json").items() if name not in ("entries", "tracks")}
    notices += [*left_out(found, own), *without_references(found), *differing_content(suite, out, beside)]
    took = read_times(out)
    of_tracks = {table.name: as_json(table) | took.get(table.name, Took()).model_dump() for table in found}
    content = {**stated, "tracks": of_tracks, "notices": notices}
    with atomic_write(out / RESULTS) as temporary:
        temporary.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    with atomic_write(out / PAGE) as temporary:
        temporary.write_text(page.markdown(found, own, beside.values(), notices, took), encoding="utf-8")
    return out / PAGE
