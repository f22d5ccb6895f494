"""Gymnasium registration of every environment id."""

import gymnasium as gym

# Id -> module, class, steps after which an episode is truncated (`gym.make(..., max_episode_steps=N)` overrides); None
# where it ends by itself.
ENVIRONMENTS: dict[str, tuple[str, str, int | None]] = {
    "vssm_gym/PointNav-v0": ("pointnav", "PointNavEnv", 500),  # 80 m at full speed
    "vssm_gym/ImageNav-v0": ("imagenav", "ImageNavEnv", 500),
    "vssm_gym/Explore-v0": ("explore", "ExploreEnv", 2000),  # 320 m at full speed
    "vssm_gym/LidarMaze-v0": ("lidar_maze", "LidarMazeEnv", 1000),  # 20 m at full speed; the longest way is 4 m
    "vssm_gym/Flight-v0": ("flight", "FlightEnv", None),  # with its reference, after 600 s at most
    "vssm_gym/CarNav-v0": ("carnav", "CarNavEnv", 600),  # 60 s
}
# Imagined: it takes a map instead of a scene, and its vector environment is one compiled step.
WORLD_MODEL = "vssm_gym/WorldModelNav-v0"


def register() -> None:
    """Register the environments; calling it twice changes nothing."""
    for name, (module, cls, steps) in ENVIRONMENTS.items():
        if name not in gym.registry:
            gym.register(
                id=name,
                entry_point=f"vssm_gym.envs.{module}:{cls}",
                vector_entry_point=f"vssm_gym.envs.vector:{module}",
                max_episode_steps=steps,
            )
    if WORLD_MODEL not in gym.registry:
        gym.register(
            id=WORLD_MODEL,
            entry_point="vssm_gym.envs.world_model.single:WorldModelNavEnv",
            vector_entry_point="vssm_gym.envs.world_model.vector:WorldModelVectorEnv",
            max_episode_steps=500,
        )
