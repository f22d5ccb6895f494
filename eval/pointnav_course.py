"""PointNav in a sweep: its tasks, its environment, and one episode of it."""

from functools import lru_cache
from pathlib import Path
from typing import Any

import gymnasium as gym

from vssm_gym.agents.base import Agent
from vssm_gym.envs.robots import NOISE_LEVELS, HolonomicRobot
from vssm_gym.envs.scene import Apartment, load_scene
from vssm_gym.envs.tasks import TaskSampler, TaskSet, load, save, task_set
from vssm_gym.eval.config import Condition, Episode, episode_seed
from vssm_gym.eval.episode import Spectator, run_episode
from vssm_gym.voxel_map import VoxelMap


def write_tasks(apartment: Apartment, n: int, path: Path) -> None:
    """The first ``n`` test tasks of a scene as a file; one that is there and holds them is kept."""
    if path.is_file() and len(load(path, apartment).tasks) >= n:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    save(task_set(apartment, HolonomicRobot(), "test", n), path)


def run(
    episode: Episode,
    agent: Agent,
    task_file: Path,
    voxel_map: VoxelMap | None,
    spectator: Spectator | None = None,
) -> dict[str, Any]:
    """Run one episode; returns what it was worth."""
    tasks, noise = _tasks(task_file), NOISE_LEVELS[episode.condition.noise]
    return run_episode(
        _env(episode.condition, agent.needs_pose),
        _sampler(episode.condition.scene),
        agent,
        tasks.tasks[episode.task],
        seed=episode_seed(episode.seed, tasks.scene_hash, episode.task),
        voxel_map=voxel_map,
        noise=(noise.turn, noise.step),
        spectator=spectator,
    )


@lru_cache(maxsize=2)  # of one condition, with and without the observed pose: episodes come condition by condition
def _env(condition: Condition, observe_pose: bool) -> gym.Env:
    return gym.make(
        condition.env,
        scene=condition.scene,
        noise=condition.noise,
        sensor_noise=condition.sensor_noise,
        renderer=condition.renderer,
        observe_pose=observe_pose,
        reward="sparse",
        disable_env_checker=True,
    )


@lru_cache(maxsize=1)
def _sampler(scene: str) -> TaskSampler:
    return TaskSampler(load_scene(scene), HolonomicRobot())


@lru_cache(maxsize=1)
def _tasks(path: Path) -> TaskSet:
    return load(path)
