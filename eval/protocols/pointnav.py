"""Run PointNav and ImageNav in a sweep: their tasks, their environments, and single episodes.

Both have the same frozen tasks; PointNav observes the goal's position, ImageNav an image taken at the goal.
"""

from functools import partial
from pathlib import Path
from typing import Any

from vssm_gym.agents.base import Agent
from vssm_gym.envs.robots import HOLONOMIC_NOISES, HolonomicRobot
from vssm_gym.envs.scenes.scene import Apartment
from vssm_gym.envs.tasks import navigation
from vssm_gym.envs.tasks.navigation import TaskSet
from vssm_gym.eval.episodes.identity import Episode, episode_seed
from vssm_gym.eval.episodes.recorder import Wrap, unwrapped
from vssm_gym.eval.protocols.episode import Spectator, run_episode
from vssm_gym.eval.protocols.shared import (
    conditions,
    ensure_map,
    keep_or_write,
    load,
    load_map,
    notice,
    sampler_of,
    scene_names,
    tasks_in,
    world,
)
from vssm_gym.maps.voxel_map import VoxelMap

__all__ = ["conditions", "ensure_map", "load", "load_map", "notice", "run", "scene_names", "write_tasks"]


def write_tasks(apartment: Apartment, n: int, path: Path) -> None:
    """Write the first ``n`` test tasks of a scene to a file; keep a file that already holds them."""
    make = partial(navigation.task_set, apartment, HolonomicRobot(), "test", n)
    keep_or_write(apartment, n, path, navigation.load, make, navigation.save)


def run(
    episode: Episode,
    agent: Agent,
    task_file: Path,
    voxel_map: VoxelMap | None,
    spectator: Spectator | None = None,
    *,
    wrap: Wrap = unwrapped,
) -> dict[str, Any]:
    """Run one episode and return the measured fields of its row."""
    tasks = tasks_in(task_file, TaskSet)
    return run_episode(
        wrap(world(episode.condition, observe_pose=agent.needs_pose)),
        sampler_of(episode.condition.scene),
        agent,
        tasks.tasks[episode.task],
        seed=episode_seed(episode.seed, tasks.scene_hash, episode.task),
        voxel_map=voxel_map,
        noise=HOLONOMIC_NOISES[episode.condition.noise],
        spectator=spectator,
    )
