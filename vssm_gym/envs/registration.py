"""Gymnasium registration of every environment id."""

import gymnasium as gym

POINTNAV_STEPS = 500  # a default of 80 m at full speed; `gym.make(..., max_episode_steps=N)` overrides it
LIDAR_MAZE_STEPS = 1000  # 20 m at full speed, in mazes whose longest way is 4 m


def register() -> None:
    """Register the environments; calling it twice changes nothing."""
    if "vssm_gym/PointNav-v0" not in gym.registry:
        gym.register(
            id="vssm_gym/PointNav-v0",
            entry_point="vssm_gym.envs.pointnav:PointNavEnv",
            max_episode_steps=POINTNAV_STEPS,
        )
    if "vssm_gym/LidarMaze-v0" not in gym.registry:
        gym.register(
            id="vssm_gym/LidarMaze-v0",
            entry_point="vssm_gym.envs.lidar_maze:LidarMazeEnv",
            max_episode_steps=LIDAR_MAZE_STEPS,
        )
