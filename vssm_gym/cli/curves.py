"""Run ``vssm-gym curves RUN [RUN ...] --out FILE``: learning curves of trainings, with intervals over seeds."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from vssm_gym.cli.shared.console import literal_console, say

if TYPE_CHECKING:
    from vssm_gym.training.learning_curves import Speed


def curves(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN [RUN ...]")],
    out: Path,
    minutes: float | None = None,
    seed: int = 0,
) -> None:
    """Draw success and return of trainings against minutes and steps; print the time until they succeed.

    Trainings of one name are one curve: the mean over their seeds with a 95 % interval, up to the end of
    the shortest one. The table shows medians over seeds.

    Args:
        runs: folders of `vssm-gym train`, finished or not.
        out: the picture, .svg or .png.
        minutes: end of the axis of minutes, by default that of the longest training.
        seed: seed of the bootstrap resampling behind the intervals.
    """
    from rich.table import Table

    from vssm_gym.training.learning_curves import SUCCESS_LEVELS, write_curves

    found = write_curves(runs, out, seed, minutes)
    table = Table(title="time until success, medians over seeds", title_justify="left", box=None)
    table.add_column("training", no_wrap=True)
    numbers = [column for level in SUCCESS_LEVELS for column in (f"{level:.0%}: min", "steps")]
    for name in ("seeds", *numbers, "in the end"):
        table.add_column(name, justify="right", no_wrap=True)
    for one in found:
        times = [text for i in range(len(SUCCESS_LEVELS)) for text in _times(one, i)]
        table.add_row(one.name, str(one.seeds), *times, one.last.text())
    literal_console().print(table)
    say(out)


def _times(one: "Speed", i: int) -> tuple[str, str]:
    """Return minutes and steps until success level ``i``, with the number of seeds that reached it if not all did."""
    some = f" ({one.reached[i]} of {one.seeds})" if 0 < one.reached[i] < one.seeds else ""
    if not math.isfinite(one.minutes[i]):
        return f"never{some}", "never"
    return f"{one.minutes[i]:.1f}{some}", _short(one.steps[i])


def _short(steps: float) -> str:
    """Return a number with three digits, so that the table fits into a terminal: 950, 72.9k, 5.5M."""
    for unit, name in ((1e6, "M"), (1e3, "k")):
        if steps >= unit:
            return f"{steps / unit:.{0 if steps >= 100 * unit else 1}f}{name}"
    return f"{steps:.0f}"
