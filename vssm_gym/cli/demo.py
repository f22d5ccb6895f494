"""Run ``vssm-gym demo``: map an apartment, run five agents in it, write the report."""

from pathlib import Path

from vssm_gym.cli.shared.console import say
from vssm_gym.cli.shared.interruption import interruptible


@interruptible("episodes.jsonl", "maps/*.npz")
def demo(out: Path = Path("out/demo"), resume: bool = False, workers: int = 2, seed: int = 0) -> None:
    """Record a drive through `oak`, learn its map, run five agents on 10 tasks, and write a report.

    It takes a few minutes on two cores. The last line printed is the path of the report.

    Args:
        out: new or empty folder for the results.
        resume: continue an interrupted demo in OUT.
        workers: number of processes that run episodes.
        seed: seed of the recorded drive from which the map is learned.
    """
    from vssm_gym import eval as evaluation
    from vssm_gym.cli.shared.shown_sweep import run_sweep
    from vssm_gym.eval.report.page import write_report
    from vssm_gym.eval.sweep.config import load_config

    config = load_config(Path(evaluation.__file__).parent / "configs" / "demo.yaml")
    run_sweep(config, out, resume=resume, workers=workers, seed=seed)
    say(write_report(out))
