"""Write the results of a benchmark as Markdown: a table a track, then versions and machines."""

from collections.abc import Iterable, Mapping, Sequence

from vssm_gym.eval.benchmark.machine import described
from vssm_gym.eval.benchmark.manifest import Manifest, Part
from vssm_gym.eval.benchmark.results import Place, Table
from vssm_gym.eval.benchmark.suite import DrivingTrack
from vssm_gym.eval.benchmark.times import Took
from vssm_gym.viz.text import shortened, visible

_ESCAPED = str.maketrans({character: f"\\{character}" for character in "\\`*[]<>|#"})


def markdown(
    tables: Sequence[Table],
    own: Manifest,
    references: Iterable[Manifest],
    notices: Iterable[str],
    times: Mapping[str, Took],
) -> str:
    """Return the page of a run; ``times`` holds what each track took, s."""
    parts = [f"# Benchmark {_text(own.suite)}\n", f"Entries: {', '.join(_text(one.label) for one in own.entries)}.\n"]
    parts += [_section(table) for table in tables]
    parts.append("## How it was made\n")
    runs = [("this run", own), *(("references", one) for one in references)]
    made = lambda part: (part.version, described(part.machine), _load(part))
    lines = list(dict.fromkeys((rows, of.suite_hash, *made(part)) for rows, of in runs for part in of.parts))
    parts.append(
        _table(["rows", "hash of the suite", "version", "machine", "load"], [list(map(_text, one)) for one in lines])
    )
    took = [
        f"- {name}: {of.wall_seconds:.0f} s, {of.processor_seconds:.0f} s of the processor, for all entries."
        for name, of in times.items()
    ]
    parts += [*took, *(f"- {_text(notice)}" for notice in notices)]
    return "\n".join(parts).rstrip() + "\n"


def _load(part: Part) -> str:
    return "-" if part.load is None else f"{part.load:.1f}"


def _section(table: Table) -> str:
    """Return the heading and the table of a track."""
    observed = isinstance(table.track, DrivingTrack)
    step = "" if table.step is None else f" of {1e3 * table.step:.0f}"
    contacts = any(place.line.collisions is not None for place in table.places)
    head = ["rank", "entry", f"{table.score.label} [95 %]", "success"]
    head += ["collisions"] * contacts + [f"p95, ms{step}", "runs"] + ["given"] * observed + ["faults"]
    lines = [_cells(place, table, contacts, observed) for place in table.places]
    direction = f"{table.score.label}: {table.score.direction} is better."
    faults = [
        f"- {_text(place.line.entry)}: {count} of {place.line.episodes} runs: {_text(reason)}"
        for place in table.places
        for reason, count in place.line.faults.items()
    ]
    said = [f"{_text(table.track.about)} {direction}\n", _table(head, lines), *faults]
    return f"## {table.name}\n\n" + "\n".join(said) + ("\n" if faults else "")


def _cells(place: Place, table: Table, contacts: bool, observed: bool) -> list[str]:
    """Return the cells of an entry."""
    line, digits = place.line, table.score.digits
    given = [what for what, needs in (("pose", place.entrant.needs_pose), ("map", place.entrant.needs_map)) if needs]
    name = f"{_text(line.entry)} (reference)" if place.reference else f"**{_text(line.entry)}**"
    slow = table.step is not None and line.p95 is not None and line.p95 > table.step
    late = "" if not slow else " (late)" if place.steady else " (busy machine)"
    return [
        "-" if place.rank is None else str(place.rank),
        name,
        line.score.text(digits),
        f"{100.0 * line.success:.0f} %",
        *(["-" if line.collisions is None else f"{line.collisions:.2f}"] if contacts else []),
        "-" if line.p95 is None else f"{1e3 * line.p95:.1f}{late}",
        str(line.episodes),
        *([" and ".join(given) or "neither pose nor map"] if observed else []),
        str(sum(line.faults.values())),
    ]


def _table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    rows = [head, ["---"] * len(head), *lines]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in rows) + "\n"


def _text(text: str) -> str:
    """Return a name of any origin as plain text of one line of Markdown."""
    return shortened(visible(text)).translate(_ESCAPED)
