"""Run ``vssm-gym train CONFIG --out DIR``: train a policy in a learned map, or in the simulator."""

from pathlib import Path
from typing import Annotated

import tyro

from vssm_gym.cli.shared.console import say


def train(
    config: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CONFIG")],
    out: Path,
    resume: bool = False,
    map: Path | None = None,
    seed: int | None = None,
) -> None:
    """Train a policy; OUT gets policy.npz, checkpoint.pt, progress.jsonl and logs for TensorBoard.

    Interrupt at any time: progress is kept, and --resume continues. To evaluate the policy, run
    `vssm-gym evaluate`, or name it in a sweep as "policy:OUT/policy.npz".

    Args:
        config: YAML with name, environment, policy, algorithm, steps [minutes, seed]; eval/configs/ppo_oak.yaml is one.
        out: new or empty folder for the results.
        resume: continue the training of the same configuration in OUT.
        map: the map file to train in, in place of the configuration's.
        seed: seed of network, exploration and environments, in place of the configuration's.
    """
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    from vssm_gym.cli.shared.console import progress_of
    from vssm_gym.files.output_folders import check_at_least
    from vssm_gym.training.config import load_training
    from vssm_gym.training.train import PROGRESS, run_training

    if seed is not None:
        check_at_least("train", "seed", seed, 0)
    checked = load_training(config, map_file=map, seed=seed)
    columns = (TextColumn("training"), BarColumn(), TextColumn("{task.description}", markup=False))
    with progress_of(*columns, TimeElapsedColumn(), TimeRemainingColumn()) as progress:
        bar = progress.add_task("compiling", total=1.0)
        if progress.console.is_terminal:  # a person waits for the compiler; a log gets the first line after it
            progress.start()

        def show(row: dict, done: float) -> None:
            progress.start()
            progress.update(bar, completed=done, description=_summary(row))

        policy = run_training(checked, out, resume=resume, on_update=show)
    say(f"progress: {out / PROGRESS}", f"policy: {policy}", f"next: vssm-gym evaluate {policy} --out DIR")


def _summary(row: dict) -> str:
    text = f"{row['steps']:,} steps"
    return text if row["success"] is None else f"{text}, return {row['return']:.2f}, success {row['success']:.0%}"
