"""Make a maze, a task in it and episodes of random actions, for the tests of LidarMaze."""

import gymnasium as gym
import numpy as np

from vssm_gym.envs.lidar_maze import LONGEST_RANGE, LidarMazeEnv
from vssm_gym.envs.sensors.lidar import LidarConfig
from vssm_gym.envs.tasks.mazes import load_maze

ID = "vssm_gym:vssm_gym/LidarMaze-v0"
LIDAR = LidarConfig(max_range=LONGEST_RANGE)
MAZE = load_maze("rooms-v1")
TASK = MAZE.sampler.task((0.1, 0.1, 0.0), (0.3, 0.1))


def make(**keywords) -> LidarMazeEnv:
    return LidarMazeEnv(**{"scene": MAZE.apartment, "noise": "none", "tasks": MAZE.tasks, **keywords})


def act(turn=0.0, step=0.0, stop=0.0) -> np.ndarray:
    return np.array([turn, step, stop], dtype=np.float32)


def random_actions(env: gym.Env, n: int, seed: int = 0) -> np.ndarray:
    """Draw actions without a stop."""
    rng = np.random.default_rng(seed)
    low, high = env.action_space.low, env.action_space.high
    return (rng.uniform(low, high, (n, 3)) * [1.0, 1.0, 0.0]).astype(np.float32)


def rollout(env: gym.Env, seed: int, steps: int = 12) -> bytes:
    """Return all outputs of the environment in an episode of random actions."""
    observation, info = env.reset(seed=seed)
    parts = []
    for action in random_actions(env, steps):
        parts += [observation[key].tobytes() for key in sorted(observation)]
        parts += [np.asarray(info[key]).tobytes() for key in ("pose", "collision", "control")]
        observation, reward, terminated, truncated, info = env.step(action)
        parts.append(repr((reward, terminated, truncated)).encode())
    return b"".join(parts)
