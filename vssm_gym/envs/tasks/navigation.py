"""Sample, check and freeze navigation tasks: start and goal free, more than 3 body lengths apart, at least 1 m of path.

Task i of a split is drawn from a stream of its own, seeded by (scene name, split, seed, i): a longer set begins with
the shorter one, and no split shares a stream with another. Sets of the built-in scenes are frozen as JSON under
``envs/assets/tasks``, with the hash of the scene they belong to and of their own content.
"""

import hashlib
import json
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

import numpy as np
from pydantic import BaseModel, Field

from vssm_gym.envs.robots.base import Robot
from vssm_gym.envs.scenes.content_hash import content_hash
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.scenes.scene import ASSETS, Apartment
from vssm_gym.envs.tasks.geodesic import Geodesics
from vssm_gym.envs.validation import StrictModel, validated
from vssm_gym.errors import InputError, one_of
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.json_file import read_json

FROZEN = ASSETS / "tasks"
Split = Literal["train", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)

GOAL_APART = 3.0  # body lengths between start and goal, more than
SUCCESS = 2.0  # body lengths from the goal within which stopping is success
SHORTEST = 1.0  # m, least geodesic from start to success region
BORDER_MARGIN = 0.02  # m that start and goal keep from the border of free space, so that rounding never decides
# m that a start may be off free space: a chained task begins where contacts left the robot. They give by 1 mm. And the
# floor ends at the walls' centre lines, while a closed outer door flush with the outside (ProcTHOR's house_1) leaves a
# recess behind that line, where the robot penetrates nothing: 1 cm deep in walls of 10 cm, 2 cm in walls of 12 cm.
START_SLACK = 0.03
SHIPPED_TASKS = 200  # of each split of a built-in scene
_PAIRS = 256  # pairs of positions tried for one task before giving up


class Task(StrictModel):
    """Drive from ``start`` and stop within the success radius of ``goal``; world frame, metres and radians."""

    id: Annotated[int, Field(ge=0)]
    scene: str
    start: tuple[float, float, float]  # x, y, heading
    goal: tuple[float, float]
    geodesic: Annotated[float, Field(ge=0.0)]  # shortest path of the footprint from start to success region


class Footprint(StrictModel):
    """Hold the dimensions of a robot that decide where it fits and when it has arrived, metres."""

    body_length: float
    radius: float
    height: float

    @classmethod
    def of(cls, robot: Robot) -> "Footprint":
        """Return the footprint of a robot."""
        return cls(body_length=robot.body_length, radius=robot.radius, height=robot.height)


class TaskSet(StrictModel):
    """Hold the tasks of one scene, robot and split; ``hash`` is :meth:`content_hash`, verified on loading."""

    format: Literal[1] = 1
    scene: str
    scene_hash: str
    robot: Footprint
    split: Split
    tasks: tuple[Task, ...]
    hash: str = ""

    def content_hash(self) -> str:
        """Return the first 16 hex digits of the SHA-256 of the canonical JSON without ``hash``."""
        return content_hash(self, without="hash")


def save(tasks: TaskSet, path: Path) -> None:
    """Write as JSON, one task a line, atomically."""
    head = json.dumps(tasks.model_dump(mode="json", exclude={"tasks"}), indent=1).removesuffix("\n}")
    lines = ",\n".join("  " + json.dumps(task.model_dump(mode="json")) for task in tasks.tasks)
    with atomic_write(path) as temporary:
        temporary.write_text(f'{head},\n "tasks": [\n{lines}\n ]\n}}\n', encoding="utf-8")


S = TypeVar("S", bound=BaseModel)


def load(path: Path, apartment: Apartment | None = None) -> TaskSet:
    """Return the task set in a file; see :func:`read`."""
    return read(TaskSet, path, apartment)


def read(kind: type[S], path: Path, apartment: Apartment | None) -> S:
    """Return the set of tasks of a kind of robot in a file; for ``apartment`` where one is given.

    Raises:
        InputError: no such file, no JSON, another format, content that does not match its hash, or another scene's.
    """
    tasks: Any = validated(kind, read_json(path, expected="a readable task file"), path)
    found = tasks.content_hash()
    if tasks.hash != found:
        raise InputError(path, "hash", f"{found}, the hash of the tasks as they are; found {tasks.hash!r}")
    if apartment is not None and tasks.scene_hash != apartment.content_hash():
        expected = f"{apartment.content_hash()}, the hash of scene {apartment.name}; found {tasks.scene_hash}"
        raise InputError(path, "scene_hash", expected)
    return tasks


def task_set(apartment: Apartment, robot: Robot, split: Split, n: int) -> TaskSet:
    """Return the first ``n`` tasks of a split.

    They are read from the frozen file if it belongs to this scene and robot, else generated.
    """
    path = FROZEN / f"{apartment.name}-{split}.json"
    if path.is_file():
        frozen = load(path)
        current = frozen.scene_hash == apartment.content_hash() and frozen.robot == Footprint.of(robot)
        if current and n <= len(frozen.tasks):
            return _hashed(frozen.model_copy(update={"tasks": frozen.tasks[:n]}))
    return make_tasks(apartment, robot, n, split)


def make_tasks(apartment: Apartment, robot: Robot, n: int, split: Split, seed: int = 0) -> TaskSet:
    """Make ``n`` tasks, each from its own stream.

    Raises:
        InputError: an unknown split, or an apartment without two places far enough apart.
    """
    if split not in SPLITS:
        raise InputError("tasks", "split", one_of(SPLITS, split))
    sampler = TaskSampler(apartment, robot)
    key = hashlib.sha256(f"{apartment.name}|{split}|{seed}".encode()).digest()
    entropy = [int.from_bytes(key[i : i + 4], "little") for i in range(0, 16, 4)]
    tasks = TaskSet(
        scene=apartment.name,
        scene_hash=apartment.content_hash(),
        robot=Footprint.of(robot),
        split=split,
        tasks=tuple(sampler.draw(np.random.default_rng([*entropy, i]), i) for i in range(n)),
    )
    return _hashed(tasks)


def freeze(apartment: Apartment, robot: Robot, n: int = SHIPPED_TASKS, folder: Path = FROZEN) -> list[Path]:
    """Write the files that :func:`task_set` looks for, one a split; for built-in scenes, after they changed."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for split in SPLITS:
        paths.append(folder / f"{apartment.name}-{split}.json")
        save(make_tasks(apartment, robot, n, split), paths[-1])
    return paths


class TaskSampler:
    """Sample and check tasks of one apartment and robot, in the largest connected part of its free space."""

    def __init__(self, apartment: Apartment, robot: Robot) -> None:
        self.space = FreeSpace.from_apartment(apartment, robot.radius, robot.height)
        self.scene = apartment.name
        self.success_radius = SUCCESS * robot.body_length  # m
        self._apart = GOAL_APART * robot.body_length

    @cached_property
    def geodesics(self) -> Geodesics:
        """Return the shortest paths in ``space``."""
        return Geodesics(self.space)

    def draw(self, rng: np.random.Generator, task_id: int = 0) -> Task:
        """Draw a task with uniform positions and heading, conditioned on distances: the first of ``rng`` that is one.

        Raises :class:`InputError` where free space is too small for any.
        """
        positions = self.space.sample(rng, 2 * _PAIRS, BORDER_MARGIN).round(4)  # written to files as they are: 0.1 mm
        heading = round(float(rng.uniform(-np.pi, np.pi)), 4)
        for start, goal in positions.reshape(_PAIRS, 2, 2):
            if np.linalg.norm(start - goal) <= self._apart:
                continue
            length = self.geodesics.length(start, goal, self.success_radius)
            if SHORTEST <= length < np.inf:
                return self._task(task_id, (*start.tolist(), heading), goal.tolist(), round(float(length), 6))
        expected = f"free space with places {SHORTEST} m of path apart; none found for task {task_id}"
        raise InputError(self.scene, "rooms", expected)

    def task(self, start: Sequence[float], goal: Sequence[float], task_id: int = 0) -> Task:
        """Return the task from ``start`` (x, y, heading) to ``goal``, of any length; raise as :meth:`validate`."""
        task = self._task(task_id, start, goal, 0.0)
        return task.model_copy(update={"geodesic": self._length(task)})

    def validate(self, task: Task) -> None:
        """Raise :class:`InputError` unless the task is of this scene: free, connected ends and the right geodesic."""
        source = f"task {task.id} of {task.scene}"
        validated(Task, dict(task), source)  # again, since pydantic's model_copy(update=...) checks nothing
        if task.scene != self.scene:
            raise InputError(source, "scene", f"{self.scene!r}")
        length = self._length(task)
        if abs(length - task.geodesic) > 0.01 * length + 1e-6:
            expected = f"{length:.3f} m, the shortest path in this scene; found {task.geodesic}"
            raise InputError(source, "geodesic", expected)

    def _length(self, task: Task) -> float:
        source = f"task {task.id} of {self.scene}"
        start, goal = np.array(task.start[:2]), np.array(task.goal)
        fitting = self.space.nearest(start)
        for field, (x, y), away in (
            ("start", start, np.linalg.norm(fitting - start) > START_SLACK),
            ("goal", goal, not self.space.contains(goal)),
        ):
            if away:
                obstacles = ", ".join(self.space.obstacles_at((x, y))[:3])
                why = f"it would collide with {obstacles}" if obstacles else self.space.off_the_floor()
                raise InputError(source, field, f"a position where the robot fits; at ({x:.2f}, {y:.2f}) {why}")
        length = self.geodesics.length(fitting, goal, self.success_radius)
        if not np.isfinite(length):
            raise InputError(source, "goal", "a position that the robot can reach from the start")
        return length

    def _task(self, task_id: int, start: Sequence[float], goal: Sequence[float], geodesic: float) -> Task:
        data = {"id": task_id, "scene": self.scene, "start": list(start), "goal": list(goal), "geodesic": geodesic}
        return validated(Task, data, "task")


def checked_set(source: str, tasks: object, apartment: Apartment) -> TaskSet:
    """Return a task set that an environment was given; raise :class:`InputError` unless it is of this scene."""
    if not isinstance(tasks, TaskSet) or not tasks.tasks:
        raise InputError(source, "tasks", f"a TaskSet that holds a task; found {tasks!r:.80}")
    if tasks.scene_hash != apartment.content_hash():
        raise InputError("tasks", "scene_hash", f"tasks of this version of {apartment.name!r}")
    return tasks


def _hashed(tasks: TaskSet) -> TaskSet:
    return tasks.model_copy(update={"hash": tasks.content_hash()})
