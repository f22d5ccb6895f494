"""Load scenes, write and read task files, and cache environments for the episode protocols.

A sweep runs its episodes condition by condition, so that a worker keeps few of these at a time and loads nothing twice.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import gymnasium as gym

from vssm_gym.envs.robots import DIRECTION_FRAMES, HOLONOMIC_NOISES, HolonomicRobot
from vssm_gym.envs.robots.registry import HOLONOMIC_ROBOTS
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.scenes.scene import Apartment, built_in_scenes, load_scene
from vssm_gym.envs.sensors import RENDERERS
from vssm_gym.envs.sensors.rgbd_noise import PRESETS
from vssm_gym.envs.tasks.car_sets import CarTaskSet
from vssm_gym.envs.tasks.navigation import TaskSampler, TaskSet, read
from vssm_gym.eval.episodes.identity import Condition
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.slam.map_building import ensure_map

__all__ = ["ensure_map"]  # of learned maps, with those that are defined here

S = TypeVar("S", TaskSet, CarTaskSet)
# Fields of a condition that are keywords of environments
WORLD = ("scene", "robot", "noise", "sensor_noise", "renderer", "direction_frame")


def scene_names() -> Sequence[str]:
    """Return the names of the built-in apartments."""
    return built_in_scenes()


def conditions() -> Mapping[str, Sequence[str]]:
    """Return the names that a configuration may hold for the holonomic robot in an apartment."""
    return {
        "robot": HOLONOMIC_ROBOTS,
        "noise": tuple(HOLONOMIC_NOISES),
        "sensor_noise": tuple(PRESETS),
        "renderer": tuple(RENDERERS),
        "direction_frame": DIRECTION_FRAMES,
    }


def load_map(path: Path) -> VoxelMap:
    """Return the map of a file that ``ensure_map`` has made."""
    return VoxelMap.load(path)


@lru_cache(maxsize=1)
def load(scene: str) -> Apartment:
    """Load the apartment of a built-in name, a seed or a file; a process keeps the last one."""
    return load_scene(scene)


def notice(apartment: Apartment) -> str:
    """Return the faults of an apartment and its areas that a robot cannot reach, in one line; empty without any."""
    robot = HolonomicRobot()
    return FreeSpace.from_apartment(apartment, robot.radius, robot.height).notice(apartment.notes)


def keep_or_write(
    apartment: Apartment,
    n: int,
    path: Path,
    load: Callable[[Path, Apartment], S],
    make: Callable[[], S],
    save: Callable[[S, Path], None],
) -> None:
    """Write the task set that ``make`` returns; keep a file that already holds ``n`` tasks of the scene."""
    if path.is_file() and len(load(path, apartment).tasks) >= n:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    save(make(), path)


def tasks_in(path: Path, kind: type[S]) -> S:
    """Read and verify the tasks of a file, once a process."""
    tasks = _read(path, kind)
    assert isinstance(tasks, kind)
    return tasks


@lru_cache(maxsize=1)
def _read(path: Path, kind: type[TaskSet] | type[CarTaskSet]) -> TaskSet | CarTaskSet:
    return read(kind, path, None)


@lru_cache(maxsize=1)
def sampler_of(scene: str) -> TaskSampler:
    """Return the task sampler of an apartment, with the holonomic robot's free space and shortest paths."""
    return TaskSampler(load(scene), HolonomicRobot())


def world(condition: Condition, env: str | None = None, fields: Sequence[str] = WORLD, **keywords: Any) -> gym.Env:
    """Return the environment of a condition, or ``env`` in its place, made once with these keywords.

    ``fields`` of the condition are keywords of it, too.
    """
    shared = {name: getattr(condition, name) for name in fields}
    return _made(env or condition.env, tuple(sorted((shared | keywords).items())), load)


def made(env: str, **keywords: Any) -> gym.Env:
    """Return an environment with the sparse reward, made once with these keywords."""
    return _made(env, tuple(sorted(keywords.items())), None)


@lru_cache(maxsize=3)  # with and without the observed pose, and PointNav on an explorer's map
def _made(env: str, keywords: tuple[tuple[str, Any], ...], load: Callable[[str], Apartment] | None) -> gym.Env:
    chosen = dict(keywords)
    if load is not None:
        chosen["scene"] = load(chosen["scene"])
    return gym.make(env, **chosen, reward="sparse", disable_env_checker=True)
