"""Run ``vssm-gym demo``: map an apartment, run five agents in it, show one that maps as it drives, write the report."""

from pathlib import Path

from vssm_gym.cli.shared.console import say
from vssm_gym.cli.shared.interruption import interruptible

AGENT = "slam_nav"  # of the run that is shown, from the kitchen through the living room into the bedroom
START, GOAL = (9.76, 1.41, 2.43), (2.36, 5.36)  # x, y (m), heading (rad)
RUN = "navigate"  # its folder


@interruptible("episodes.jsonl", "maps/*.npz")
def demo(out: Path = Path("out/demo"), resume: bool = False, workers: int = 2, seed: int = 0) -> None:
    """Record a drive through `oak`, learn its map, run five agents on 10 tasks, show one run, and write a report.

    It takes a few minutes on two cores. OUT/navigate holds the picture and, with the extra `viz`, the video of one run
    without a map, as of `vssm-gym navigate`. The last line printed is the path of the report.

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
    show_run(out)
    say(write_report(out))


def show_run(out: Path) -> None:
    """Drive one task in the demo's map and print the files of the run; a run that has ended is left as it is."""
    from vssm_gym.agents.registry import agent_type
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.cli.shared.videos import can_write_videos
    from vssm_gym.eval.video.navigator_run import Drive, finished_by, navigate, prepare
    from vssm_gym.eval.video.run_files import PICTURE

    video = can_write_videos("demo")
    folder, last = out / RUN, finished_by(video)
    if not (folder / last).exists():
        map_file = out / "maps" / "oak.npz" if agent_type(AGENT).needs_map else None
        with progress_bars() as progress:
            navigate(prepare(Drive("oak", GOAL, AGENT, START, map_file)), folder, video, progress)
    say(*(folder / name for name in dict.fromkeys((PICTURE, last))))
