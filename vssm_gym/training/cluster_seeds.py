"""Train one policy a seed on a Ray cluster, each on a CPU of its own, in a folder that all machines share.

A training that loses its process or its machine goes on from its last checkpoint, elsewhere.
"""

import os
import uuid
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, Future, wait
from pathlib import Path

from vssm_gym.cluster.ray_cluster import Calls, Cluster, connected
from vssm_gym.errors import InputError
from vssm_gym.eval.sweep.worker import one_thread
from vssm_gym.files.output_folders import RESUME, check_folder
from vssm_gym.training.config import TrainingConfig
from vssm_gym.training.run import read_progress
from vssm_gym.training.train import BEGUN, PROGRESS, run_training

LOOK_SECONDS = 5.0  # s between looks at the progress of the trainings

OnTrainings = Callable[
    [float, int, int], None
]  # the fraction that is done, steps of all trainings, and ended trainings


def seed_folder(out: Path, seed: int) -> Path:
    """Return the folder of the training of one seed."""
    return out / f"seed-{seed}"


def check_unbegun(out: Path, seeds: Sequence[int]) -> None:
    """Raise :class:`InputError` where the training of a seed has begun, which only ``--resume`` continues."""
    for folder in (seed_folder(out, seed) for seed in seeds):
        if found := [name for name in BEGUN if (folder / name).exists()]:
            raise InputError(folder, "folder", f"a folder without a training; it holds {found[0]} ({RESUME})")


def train_on_cluster(
    config: TrainingConfig,
    seeds: Sequence[int],
    out: Path,
    ray: str,
    *,
    resume: bool = False,
    on_update: OnTrainings | None = None,
) -> list[Path]:
    """Train a policy for each seed on a cluster, and return their files ``out/seed-N/policy.npz``.

    Each folder is that of :func:`vssm_gym.training.train.run_training` with this seed. Ctrl-C lets the current updates
    end, keeps them and raises KeyboardInterrupt.

    Args:
        config: checked; its map, scene or transition, if they are files, lie in a folder that all machines share.
        seeds: different ones, in place of the configuration's.
        out: in a folder that all machines share.
        ray: address of the cluster.
        resume: continue trainings that have begun.
        on_update: called every few seconds.

    Raises:
        InputError: as ``run_training``; no such cluster; a machine that does not see ``out``; a training that was lost
            again and again.
    """
    check_folder(out)
    if not resume:
        check_unbegun(out, seeds)
    with connected(ray, one_thread()) as cluster:
        made = not out.exists()
        out.mkdir(parents=True, exist_ok=True)
        try:
            _check_shared(cluster, out.resolve())
        except InputError:
            if made:
                out.rmdir()
            raise
        calls = Calls(cluster, len(seeds))
        each = [config.model_copy(update={"seed": seed}) for seed in seeds]
        folders = [seed_folder(out.resolve(), seed) for seed in seeds]
        futures = [calls.submit(_train, one, folder) for one, folder in zip(each, folders, strict=True)]
        try:
            return _ended(futures, config, folders, on_update or (lambda done, steps, ended: None))
        except BaseException:  # checkpoints of the others are written
            calls.stop()
            calls.interrupt()
            wait(futures)
            raise
        finally:
            calls.close()


def _ended(
    futures: Sequence[Future], config: TrainingConfig, folders: Sequence[Path], on_update: OnTrainings
) -> list[Path]:
    """Wait for all trainings, and report their progress from their files; and raise the first error."""
    running = set(futures)
    while running:
        ended, running = wait(running, LOOK_SECONDS, "FIRST_EXCEPTION")
        try:
            for future in ended:
                future.result()
        except BrokenExecutor as error:
            expected = f"a cluster whose processes live; a training lost its own again and again ({RESUME})"
            raise InputError("train", "--ray", expected) from error
        rows = [read_progress(folder / PROGRESS)[-1:] for folder in folders if (folder / PROGRESS).is_file()]
        minutes = config.minutes or float("inf")
        shares = [max(row["steps"] / config.steps, row["seconds"] / (60.0 * minutes)) for last in rows for row in last]
        steps = sum(row["steps"] for last in rows for row in last)
        on_update(sum(min(1.0, share) for share in shares) / len(futures), steps, len(futures) - len(running))
    return [future.result() for future in futures]


def _train(config: TrainingConfig, out: Path) -> Path:
    """Run or continue a training on a machine of the cluster."""
    return run_training(config, out, resume=True)


def _check_shared(cluster: Cluster, out: Path) -> None:
    """Raise :class:`InputError` unless every node sees what this process writes into a folder."""
    word, file = uuid.uuid4().hex, out / f".shared.{os.getpid()}.tmp"
    file.write_text(word)
    calls = Calls(cluster, len(cluster.nodes), number=0)
    try:
        for future in [calls.submit(_sees, file, word, node=node) for node in cluster.nodes]:
            if not future.result():
                raise InputError(out, "folder", "a folder that all machines of the cluster share and can write to")
    finally:
        calls.close()
        file.unlink(missing_ok=True)


def _sees(file: Path, word: str) -> bool:
    """Return whether a file holds a word and its folder can be written to."""
    return file.is_file() and file.read_text() == word and os.access(file.parent, os.W_OK)
