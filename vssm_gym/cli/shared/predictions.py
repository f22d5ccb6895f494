"""Check what `bench` is asked to predict, and print the tables of `bench prediction`."""

from pathlib import Path
from typing import Any

from vssm_gym.cli.shared.console import say
from vssm_gym.errors import InputError


def check_log(suite: str, log: Path | None, options: dict[str, Any]) -> None:
    """Raise :class:`InputError` where a suite has a log or an option that it does not take, or lacks one that it needs.

    Args:
        suite: the suite.
        log: the positional argument.
        options: by name, those that `prediction LOG` alone takes; None where it was not given.
    """
    given = [f"--{name}" for name, value in options.items() if value is not None]
    if (suite == "slam" and log is None) or (suite not in ("slam", "prediction") and log is not None):
        raise InputError(
            "bench", "LOG", "a TUM folder after `bench slam`, a log after `bench prediction`, else nothing"
        )
    if given and (suite != "prediction" or log is None):
        raise InputError("bench", "LOG", f"`bench prediction LOG` with {', '.join(given)}; found no such log")
    if suite == "prediction" and log is not None and options["transition"] is None:
        raise InputError("bench", "transition", f"--transition FILE.npz of `train-dynamics`, to predict {log}")


def show_prediction(table: Any, result: dict[str, Any], console: Any) -> None:
    """Fill the table with one row for each model and horizon; print the best models and what was fitted below."""
    from vssm_gym.eval.bench.prediction import page
    from vssm_gym.eval.bench.prediction.ahead import page as page_ahead

    arranged: Any = page_ahead if "log" in result else page
    lines, shown = [arranged.line_of(row) for row in result["rows"]], arranged.shown(result)
    for index in shown:
        name = arranged.HEADER[index]
        table.add_column(name, no_wrap=name in arranged.WHOLE, justify="right" if index else "left")
    for line in lines:
        table.add_row(*(line[index] for index in shown))
    console.print(table)
    console.print(arranged.answer(result), soft_wrap=True)
    for notice in result.get("notices", ()):
        say(f"note: {notice}", error=True)
    for name, values in (result["fitted"] or {}).items():
        numbers = values.items() if isinstance(values, dict) else enumerate(values)
        written = ", ".join(f"{of} {value:.4g}" for of, value in numbers)
        console.print(f"fitted, {name}: {written}", soft_wrap=True)
    console.print(f"machine: {result['machine']}")
