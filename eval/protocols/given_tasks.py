"""Take the tasks of a sweep from a file: a set of tasks as a sweep writes it, or a PointNav episode file of Habitat."""

import hashlib
from pathlib import Path

from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.scene import Apartment
from vssm_gym.envs.tasks import navigation
from vssm_gym.envs.tasks.habitat import HABITAT_BYTES, read_habitat
from vssm_gym.envs.tasks.navigation import TaskSet
from vssm_gym.errors import InputError
from vssm_gym.files.bounded import read_bytes
from vssm_gym.files.json_file import read_packed_json


def given_tasks(source: Path, apartment: Apartment, most: int | None = None) -> TaskSet:
    """Return the tasks of an apartment from a file.

    Args:
        source: JSON of a :class:`TaskSet`, or a file of PointNav episodes, packed if its name ends in ``.gz``.
        apartment: the scene.
        most: tasks that are wanted; None: all.

    Raises:
        InputError: neither kind of file, a damaged one, or tasks of other scenes.
    """
    content = read_packed_json(source, HABITAT_BYTES, "a readable file of tasks")
    if isinstance(content, dict) and "episodes" in content:
        return read_habitat(source).task_set(apartment, HolonomicRobot(), most=most)
    return navigation.load(source, apartment)


def write_given_tasks(source: Path, apartment: Apartment, n: int, path: Path) -> None:
    """Write the tasks of a file as a sweep's task file; keep one that is there, which the sweep's hash protects.

    Raises:
        InputError: as :func:`given_tasks`, or fewer than ``n`` tasks.
    """
    if path.is_file():
        return
    tasks = given_tasks(source, apartment, n)
    if len(tasks.tasks) < n:
        expected = f"tasks numbered below {len(tasks.tasks)}, as many as the file has of scene {apartment.name}"
        raise InputError(source, "tasks", expected)
    path.parent.mkdir(parents=True, exist_ok=True)
    navigation.save(tasks, path)


def task_file_hash(path: Path) -> str:
    """Return the first 16 hex digits of the SHA-256 of a file of tasks."""
    return hashlib.sha256(read_bytes(path, HABITAT_BYTES, "a readable file of tasks")).hexdigest()[:16]
