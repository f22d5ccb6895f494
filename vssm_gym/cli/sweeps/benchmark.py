"""Run ``vssm-gym benchmark SUITE --entry ENTRY --out DIR``: score anyone's agent, SLAM method or world model."""

from pathlib import Path
from typing import Annotated

import tyro

from vssm_gym.cli.shared.console import say
from vssm_gym.cli.shared.interruption import interruptible


@interruptible("*/episodes.jsonl", "*/rows.jsonl")
def benchmark(
    suite: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SUITE")],
    entry: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ENTRY [ENTRY ...]", help_behavior_hint="")],
    out: Path,
    tracks: Annotated[tuple[str, ...], tyro.conf.arg(metavar="TRACK")] = (),
    resume: bool = False,
    workers: int = 2,
) -> None:
    """Score agents, SLAM methods and world models on frozen tasks, beside those of the package.

    OUT gets results.md and results.json: a table a track, with 95 % intervals, the time of a decision, the version and
    the machine; and a folder a track, which `vssm-gym report` shows if agents drive in it. An entry takes part in every
    track that it is for. Where its code fails or takes too long, its run counts as a failure, and the table says why.

    Args:
        suite: small (made for 20 minutes on two cores with one entry a track), full, or the file of a suite.
        entry: FILE.py:CLASS, PACKAGE.MODULE:CLASS, the .npz file of a policy, the name of an entry point of an
            installed package (groups vssm_gym.agents, vssm_gym.slam, vssm_gym.predictors), or a name of what comes with
            the package, such as astar, prism or vssm_lm.
        out: new or empty folder for the results.
        tracks: run these tracks alone.
        resume: continue the benchmark of the same suite and entries in OUT.
        workers: number of processes that run episodes, recordings and drives.
    """
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.eval.benchmark.run import run_benchmark
    from vssm_gym.eval.benchmark.suite import suite_file

    with progress_bars() as progress:
        page = run_benchmark(
            suite_file(suite), entry, out, tracks=tracks, resume=resume, workers=workers, on_progress=progress
        )
    say(*page.read_text(encoding="utf-8").splitlines(), page)
