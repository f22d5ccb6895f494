"""Run ``vssm-gym train CONFIG --out DIR``: train a policy in a learned map, or in the simulator."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from vssm_gym.cli.shared.console import say
from vssm_gym.cli.shared.interruption import interruptible

if TYPE_CHECKING:
    from vssm_gym.training.config import TrainingConfig
    from vssm_gym.training.run import Row


@interruptible("checkpoint.pt", "demonstrations.npz", "policy.npz")
def train(
    config: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CONFIG")],
    out: Path,
    resume: bool = False,
    map: Path | None = None,
    seed: int | None = None,
) -> None:
    """Train a policy; OUT gets policy.npz, checkpoint.pt, progress.jsonl and logs for TensorBoard.

    Interrupt at any time: progress is kept, and --resume continues. Return and success are shown when enough episodes
    have ended. To evaluate the policy, run `vssm-gym evaluate`, or name it in a sweep as "policy:OUT/policy.npz".

    Args:
        config: YAML with name, environment, policy, algorithm, steps [minutes, seed]; eval/configs/ppo_oak.yaml is one.
        out: new or empty folder for the results.
        resume: continue the training of the same configuration in OUT.
        map: the map file to train in, in place of the configuration's.
        seed: seed of network, exploration and environments, in place of the configuration's.
    """
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    from vssm_gym.cli.shared.progress import progress_of
    from vssm_gym.files.output_folders import check_at_least
    from vssm_gym.training.config import load_training
    from vssm_gym.training.train import PROGRESS, run_training

    if seed is not None:
        check_at_least("train", "seed", seed, 0)
    checked = load_training(config, map_file=map, seed=seed)
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[note]}", markup=False))
    last: Row = {}
    with progress_of(*columns, TimeElapsedColumn(), TimeRemainingColumn()) as show:
        show("training", 0.0, 1.0, "building and compiling")

        def on_update(row: "Row", done: float) -> None:
            last.update(row)
            show("training", done, 1.0, _summary(row, checked))

        policy = run_training(checked, out, resume=resume, on_update=on_update)
    if last:
        say(_times(last))
    say(f"log: {out / PROGRESS}", f"policy: {policy}", f"next: {_evaluation(policy, checked)}")


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
