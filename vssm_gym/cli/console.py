"""What long commands show: a progress bar a stage, and a table of results."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

STAGES = {"recording": "driving and recording", "map": "building the map", "episodes": "running episodes"}


@contextlib.contextmanager
def progress_bars() -> Iterator[Callable[[str, int, int], None]]:
    """A callback ``(stage, done, total)`` that draws one bar a stage on stderr; one that starts anew gets a new bar."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
    from rich.progress import TimeRemainingColumn as Remaining

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description:>24}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        Remaining(),
    )
    bars: dict[str, TaskID] = {}
    with Progress(*columns, console=console) as progress:

        def show(stage: str, done: int, total: int) -> None:
            if stage not in bars:
                bars[stage] = progress.add_task(STAGES.get(stage, stage), total=total)
            progress.update(bars[stage], completed=done, total=total)
            if done >= total:
                del bars[stage]

        yield show


def print_results(log: Path) -> None:
    """SPL, success, location error and failures of every agent of an episode log, with 95 % intervals, on stdout."""
    from rich.console import Console
    from rich.table import Table

    from vssm_gym.eval import aggregate
    from vssm_gym.eval.rows import read_rows

    rows = read_rows(log)
    table = Table(title="means over tasks [95 % interval]")
    for name in ("scene", "noise", "agent"):
        table.add_column(name)
    for name in ("episodes", "SPL", "success", "location error m", "failed"):
        table.add_column(name, justify="right")
    groups = aggregate.group_rows(rows, ("scene", "noise", "agent"))
    for line in sorted(aggregate.table(rows, ("spl", "success", "location_error_mean")), key=lambda line: line.group):
        failed = sum(row["failure"] is not None for row in groups[line.group])
        spl, success, error = (line.values[m] for m in ("spl", "success", "location_error_mean"))
        table.add_row(*line.group, str(line.episodes), spl.text(), success.text(), error.text(3), str(failed))
    Console().print(table)
