"""Show text and tables of results in the terminal.

Whatever is printed passes through :func:`say` or :func:`literal_console`: names that come from files set no style, move
no cursor and begin no line. The linter refuses ``print`` and rich's own console elsewhere in this package.
"""

import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vssm_gym.viz.text import shortened, visible

if TYPE_CHECKING:
    from rich.console import Console  # noqa: TID251
    from rich.text import Text


def say(*lines: object, error: bool = False) -> None:
    """Print each of ``lines`` as one line, on stdout, or on stderr for an ``error`` or a warning."""
    for line in lines:
        # One write a line: another thread may print the progress at the same time
        print(visible(str(line)) + "\n", end="", file=sys.stderr if error else sys.stdout)


def literal_console(**options: Any) -> "Console":
    """Return rich's console for tables; ``[bold]`` and ``:smile:`` in a text are these characters."""
    from rich.console import Console  # noqa: TID251

    class LiteralConsole(Console):
        def render_str(self, text: str, **style: Any) -> "Text":
            return super().render_str("\n".join(map(visible, text.split("\n"))), **style)

    stream = sys.stderr if options.get("stderr") else sys.stdout
    width = None if stream.isatty() else 120  # a log has no width of its own
    return LiteralConsole(**{"markup": False, "emoji": False, "highlight": False, "width": width, **options})


def print_results(log: Path) -> None:
    """Print the metrics of every agent of an episode log, one table for each condition, on stdout."""
    from rich.table import Table

    from vssm_gym.eval.episodes.log import read_rows
    from vssm_gym.eval.metrics import aggregate
    from vssm_gym.eval.metrics.registry import measured
    from vssm_gym.eval.metrics.training_runs import by_method
    from vssm_gym.eval.protocols.registry import view_of

    console = literal_console()
    all_rows = by_method(measured(row) for row in read_rows(log))
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
    from vssm_gym.envs.scenes.faults import SceneWarning
    from vssm_gym.envs.scenes.specs import scene_name
    from vssm_gym.eval.protocols.registry import protocol_of

    protocol = protocol_of(env)
    for scene in scenes:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SceneWarning)  # the notice has the same text
            notice = protocol.notice(protocol.load(scene))
        if notice:
            say(f"warning: {scene_name(scene)}: {notice}", error=True)
