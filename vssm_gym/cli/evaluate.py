"""Run ``vssm-gym evaluate POLICY --out DIR``: evaluate a policy in the simulator and in a learned map."""

from pathlib import Path
from typing import Annotated

import tyro

from vssm_gym.cli.shared.console import literal_console, say
from vssm_gym.cli.shared.interruption import interruptible


@interruptible("episodes.jsonl", "maps/*.npz")
def evaluate(
    policy: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="POLICY")],
    out: Path,
    scene: str = "oak",
    tasks: int = 100,
    robot: str = "holonomic",
    noise: str = "low",
    transition: Path | None = None,
    map: Path | None = None,
    resume: bool = False,
    workers: int = 2,
    seed: int = 0,
    video: int | None = None,
) -> None:
    """Evaluate a policy on the test tasks of a scene, in the simulator as a sweep does, and in the learned map.

    OUT is the folder of a sweep, of which `vssm-gym report OUT` writes a report; evaluation.json holds the printed
    numbers. With --video, OUT also gets a video of one task, simulated beside imagined (the extra `viz`).

    Args:
        policy: policy.npz of `vssm-gym train`, or oak or reactive, which come with the package.
        out: new or empty folder for the results.
        scene: built-in name or path of a scene file.
        tasks: number of the scene's test tasks.
        robot: that drives in the simulator: holonomic, or worn, whose drive lags and slips.
        noise: execution noise: none, low, mid, high or locobot.
        transition: file of `vssm-gym train-dynamics` by which robots move in imagination, with its own noise; by
            default they move as the holonomic robot does.
        map: map file in which the policy's agent tracks its pose and in which the tasks are imagined, such as the one
            trained in; by default one is learned from a recorded drive.
        resume: continue the same evaluation in OUT.
        workers: number of processes that run episodes.
        seed: seed of the imagined episodes, and of the recorded drive where a map is learned.
        video: number of the task to film, from 0; with --resume also for a finished evaluation.
    """
    from rich.table import Table

    from vssm_gym.cli.shared.console import print_notices
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.errors import InputError
    from vssm_gym.files.output_folders import check_at_least
    from vssm_gym.training.evaluation import METRICS, evaluate_policy

    check_at_least("evaluate", "tasks", tasks, 1)
    if video is not None:
        from vssm_gym.eval.video.writer import check_writer

        if not 0 <= video < tasks:
            raise InputError("evaluate", "video", f"a task from 0 to {tasks - 1}; found {video}")
        check_writer("evaluate")
    print_notices([scene])
    with progress_bars() as progress:
        found = evaluate_policy(
            policy,
            out,
            scene=scene,
            tasks=tasks,
            robot=robot,
            noise=noise,
            transition=transition,
            map_file=map,
            resume=resume,
            workers=workers,
            seed=seed,
            on_progress=progress,
        )
    title = f"{found.label} · {scene} · {robot} · {noise} · {tasks} tasks; in brackets 95 % intervals"
    table = Table(title=title, title_justify="left", box=None)
    worlds = {"real": found.real, "imagined": found.imagined, "imagined - real": found.gap}
    shown = {name: means for name, means in worlds.items() if means is not None}
    table.add_column("", no_wrap=True)
    for name in shown:
        table.add_column(name, justify="right", no_wrap=True)
    for metric in METRICS:
        digits = 1 if metric == "collisions" else 2
        table.add_row(metric, *(means[metric].text(digits) for means in shown.values()))
    literal_console().print(table)
    if found.notice:
        say(f"no imagined episodes: {found.notice}")
    if video is not None:
        from vssm_gym.training.recording import record_runs
        from vssm_gym.training.video import write_video

        path = out / f"task-{video}.mp4"
        with progress_bars() as progress:
            both = record_runs(
                policy,
                out,
                scene=scene,
                task=video,
                robot=robot,
                noise=noise,
                transition=transition,
                seed=seed,
                on_progress=progress,
            )
            write_video(path, both, progress)
        say(f"video: {path}")
    say(f"next: vssm-gym report {out}")
