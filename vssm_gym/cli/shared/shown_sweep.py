"""Run a sweep and show it: notices of its scenes, its progress and its results, for commands and programs alike."""

from pathlib import Path

from vssm_gym.cli.shared.console import print_notices, print_results
from vssm_gym.cli.shared.progress import progress_bars
from vssm_gym.eval.sweep import runner
from vssm_gym.eval.sweep.config import SweepConfig
from vssm_gym.eval.sweep.shards import Shard


def run_sweep(
    config: SweepConfig,
    out: str | Path,
    *,
    resume: bool = False,
    workers: int | None = None,
    seed: int = 0,
    shard: Shard | None = None,
    ray: str | None = None,
    quiet: bool = False,
) -> Path:
    """Run the episodes of a configuration that are not yet in ``out/episodes.jsonl``, and print their results.

    Notices of the scenes and the progress are printed on stderr, the table of results on stdout. Each row is on disk as
    soon as its episode ends. Ctrl-C lets the episodes that are running end (seconds), keeps them and raises
    KeyboardInterrupt. ``docs/evaluation.md`` describes configuration, rows and metrics.

    Args:
        config: read by ``load_config``; its agents may be of the program, by ``register_agent``.
        out: new or empty folder, or with ``resume`` that of a sweep of the same configuration and seed.
        resume: continue; with no episode there yet, begin.
        workers: processes; None: two, or one for each CPU of a cluster.
        seed: of the recorded drives that maps are learned from; episodes take theirs from the configuration.
        shard: the part of the episodes to run; None: all of them.
        ray: address of a Ray cluster whose machines run the episodes; None: this machine does.
        quiet: print nothing.

    Returns:
        The file ``out/episodes.jsonl``.

    Raises:
        InputError: the folder is not this sweep's, or one is running in it; a scene that cannot be used; a worker died;
            no such cluster, or one of other versions; a program that workers cannot import; an agent that returns no
            decision.
        OutputError: a full disk or the like; the episodes before are kept.
        RuntimeError: an error inside an agent, whose traceback precedes it; the message names scene and task.
    """
    runner.leave_unguarded_import()
    if quiet:
        return runner.run_sweep(config, out, resume=resume, workers=workers, seed=seed, shard=shard, ray=ray)
    print_notices(config.scenes, config.env[0])
    with progress_bars() as progress:
        log = runner.run_sweep(
            config, out, resume=resume, workers=workers, seed=seed, shard=shard, ray=ray, on_progress=progress
        )
    print_results(log)
    return log
