"""Run LidarMaze in a sweep: the mazes' own frozen tasks, the environment, and single episodes."""

from collections.abc import Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from vssm_gym.agents.base import Agent
from vssm_gym.envs.lidar_maze import LONGEST_RANGE
from vssm_gym.envs.maze_noise import MOTION_NOISE, RANGE_NOISE
from vssm_gym.envs.scenes.scene import Apartment
from vssm_gym.envs.tasks import navigation
from vssm_gym.envs.tasks.mazes import MAZES, ROBOT, Maze, load_maze
from vssm_gym.envs.tasks.navigation import TaskSet
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.identity import Episode, episode_seed
from vssm_gym.eval.episodes.recorder import Wrap, unwrapped
from vssm_gym.eval.protocols.agent_context import SCANNER_COMMANDS
from vssm_gym.eval.protocols.episode import run_episode
from vssm_gym.eval.protocols.exact_scans import ExactScans
from vssm_gym.eval.protocols.maze_map import LearnedMaze, ensure_map, load_map
from vssm_gym.eval.protocols.shared import keep_or_write, made, tasks_in
from vssm_gym.model.scan_model import ScanModel
from vssm_gym.model.scanner import Scanner

__all__ = ["conditions", "ensure_map", "load", "load_map", "notice", "run", "scene_names", "write_tasks"]

TRUE_BEAMS = 64  # of the environment's scanner, which the true map's is


def scene_names() -> Sequence[str]:
    """Return the names of the built-in mazes."""
    return MAZES


def conditions() -> Mapping[str, Sequence[str]]:
    """Return the names that a configuration may hold; ranges are always ray-cast."""
    own = {"robot": ("disc",), "renderer": ("raycast",), "direction_frame": ("body",)}
    return {"noise": tuple(MOTION_NOISE), "sensor_noise": tuple(RANGE_NOISE), **own}


def load(scene: str) -> Apartment:
    """Load the maze of a built-in name or of a file."""
    return load_maze(scene).apartment


def notice(apartment: Apartment) -> str:
    """Return an empty notice: a faulty maze is refused when it is loaded."""
    return ""


def write_tasks(apartment: Apartment, n: int, path: Path) -> None:
    """Write the first ``n`` of a maze's tasks to a file; raise :class:`InputError` where the maze has fewer."""
    keep_or_write(apartment, n, path, navigation.load, partial(_first, apartment, n), navigation.save)


def run(
    episode: Episode, agent: Agent, task_file: Path, learned: LearnedMaze | None, *, wrap: Wrap = unwrapped
) -> dict[str, Any]:
    """Run one episode and return the measured fields of its row; a bound is given the true map."""
    c, tasks = episode.condition, tasks_in(task_file, TaskSet)
    by_scan = getattr(agent, "goal_by_scan", False)
    goal = {"goal": "scan" if by_scan else "position", "end_on": getattr(agent, "end_on", "stop")}
    model: ScanModel | None = None if learned is None else learned.model
    if getattr(agent, "needs_true_map", False):
        model = _true_map(c.scene)
    elif getattr(agent, "needs_latent_map", False) and learned is not None:
        model = learned.latent(_maze(c.scene))
    env = made(c.env, scene=c.scene, noise=c.noise, sensor_noise=c.sensor_noise, observe_pose=agent.needs_pose, **goal)
    return run_episode(
        wrap(env),
        _maze(c.scene).sampler,
        agent,
        tasks.tasks[episode.task],
        seed=episode_seed(episode.seed, tasks.scene_hash, episode.task),
        voxel_map=None,
        noise=MOTION_NOISE[c.noise],
        limits=ROBOT.limits[list(SCANNER_COMMANDS)],
        scan_model=model,
        scan_encoder=learned.encoder if by_scan and learned is not None else None,
    )


def _first(apartment: Apartment, n: int) -> TaskSet:
    tasks = load_maze(apartment).tasks
    if n > len(tasks.tasks):
        raise InputError(apartment.name, "tasks", f"numbers below {len(tasks.tasks)}, as many as the maze has")
    first = tasks.model_copy(update={"tasks": tasks.tasks[:n], "hash": ""})
    return first.model_copy(update={"hash": first.content_hash()})


@lru_cache(maxsize=1)
def _true_map(scene: str) -> ExactScans:
    angles = 2.0 * np.pi * np.arange(TRUE_BEAMS) / TRUE_BEAMS
    scanner = Scanner(jnp.asarray(angles, jnp.float32), jnp.zeros(3), jnp.float32(LONGEST_RANGE))
    return ExactScans(jnp.asarray(_maze(scene).rectangles), scanner)


@lru_cache(maxsize=1)
def _maze(scene: str) -> Maze:
    return load_maze(scene)
