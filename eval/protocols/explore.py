"""Explore in a sweep: its starts, its environment, and navigation on the map that a run leaves.

Start ``i`` is that of PointNav's test task ``i`` of the scene, so that both share one frozen, hashed file.
"""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from vssm_gym.agents.base import Agent
from vssm_gym.agents.navigation.astar import AStarAgent
from vssm_gym.envs.robots import NOISE_LEVELS
from vssm_gym.envs.scenes.scene import Apartment
from vssm_gym.envs.tasks.navigation import TaskSet
from vssm_gym.eval.episodes.identity import Episode, ExploreSettings, episode_seed
from vssm_gym.eval.protocols import episode as pointnav
from vssm_gym.eval.protocols import pointnav as pointnav_protocol
from vssm_gym.eval.protocols.explore_episode import Spectator, map_of, run_episode
from vssm_gym.eval.protocols.shared import conditions, load, notice, sampler_of, scene_names, tasks_in, world
from vssm_gym.maps.voxel_map import VoxelMap

__all__ = ["conditions", "load", "navigate", "notice", "run", "scene_names", "write_tasks"]

POINTNAV = "vssm_gym/PointNav-v0"
LEAST_TASKS = 40  # of a scene's file, so that there are some to navigate beside the starts


def write_tasks(apartment: Apartment, n: int, path: Path) -> None:
    """The first test tasks of a scene, at least ``n``, as a file; one that is there and holds them is kept."""
    pointnav_protocol.write_tasks(apartment, max(n, LEAST_TASKS), path)


def run(
    episode: Episode,
    agent: Agent,
    task_file: Path,
    voxel_map: VoxelMap | None,
    spectator: Spectator | None = None,
) -> dict[str, Any]:
    """Run one episode and what is driven on its map; returns what it was worth."""
    tasks, settings = tasks_in(task_file, TaskSet), episode.explore or ExploreSettings()
    env = world(
        episode.condition,
        observe_pose=agent.needs_pose,
        finish=2.0,  # never: only the agent or the time limit ends a run
        max_episode_steps=settings.steps,
    )
    start = np.array(tasks.tasks[episode.task].start)
    seed = episode_seed(episode.seed, tasks.scene_hash, episode.task)
    row = run_episode(env, agent, start, seed=seed, spectator=spectator)
    explored = map_of(agent)
    if settings.navigation and explored is not None:
        row["navigation"] = navigate(episode, tasks, explored, settings.navigation)
    return row


def navigate(episode: Episode, tasks: TaskSet, explored: VoxelMap, n: int) -> dict[str, Any]:
    """Drive ``n`` of the scene's PointNav tasks with ``astar`` on a map that an explorer left.

    They are the ``n`` tasks after the one whose start the run had, so that all agents meet the same ones.

    Returns:
        ``tasks`` (how many), ``success`` and ``spl`` (means), ``failures`` (reasons).
    """
    chosen = [tasks.tasks[(episode.task + 1 + k) % len(tasks.tasks)] for k in range(n)]
    noise = NOISE_LEVELS[episode.condition.noise]
    rows = [
        pointnav.run_episode(
            world(episode.condition, POINTNAV),
            sampler_of(episode.condition.scene),
            _navigator(),
            task,
            seed=episode_seed(episode.seed, tasks.scene_hash, task.id),
            voxel_map=explored,
            noise=(noise.turn, noise.step),
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
