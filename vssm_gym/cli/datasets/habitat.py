"""Run ``vssm-gym dataset from-habitat`` and ``to-habitat``: PointNav episode files of Habitat."""

from pathlib import Path
from typing import Annotated

import tyro

from vssm_gym.cli.shared.console import say
from vssm_gym.cli.shared.interruption import interruptible


@interruptible()
def from_habitat(
    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")],
    scene: str,
    out: Path,
    scene_id: str | None = None,
) -> None:
    """Convert a PointNav episode file of Habitat to tasks of a scene.

    Start and goal of every episode must be places where the robot fits, in a connected part of the scene. A sweep takes
    FILE itself, as its `task_file`.

    Args:
        file: PointNav episodes (.json.gz or .json).
        scene: built-in name or path of a scene file, with the origin of the file's scene.
        out: new file for the tasks (.json).
        scene_id: which of the file's scenes; by default the one whose file has the scene's name.
    """
    from vssm_gym.cli.shared.console import print_notices
    from vssm_gym.envs.robots import HolonomicRobot
    from vssm_gym.envs.scenes.scene import load_scene
    from vssm_gym.envs.tasks import navigation
    from vssm_gym.envs.tasks.habitat import read_habitat
    from vssm_gym.files.output_folders import check_new_file

    check_new_file(out, (".json",))
    episodes = read_habitat(file)
    print_notices([scene])
    tasks = episodes.task_set(load_scene(scene), HolonomicRobot(), scene_id)
    navigation.save(tasks, out)
    say(f"{len(tasks.tasks)} tasks of {tasks.scene}: {out}", f"next: a sweep with task_file: {out}")


@interruptible()
def to_habitat(
    scene: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")],
    out: Path,
    tasks: Path | None = None,
    count: int | None = None,
    template: Path | None = None,
    scene_id: str | None = None,
) -> None:
    """Write tasks of a scene as a PointNav episode file of Habitat.

    With a template, episodes whose start and goal are those of a task come back as they are in the template, with all
    fields; the others get new starts, goals and distances.

    Args:
        scene: built-in name or path of a scene file.
        out: new file (.gz or .json).
        tasks: file of tasks, as `from-habitat` or a sweep writes it; by default the scene's test tasks.
        count: number of tasks, up to 100000; by default 100 of the test tasks, or all of a file.
        template: episode file whose fields are kept.
        scene_id: which of the template's scenes; by default the one whose file has the scene's name.
    """
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.envs.robots import HolonomicRobot
    from vssm_gym.envs.scenes.scene import load_scene
    from vssm_gym.envs.tasks.habitat import habitat_file, read_habitat, write_habitat
    from vssm_gym.envs.tasks.navigation import TaskSampler, task_set
    from vssm_gym.errors import InputError
    from vssm_gym.eval.protocols.given_tasks import given_tasks
    from vssm_gym.eval.sweep.config import MOST_TASKS
    from vssm_gym.files.output_folders import check_at_least, check_new_file

    check_new_file(out, (".gz", ".json"))
    check_at_least("dataset", "count", 1 if count is None else count, 1)
    if count is not None and count > MOST_TASKS:
        raise InputError("dataset", "count", f"at most {MOST_TASKS:,}, so that the file can be read; found {count:,}")
    if scene_id is not None and template is None:
        raise InputError("dataset", "scene_id", "none without a template, whose scene it names")
    apartment, robot = load_scene(scene), HolonomicRobot()
    with progress_bars() as progress:
        if tasks is None:
            wanted = 100 if count is None else count
            progress("drawing tasks", 0, wanted)
            found = task_set(apartment, robot, "test", wanted)
            progress("drawing tasks", wanted, wanted)
        else:
            found = given_tasks(tasks, apartment)
            found = found if count is None else found.model_copy(update={"tasks": found.tasks[:count]})
        progress("writing episodes", 0, len(found.tasks))
        sampler = TaskSampler(apartment, robot)
        if template is None:
            file = habitat_file(found, sampler)
        else:
            file = read_habitat(template).with_tasks(found.tasks, sampler, scene_id)
        write_habitat(file, out)
        progress("writing episodes", len(found.tasks), len(found.tasks))
    say(f"{len(file.content['episodes'])} episodes: {out}")
