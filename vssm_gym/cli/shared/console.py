"""Show text, tables of results and progress bars in the terminal.

Whatever is printed passes through :func:`say` or :func:`literal_console`: names that come from files set no style, move
no cursor and begin no line. The linter refuses ``print`` and rich's own console elsewhere in this package.
"""

import contextlib
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vssm_gym.viz.text import shortened, visible

if TYPE_CHECKING:
    from rich.console import Console  # noqa: TID251
    from rich.progress import Progress, ProgressColumn
    from rich.text import Text

STAGES = {"recording": "driving and recording", "map": "building the map", "episodes": "running episodes"}


def say(*lines: object, error: bool = False) -> None:
    """Print each of ``lines`` as one line, on stdout, or on stderr for an ``error`` or a warning."""
    for line in lines:
        print(visible(str(line)), file=sys.stderr if error else sys.stdout)


def literal_console(**options: Any) -> "Console":
    """Return rich's console for tables; ``[bold]`` and ``:smile:`` in a text are these characters."""
    from rich.console import Console  # noqa: TID251

    class LiteralConsole(Console):
        def render_str(self, text: str, **style: Any) -> "Text":
            return super().render_str("\n".join(map(visible, text.split("\n"))), **style)

    stream = sys.stderr if options.get("stderr") else sys.stdout
    width = None if stream.isatty() else 120  # a log has no width of its own
    return LiteralConsole(**{"markup": False, "emoji": False, "highlight": False, "width": width, **options})


@contextlib.contextmanager
def progress_bars() -> Iterator[Callable[[str, int, int], None]]:
    """Yield an ``on_progress(stage, done, total)`` callback that draws a bar for each stage on stderr.

    A stage that begins again gets a new bar.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeElapsedColumn
    from rich.progress import TimeRemainingColumn as Remaining

    columns = (
        TextColumn("{task.description:>24}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        Remaining(),
    )
    bars: dict[str, TaskID] = {}
    with progress_of(*columns) as progress:

        def show(stage: str, done: int, total: int) -> None:
            if stage not in bars:
                progress.start()
                bars[stage] = progress.add_task(visible(STAGES.get(stage, stage)), total=total)
            progress.update(bars[stage], completed=done, total=total)
            if done >= total:
                del bars[stage]

        yield show


@contextlib.contextmanager
def progress_of(*columns: "ProgressColumn") -> "Iterator[Progress]":
    """Yield a display of progress on stderr that its user starts with the first bar.

    A display that was never started prints nothing: rich would end it with an empty line, which would stand before the
    message of an early error.
    """
    from rich.progress import Progress

    progress = Progress(*columns, console=literal_console(stderr=True, highlight=True))
    try:
        yield progress
    finally:
        if progress.live.is_started:
            progress.stop()


def print_results(log: Path) -> None:
    """Print the metrics of every agent of an episode log, one table for each condition, on stdout."""
    from rich.table import Table

    from vssm_gym.eval.episodes.log import read_rows
    from vssm_gym.eval.metrics import aggregate
    from vssm_gym.eval.metrics.registry import measured
    from vssm_gym.eval.protocols.registry import view_of

    console = literal_console()
    all_rows = [measured(row) for row in read_rows(log)]
    for (env, *condition), rows in aggregate.group_rows(all_rows, ("env", "scene", "noise", "physics")).items():
        columns = view_of(env).summary
        title = " · ".join(map(shortened, condition))
        table = Table(title=f"{title}; in brackets 95 % intervals", title_justify="left", box=None)
        table.add_column("agent", no_wrap=True)
        for name in ("runs", *columns, "failed"):
            table.add_column(name, justify="right", no_wrap=True)
        for (agent,), members in aggregate.group_rows(rows, ("agent",)).items():
            failed = sum(row["failure"] is not None for row in members)
            values = [value(members) for value in columns.values()]
            table.add_row(agent, str(len(members)), *values, str(failed))
        console.print(table)


def print_notices(scenes: Sequence[str], env: str = "vssm_gym/PointNav-v0") -> None:
    """Print warnings about scenes on stderr, one line each, before anything runs in them."""
    from vssm_gym.eval.episodes.identity import scene_name
    from vssm_gym.eval.protocols.registry import protocol_of

    protocol = protocol_of(env)
    for scene in scenes:
        if notice := protocol.notice(protocol.load(scene)):
            say(f"warning: {scene_name(scene)}: {notice}", error=True)
