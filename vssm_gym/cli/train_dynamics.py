"""Run ``vssm-gym train-dynamics DATA --out FILE``: learn how a body moves from logs of its poses and controls."""

import json
from pathlib import Path
from typing import Annotated, Any

import tyro

from vssm_gym.cli.shared.console import say
from vssm_gym.cli.shared.interruption import Interrupted


def train_dynamics(
    data: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="DATA")],
    out: Path,
    test: tuple[Path, ...] = (),
    step: float = 0.1,
    horizon: int = 100,
    updates: int = 1500,
    minutes: float = 9.0,
    seed: int = 0,
) -> None:
    """Learn a transition, and compare it with integration and with fitted constants.

    DATA are Blackbird flights (HDF5; needs the extra `dynamics`), folders with EuRoC's csv files, or recordings of
    `vssm-gym record`, all of one kind. The last quarter of each is held out: the best network is chosen and its noise
    calibrated there. OUT gets the transition, and beside it a JSON file of the same name with the comparison.
    Ctrl-C keeps the best so far.

    Args:
        data: logs to learn from.
        out: the file to write (.npz), a new one.
        test: logs that are only predicted, by every model.
        step: length of a step, seconds; that of a robot is the one of its commands.
        horizon: steps of the longest prediction that is trained and judged.
        updates: gradient steps.
        minutes: after which the training ends even so.
        seed: seed of the weights and of all draws.
    """
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.errors import InputError
    from vssm_gym.files.atomic import atomic_write
    from vssm_gym.files.output_folders import check_at_least, check_new_file
    from vssm_gym.model.transition.learned_file import save_transition
    from vssm_gym.training.dynamics.fit import FitConfig
    from vssm_gym.training.dynamics.learn import LearnConfig, learn, seconds_a_step

    check_at_least("train-dynamics", "updates", updates, 1)
    check_at_least("train-dynamics", "seed", seed, 0)
    if not minutes > 0.0:
        raise InputError("train-dynamics", "minutes", f"above 0; found {minutes:g}")
    beside = out.with_suffix(".json")
    check_new_file(out, (".npz",))
    check_new_file(beside, (".json",))
    config = LearnConfig(step, horizon, FitConfig(updates=updates, minutes=minutes, seed=seed))
    with progress_bars() as progress:
        found = learn(data, test, config, progress)
    report = found.report | {"milliseconds_a_step": round(1e3 * seconds_a_step(found.fitted.transition), 3)}
    about = {name: value for name, value in report.items() if name not in ("history", "parts")}
    save_transition(out, found.fitted.transition, found.kind, about)
    with atomic_write(beside) as temporary:
        temporary.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    _print(report)
    say(f"{out}: trained for {report['seconds']:.0f} s; the comparison is in {beside}")
    if found.fitted.interrupted:
        raise Interrupted(f"{out} keeps the best of {report['updates']} updates")


def _print(report: dict[str, Any]) -> None:
    """Print a table for each part of the data."""
    from rich.table import Table

    from vssm_gym.cli.shared.console import literal_console

    console = literal_console()
    for part, rows in report["parts"].items():
        title = f"{part}: RMSE after steps of {report['step']:g} s, from the measured state"
        table = Table(title=title, title_justify="left", box=None)
        horizons = list(next(iter(rows.values()))["position"])
        columns = ("model", *(f"{k}, m" for k in horizons), f"{horizons[-1]}, rad", "log p, 1 step", "95 % hold")
        for column in columns:
            table.add_column(column, justify="left" if column == "model" else "right", no_wrap=True)
        for name, row in rows.items():
            held = row.get("coverage", {}).get("position", {}).get("all steps")
            values = [f"{row['position'][k]:.3f}" for k in horizons] + [f"{row['rotation'][horizons[-1]]:.3f}"]
            values += [f"{row['log_likelihood']:.2f}", "" if held is None else f"{100.0 * held:.0f} %"]
            table.add_row(name, *values)
        console.print(table)
