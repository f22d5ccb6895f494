"""Run Explore in a sweep: starts, the environment, and navigation on the map of a run.

Start ``i`` is that of PointNav's test task ``i`` of the scene, so that both share one frozen, hashed file.
"""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from vssm_gym.agents.base import Agent
from vssm_gym.agents.navigation.astar import AStarAgent
from vssm_gym.envs.robots import HOLONOMIC_NOISES
from vssm_gym.envs.scenes.scene import Apartment
from vssm_gym.envs.tasks.navigation import TaskSet
from vssm_gym.eval.episodes.identity import Episode, ExploreSettings, episode_seed
from vssm_gym.eval.episodes.recorder import Wrap, unwrapped
from vssm_gym.eval.protocols import pointnav
from vssm_gym.eval.protocols.episode import run_episode as run_navigation
from vssm_gym.eval.protocols.explore_episode import Spectator, map_of, run_episode
from vssm_gym.eval.protocols.shared import (
    conditions,
    ensure_map,
    load,
    load_map,
    notice,
    sampler_of,
    scene_names,
    tasks_in,
    world,
)
from vssm_gym.maps.voxel_map import VoxelMap

__all__ = ["conditions", "ensure_map", "load", "load_map", "navigate", "notice", "run", "scene_names", "write_tasks"]

POINTNAV = "vssm_gym/PointNav-v0"
LEAST_TASKS = 40  # in a scene's file, so that there are tasks to navigate besides the starts


def write_tasks(apartment: Apartment, n: int, path: Path) -> None:
    """Write the first test tasks of a scene, at least ``n``, to a file; keep a file that already holds them."""
    pointnav.write_tasks(apartment, max(n, LEAST_TASKS), path)


def run(
    episode: Episode,
    agent: Agent,
    task_file: Path,
    voxel_map: VoxelMap | None,
    spectator: Spectator | None = None,
    *,
    wrap: Wrap = unwrapped,
) -> dict[str, Any]:
    """Run one episode and the navigation on its map; return the measured fields of its row."""
    tasks, settings = tasks_in(task_file, TaskSet), episode.explore or ExploreSettings()
    env = world(
        episode.condition,
        observe_pose=agent.needs_pose,
        finish=2.0,  # never: only the agent or the time limit ends a run
        max_episode_steps=settings.steps,
    )
    start = np.array(tasks.tasks[episode.task].start)
    seed = episode_seed(episode.seed, tasks.scene_hash, episode.task)
    row = run_episode(wrap(env), agent, start, seed=seed, spectator=spectator)
    explored = map_of(agent)
    if settings.navigation and explored is not None:
        row["navigation"] = navigate(episode, tasks, explored, settings.navigation)
    return row


def navigate(episode: Episode, tasks: TaskSet, explored: VoxelMap, n: int) -> dict[str, Any]:
    """Drive ``n`` of the scene's PointNav tasks with ``astar`` on an explorer's map.

    They are the ``n`` tasks after that of the run's start, so that all agents have the same tasks.

    Returns:
        ``tasks`` (how many), ``success`` and ``spl`` (means), ``failures`` (reasons).
    """
    chosen = [tasks.tasks[(episode.task + 1 + k) % len(tasks.tasks)] for k in range(n)]
    rows = [
        run_navigation(
            world(episode.condition, POINTNAV),
            sampler_of(episode.condition.scene),
            _navigator(),
            task,
            seed=episode_seed(episode.seed, tasks.scene_hash, task.id),
            voxel_map=explored,
            noise=HOLONOMIC_NOISES[episode.condition.noise],
        )
        for task in chosen
    ]
    return {
        "tasks": n,
        "success": float(np.mean([row["success"] for row in rows])),
        "spl": float(np.mean([row["spl"] for row in rows])),
        "failures": [row["failure"] for row in rows if row["failure"]],
    }


@cache
def _navigator() -> Agent:
    return AStarAgent()
