"""Run ``vssm-gym reproduce FOLDER --out DIR``: rows of a finished sweep or study once more."""

from pathlib import Path
from typing import Annotated

import tyro

from vssm_gym.cli.shared.console import say
from vssm_gym.cli.shared.interruption import interruptible


@interruptible("*.jsonl")
def reproduce(
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")],
    out: Path,
    episodes: int = 20,
    tolerance: float = 1e-3,
    scenes: tuple[str, ...] = (),
    task_file: Path | None = None,
    workers: int = 2,
    resume: bool = False,
) -> None:
    """Run rows of a finished sweep or study again and demand the same outcomes; exit status 1 if one differs.

    The rows are spread evenly over all. Each is compared field by field: numbers within the tolerance, everything else
    exactly; the first field that differs is printed. What says by what and how fast a row was made, such as the hash of
    the map that was learned, is not compared, nor are fields that a row does not have. OUT gets the rows that were run.
    Policies NAME@HASH of a sweep are those of the package and of FOLDER/policies.

    Args:
        folder: of the sweep, such as eval/baselines/navigation_levels, of a study, such as eval/baselines/maze_slam,
            or of a track of the benchmark, such as eval/baselines/benchmark/small-v1/slam.
        out: new or empty folder, or with --resume that of an interrupted run.
        episodes: rows to run.
        tolerance: of numbers, absolute below 1 and relative above.
        scenes: files of scenes that are not built in, as the sweep's configuration named them.
        task_file: that of the sweep's configuration, where it had one.
        workers: number of processes that run episodes; a study's rows run one after the other.
        resume: keep the rows that are in OUT, and run the others.
    """
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.envs.scenes.specs import scene_name
    from vssm_gym.errors import InputError
    from vssm_gym.eval.reproduction.registry import reproduce as run
    from vssm_gym.files.output_folders import check_at_least, check_folder
    from vssm_gym.instruction_set import cpu_model
    from vssm_gym.version import package_version

    check_at_least("reproduce", "episodes", episodes, 1)
    if not 0.0 <= tolerance < 1.0:
        raise InputError("reproduce", "tolerance", f"at least 0 and below 1, not {tolerance:g}")
    check_folder(out)
    named = {scene_name(scene): scene for scene in scenes}
    with progress_bars() as progress:
        found = run(folder, out, episodes, tolerance, named, task_file, workers, resume, progress)
    different = [one for one in found if one.difference is not None]
    for one in different:
        say(f"{one.name}: {one.difference}")
    here = f"{package_version()} on {cpu_model()}"
    if others := sorted({one.made_by for one in different} - {"", here}):
        say(f"rows that differ were made by {', '.join(others)}; this is {here}")
    say(f"{len(found) - len(different)} of {len(found)} rows have the same outcome within {tolerance:g}")
    if different:
        raise SystemExit(1)
