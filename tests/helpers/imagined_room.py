"""Make the small furnished room of the imagined robots' tests, its map, and environments in it."""

from functools import cache
from typing import Any

import gymnasium as gym
import numpy as np
import shapely

import vssm_gym  # noqa: F401  (registers the environments)
from tests.helpers.planning_worlds import voxel_map
from vssm_gym.envs.tasks.navigation import Task
from vssm_gym.maps.voxel_map import VoxelMap

ID = "vssm_gym/WorldModelNav-v0"
FLOOR = shapely.box(0.0, 0.0, 5.0, 3.0)
CUPBOARD = shapely.box(2.2, 1.9, 2.8, 3.0)
TABLE = shapely.box(3.6, 0.0, 4.4, 0.6)
SMALL: dict[str, Any] = {"pool": 64, "goals": 4}


@cache
def room() -> VoxelMap:
    """Return a room with a cupboard of half its height and a table lower than the camera."""
    return voxel_map(FLOOR, [(CUPBOARD, 0.0, 1.2), (TABLE, 0.0, 0.3)])


@cache
def half_seen() -> VoxelMap:
    """Return the room's map, unobserved beyond x = 3.2 except for a strip along y < 1."""
    return voxel_map(FLOOR, [(CUPBOARD, 0.0, 1.2)], lambda x, y, z: (x < 3.2) | (y < 1.0) | (z < -1.0))


def task(start: tuple[float, float, float], goal: tuple[float, float]) -> Task:
    """Return a task of this room."""
    return Task(id=0, scene="room", start=start, goal=goal, geodesic=0.0)


def make(m: VoxelMap | None = None, **keywords: Any) -> gym.Env:
    """Make one robot."""
    return gym.make(ID, map=room() if m is None else m, **SMALL | keywords)


def make_vec(n: int, m: VoxelMap | None = None, **keywords: Any) -> Any:
    """Make many robots."""
    return gym.make_vec(ID, num_envs=n, map=room() if m is None else m, **SMALL | keywords)


def random_actions(env: Any, seed: int, steps: int) -> np.ndarray:
    """Draw float32 actions ``(steps, ...)`` without a stop."""
    rng = np.random.default_rng(seed)
    actions = rng.uniform(env.action_space.low, env.action_space.high, (steps, *env.action_space.shape))
    if actions.shape[-1] == 4:
        actions[..., 3] = 0.0
    return actions.astype(np.float32)
