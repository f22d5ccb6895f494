"""Run ``vssm-gym study NAME``: exploration and SLAM in the mazes."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

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


@interruptible("maze-slam.jsonl")
def maze_slam(
    out: Path,
    mazes: str = "",
    methods: str = "",
    traversals: int = 4,
    seeds: int = 3,
    steps: int = 3000,
    noise: str = "low",
    sensor_noise: str = "low",
    resume: bool = False,
) -> None:
    """Compare SLAM in the plane on scripted traversals of the mazes: odometry, occupancy, latent grid, pose graph.

    OUT gets maze-slam.json, maze-slam.svg and maze-slam.html, and a row for each run in maze-slam.jsonl: errors every
    100 steps, NEES, seconds.

    Args:
        out: folder for the results.
        mazes: names, separated by commas; by default all but pillars-v1, on which all numbers were chosen.
        methods: of odometry, occupancy, latent, latent_offline, strips_offline and graph, separated by commas; by
            default the first four. graph needs GTSAM (pip install gtsam).
        traversals: of each maze.
        seeds: of the particles of the latent grid.
        steps: of a traversal.
        noise: of the execution: none, low, mid or high.
        sensor_noise: of the ranges: none, low, mid or high.
        resume: continue in OUT with the runs that are missing.
    """
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.eval.studies.maze_slam.comparison import study as compare
    from vssm_gym.eval.studies.maze_slam.run import MAZE_SLAM_ROWS, MazeSlamSetting, run
    from vssm_gym.eval.studies.page import study_folder, write_study
    from vssm_gym.files.output_folders import check_folder, check_new_file

    chosen = {name: names_in(text) for name, text in (("mazes", mazes), ("methods", methods)) if text}
    conditions = {"steps": steps, "noise": noise, "sensor_noise": sensor_noise}
    given: dict[str, Any] = chosen | {"traversals": traversals, "seeds": seeds} | conditions
    setting = MazeSlamSetting(**given)
    check_folder(out)
    with study_folder("maze-slam", out, resume):
        if not resume:
            check_new_file(out / MAZE_SLAM_ROWS)
        with progress_bars() as progress:
            found = compare(run(setting, out, progress), asdict(setting))
        for line in aligned([found.header, *found.lines]):
            say(line)
        say(found.answer)
        say(write_study(found, out))
