"""Run ``vssm-gym study NAME``: exploration in the mazes."""

from dataclasses import asdict
from pathlib import Path

from vssm_gym.cli.shared.console import say
from vssm_gym.cli.shared.interruption import interruptible
from vssm_gym.cli.shared.lists import aligned, names_in


@interruptible("maze-exploration.jsonl")
def maze_exploration(
    out: Path,
    mazes: str = "",
    explorers: str = "",
    seeds: int = 7,
    steps: int = 1000,
    noise: str = "low",
    sensor_noise: str = "low",
    resume: bool = False,
) -> None:
    """Compare explorers of LidarMaze's mazes: information of sampled scans, frontiers, trained policies, chance.

    OUT gets maze-exploration.json, maze-exploration.svg and maze-exploration.html, and a row for each run in
    maze-exploration.jsonl: tiles visited and nats gained, every 20 steps.

    Args:
        out: folder for the results.
        mazes: names, separated by commas; all by default.
        explorers: names, separated by commas; all by default.
        seeds: starts and noises in each maze.
        steps: of a run.
        noise: of the execution: none, low, mid or high.
        sensor_noise: of the ranges: none, low, mid or high.
        resume: continue in OUT with the runs that are missing.
    """

    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.eval.studies.maze_exploration.comparison import study as compare
    from vssm_gym.eval.studies.maze_exploration.run import EXPLORATION_ROWS, ExplorationSetting, run
    from vssm_gym.eval.studies.page import study_folder, write_study
    from vssm_gym.files.output_folders import check_folder, check_new_file

    chosen = {name: names_in(text) for name, text in (("mazes", mazes), ("explorers", explorers)) if text}
    setting = ExplorationSetting(**chosen, seeds=seeds, steps=steps, noise=noise, sensor_noise=sensor_noise)
    check_folder(out)
    with study_folder("maze-exploration", out, resume):
        if not resume:
            check_new_file(out / EXPLORATION_ROWS)
        with progress_bars() as progress:
            found = compare(run(setting, out, progress), asdict(setting))
        for line in aligned([found.header, *found.lines]):
            say(line)
        say(found.answer)
        say(write_study(found, out))
