"""Run ``vssm-gym train CONFIG --out DIR``: train a policy in a learned map, or in the simulator.

``vssm-gym train-dynamics DATA --out FILE`` learns how a body moves from logs of its poses and controls.
"""

import json
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from vssm_gym.cli.shared.console import say
from vssm_gym.cli.shared.interruption import Interrupted, interruptible

if TYPE_CHECKING:
    from vssm_gym.training.config import TrainingConfig
    from vssm_gym.training.run import Row


@interruptible("checkpoint.pt", "checkpoint.npz", "demonstrations.npz", "policy.npz", "seed-*/policy.npz")
def train(
    config: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CONFIG")],
    out: Path,
    resume: bool = False,
    map: Path | None = None,
    seed: int | None = None,
    seeds: Annotated[str | None, tyro.conf.arg(metavar="N,N,...")] = None,
    ray: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None,
) -> None:
    """Train a policy; OUT gets policy.npz, a checkpoint and progress.jsonl.

    Interrupt at any time: progress is kept, and --resume continues. Return and success are shown when enough episodes
    have ended. To evaluate the policy, run `vssm-gym evaluate`, or name it in a sweep as "policy:OUT/policy.npz".

    Args:
        config: YAML with name, environment, policy, algorithm, steps [minutes, seed]; eval/configs/ppo_oak.yaml is one.
        out: new or empty folder for the results.
        resume: continue the training of the same configuration in OUT.
        map: the map file to train in, in place of the configuration's.
        seed: seed of network, exploration and environments, in place of the configuration's.
        seeds: train once with each of these seeds, in OUT/seed-N: one after the other, or at once with --ray.
        ray: train the seeds on the Ray cluster of this address, auto or HOST:PORT, each on one CPU; all of its machines
            share the folders of OUT and of the map.
    """
    from vssm_gym.cli.shared.arguments import parse_numbers
    from vssm_gym.errors import InputError
    from vssm_gym.files.output_folders import check_at_least
    from vssm_gym.files.yaml_file import distinct
    from vssm_gym.training.cluster_seeds import check_unbegun, seed_folder
    from vssm_gym.training.config import load_training

    if seeds is None:
        if ray is not None:
            raise InputError("train", "ray", "--seeds as well: each seed is trained on one CPU of the cluster")
        if seed is not None:
            check_at_least("train", "seed", seed, 0)
        _train_one(load_training(config, map_file=map, seed=seed), out, resume)
        return
    if seed is not None:
        raise InputError("train", "seed", "either --seed or --seeds")
    form = "whole numbers with commas between them, as in 0,1,2"
    chosen = parse_numbers("train", "seeds", seeds, int, form)
    try:
        distinct(chosen)
    except ValueError as error:
        raise InputError("train", "seeds", str(error)) from None
    for one in chosen:
        check_at_least("train", "seeds", one, 0)
    checked = load_training(config, map_file=map)
    if ray is not None:
        _train_on_cluster(checked, chosen, out, resume, ray)
        return
    if not resume:
        check_unbegun(out, chosen)
    for one in chosen:
        _train_one(checked.model_copy(update={"seed": one}), seed_folder(out, one), resume)


def _train_one(config: "TrainingConfig", out: Path, resume: bool) -> None:
    """Train one policy and show its progress."""
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    from vssm_gym.cli.shared.progress import progress_of
    from vssm_gym.training.train import PROGRESS, run_training

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[note]}", markup=False))
    last: Row = {}
    with progress_of(*columns, TimeElapsedColumn(), TimeRemainingColumn()) as show:
        show("training", 0.0, 1.0, "building and compiling")

        def on_update(row: "Row", done: float) -> None:
            last.update(row)
            show("training", done, 1.0, _summary(row, config))

        policy = run_training(config, out, resume=resume, on_update=on_update)
    say(_times(last) if last else "this training has ended already: no file has changed")
    say(f"log: {out / PROGRESS}", f"policy: {policy}", f"next: {_evaluation(policy, config)}")


def _train_on_cluster(config: "TrainingConfig", seeds: tuple[int, ...], out: Path, resume: bool, ray: str) -> None:
    """Train a policy for each seed on a cluster and show how far they are together."""
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    from vssm_gym.cli.shared.progress import progress_of
    from vssm_gym.training.cluster_seeds import train_on_cluster

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[note]}", markup=False))
    with progress_of(*columns, TimeElapsedColumn(), TimeRemainingColumn()) as show:

        def on_update(done: float, steps: int, ended: int) -> None:
            show("training", done, 1.0, f"{steps:,} steps, {ended} of {len(seeds)} seeds ended")

        policies = train_on_cluster(config, seeds, out, ray, resume=resume, on_update=on_update)
    say(
        *(f"policy: {policy}" for policy in policies),
        f"next: vssm-gym curves {shlex.quote(str(out))}/seed-* --out FILE",
    )


def _summary(row: "Row", config: "TrainingConfig") -> str:
    """Return steps, mean return and success; before enough episodes, how many the means need."""
    from vssm_gym.training.run import ENOUGH_EPISODES, first_round

    text = f"{row['steps']:,} steps"
    if row["enough"]:
        return f"{text}, return {row['return']:.2f}, success {row['success']:.0%}"
    if config.algorithm.name == "bc":
        return text  # it counts no episodes
    ended = f"{row['episodes']} episode{'s' * (row['episodes'] != 1)} ended"
    return f"{text}, {ended}; success needs {ENOUGH_EPISODES} and {first_round(config):,} steps of this run"


def _evaluation(policy: Path, config: "TrainingConfig") -> str:
    """Return the command that evaluates a policy where it was trained; a map file does not name its scene."""
    from vssm_gym.files.shipped import ASSETS, MAPS

    scene, file = config.environment.scene or "SCENE", config.environment.map
    if file is not None and Path(file).parent == (ASSETS / MAPS).resolve():
        scene = file = Path(file).stem  # a map of the package is named after its scene
    words = ["vssm-gym", "evaluate", str(policy), "--scene", scene, *(["--map", file] if file else [])]
    return f"{shlex.join(words)} --out DIR"


def _times(row: "Row") -> str:
    """Return how long a training took, the building of the environment and compilation apart from the rest."""
    stepping = row["seconds"] - row["preparing"]
    rate = f"{row['steps'] / stepping:,.0f} steps/s" if stepping > 0.0 else "no step"
    return (
        f"trained {row['seconds']:.1f} s: {row['preparing']:.1f} s building and compiling, "
        f"{stepping:.1f} s stepping and learning ({rate})"
    )


@interruptible()
def train_dynamics(
    data: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="DATA")],
    out: Path,
    test: tuple[Path, ...] = (),
    step: float = 0.1,
    horizon: int = 100,
    updates: int = 1200,
    minutes: float = 9.0,
    seed: int = 0,
) -> None:
    """Learn a transition, and compare it with integration and with fitted constants.

    DATA are Blackbird flights (HDF5; needs the extra `dynamics`), folders with EuRoC's csv files, or recordings of
    `vssm-gym record`, all of one kind. Four networks learn, each without another quarter of each log, on which it is
    judged and its noise calibrated; the transition is all four. OUT gets it, and beside it a JSON file of the same name
    has the comparison. Ctrl-C keeps the best so far.

    Args:
        data: logs to learn from.
        out: the file to write (.npz), a new one.
        test: logs that are only predicted, by every model.
        step: length of a step, seconds; that of a robot is the one of its commands.
        horizon: steps of the longest prediction that is trained and judged.
        updates: gradient steps.
        minutes: after which the training ends even so; compilation, a minute or more, is part of them.
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
    _print_comparison(report)
    if not found.fitted.improved:
        say(
            "warning: no update was better than `bias` on the held-out windows: train longer, or on more data",
            error=True,
        )
    done = f"{report['updates']:,} of {updates:,} updates in {report['seconds']:.0f} s, compilation included"
    say(f"{out}: {done}; the comparison is in {beside}")
    if found.fitted.interrupted:
        raise Interrupted(f"{out} keeps the best of {report['updates']} updates")


def _print_comparison(report: dict[str, Any]) -> None:
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
