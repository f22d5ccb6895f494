"""Read the rows of a benchmark's folder, of this run or of the committed references, and rank their entries."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vssm_gym.envs.registration import ENVIRONMENTS
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.eval.bench.prediction.run import HORIZONS
from vssm_gym.eval.bench.slam import FRAME_RATE
from vssm_gym.eval.benchmark.manifest import MANIFEST, Entrant, Manifest, read_manifest
from vssm_gym.eval.benchmark.scores import NOT_RUN, SCORES, Line, Score, line
from vssm_gym.eval.benchmark.suite import DrivingTrack, PredictionTrack, SlamTrack, Suite, Track
from vssm_gym.eval.benchmark.units import ROWS, UnitRow
from vssm_gym.eval.episodes.log import FILE
from vssm_gym.eval.episodes.log import read_rows as read_episodes
from vssm_gym.eval.studies.row_file import read_rows
from vssm_gym.eval.sweep.config import expand
from vssm_gym.geometry.car import Car

REFERENCES = Path(__file__).parents[1] / "baselines" / "benchmark"
"""Folders of runs that are committed, each as the command has left it, without maps and recordings."""
STEPS = {"holonomic": HolonomicRobot().dt, "car": Car().dt}  # s that a robot has for a decision


@dataclass(frozen=True)
class Place:
    """Hold a line of a table with its place in it.

    Attributes:
        line: of the entry.
        entrant: the entry.
        rank: from 1, the same for scores that the table shows alike, with as many faults; None of an entry that is not
            ranked, because it is given the true pose where others estimate it, has no score yet, or failed by its own
            fault in every run.
        reference: whether it is of the committed references.
        steady: whether no more processes ran or waited than there are cores when its run began, or went on: times are
            its own.
    """

    line: Line
    entrant: Entrant
    rank: int | None
    reference: bool
    steady: bool


@dataclass(frozen=True)
class Table:
    """Hold a track's table."""

    name: str
    track: Track
    score: Score
    step: float | None  # s that a decision may take in real time
    places: tuple[Place, ...]  # ranked ones first, in order


def references_of(suite: Suite, out: Path) -> dict[Path, Manifest]:
    """Return the committed runs with rows of a track of a suite, and what they state; a run in ``out`` is none."""
    found = {path.parent: read_manifest(path.parent) for path in sorted(REFERENCES.glob(f"*/{MANIFEST}"))}
    hashes = {(name, suite.track_hash(name)) for name in suite.tracks}
    return {
        folder: manifest
        for folder, manifest in found.items()
        if hashes & set(manifest.tracks.items()) and folder.resolve() != out.resolve()
    }


def tables(suite: Suite, out: Path, references: Mapping[Path, Manifest]) -> list[Table]:
    """Return the tables of the tracks in which the folder of a run has rows, with the references' lines."""
    found = []
    for name, track in suite.tracks.items():
        own = read_manifest(out)
        lines = [(*found, False, _steady(own)) for found in _lines(name, track, out, own)]
        if not lines:
            continue
        for folder, manifest in references.items():
            if manifest.tracks.get(name) == suite.track_hash(name):
                lines += [(*found, True, _steady(manifest)) for found in _lines(name, track, folder, manifest)]
        found.append(Table(name, track, score_of(track), step_of(track), _placed(lines, track)))
    return found


def score_of(track: Track) -> Score:
    """Return the headline score of a track."""
    return SCORES[track.score if isinstance(track, DrivingTrack) else "ate" if isinstance(track, SlamTrack) else "nats"]


def step_of(track: Track) -> float | None:
    """Return the time that a decision may take, s: a robot's step, a camera's period, or until what is predicted."""
    if isinstance(track, DrivingTrack):
        return STEPS.get(ENVIRONMENTS[track.config().env[0]].robot)
    return 1.0 / FRAME_RATE if isinstance(track, SlamTrack) else min(HORIZONS)


def _lines(name: str, track: Track, folder: Path, manifest: Manifest) -> list[tuple[Line, Entrant]]:
    """Return the lines of a folder's entries in a track, if it was run there."""
    path = folder / name / (FILE if isinstance(track, DrivingTrack) else ROWS)
    if not path.is_file():
        return []
    if isinstance(track, DrivingTrack):
        rows, field, count = read_episodes(path), "agent", len(list(expand(track.config())))
    else:
        rows, field = read_rows(path, UnitRow), "entry"
        count = len(track.scenes) * track.drives if isinstance(track, PredictionTrack) else len(track.recordings)
    entrants = [entrant for entrant in manifest.entries if name in entrant.tracks]
    of = {entrant.label: [row for row in rows if row[field] == entrant.label] for entrant in entrants}
    return [(line(one.label, of[one.label], score_of(track), count), one) for one in entrants]


def _steady(manifest: Manifest) -> bool:
    """Return whether the machines of a run had a core for each process, of others and of its own, in all its parts."""
    busy = lambda part: np.inf if part.load is None else max(part.load + 1, part.workers or 0)
    return all(busy(part) <= (part.machine["cores"] or 0) for part in manifest.parts)


def unfinished(suite: Suite, out: Path, names: Iterable[str]) -> bool:
    """Return whether the run in a folder has left rows of some tracks."""
    own = read_manifest(out)
    found = [_lines(name, suite.tracks[name], out, own) for name in names]
    return any(not lines or any(NOT_RUN in one.faults for one, _ in lines) for lines in found)


def left_out(found: Sequence[Table], manifest: Manifest) -> list[str]:
    """Return notices of entries that no table holds, because no track that was run is for them."""
    names = {table.name for table in found}
    return [
        f"{one.label}: no track that was run is for it; it enters {', '.join(one.tracks)}."
        for one in manifest.entries
        if not names & set(one.tracks)
    ]


def without_references(found: Sequence[Table]) -> list[str]:
    """Return a notice of the tables that hold no committed run; none where all do."""
    names = [table.name for table in found if not any(place.reference for place in table.places)]
    without = f"No run of the package's own entries is committed for {', '.join(names)} as this suite has it."
    return [without] if names else []


def differing_content(suite: Suite, out: Path, references: Mapping[Path, Manifest]) -> list[str]:
    """Return notices of recordings and drives that were others for a reference than they are in ``out``."""
    notices = []
    for name, track in suite.tracks.items():
        own = {} if isinstance(track, DrivingTrack) else _contents(out / name / ROWS)
        for folder, manifest in references.items():
            other = _contents(folder / name / ROWS) if manifest.tracks.get(name) == suite.track_hash(name) else {}
            units = [unit for unit, content in own.items() if unit in other and not content & other[unit]]
            if units:
                what = "the same seeds have made other images or poses here"
                notices.append(f"{name}: {', '.join(units)} differ from those of the reference {folder.name}: {what}.")
    return notices


def _contents(path: Path) -> dict[str, set[str]]:
    """Return the hashes of what was given to entries, by unit."""
    found: dict[str, set[str]] = {}
    for row in read_rows(path, UnitRow) if path.is_file() else []:
        if row["content"] is not None:
            found.setdefault(row["unit"], set()).add(row["content"])
    return found


def _placed(lines: Sequence[tuple[Line, Entrant, bool, bool]], track: Track) -> tuple[Place, ...]:
    """Rank lines by their score as the table shows it, of equal ones by their faults; what does not count stands last.

    Committed rows are rounded: beyond the digits of the table, the same run would not be worth the same.
    """
    score = score_of(track)
    sign = -1.0 if score.direction == "higher" else 1.0
    apart = isinstance(track, DrivingTrack) and track.pose == "estimated"
    faults = lambda found: sum(found.faults.values())
    useless = lambda found: np.isnan(found.score.mean) or faults(found) >= found.episodes
    unranked = lambda found, entrant: useless(found) or (apart and entrant.needs_pose)
    worth = lambda found: (sign * round(found.score.mean, score.digits), faults(found))
    order = sorted(lines, key=lambda one: (unranked(*one[:2]), *worth(one[0])))
    values, places = [worth(one[0]) for one in order], []
    for found, entrant, reference, steady in order:
        rank = None if unranked(found, entrant) else 1 + values.index(worth(found))
        places.append(Place(found, entrant, rank, reference, steady))
    return tuple(places)


def as_json(table: Table) -> dict[str, Any]:
    """Return a table as plain values: entries by label, those of the references apart."""
    groups: dict[str, dict[str, Any]] = {"entries": {}, "references": {}}
    for place in table.places:
        values = asdict(place.line) | {"rank": place.rank, "needs_pose": place.entrant.needs_pose}
        values |= {"needs_map": place.entrant.needs_map, "score": _interval(asdict(place.line.score))}
        del values["entry"]
        groups["references" if place.reference else "entries"][place.line.entry] = values
    stated = {"score": table.score.label, "better": table.score.direction, "step": table.step}
    return {**stated, **{name: group for name, group in groups.items() if group}}


def _interval(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return an interval with None for a bound that there is not."""
    return {
        name: None if isinstance(value, float) and not np.isfinite(value) else value for name, value in values.items()
    }
