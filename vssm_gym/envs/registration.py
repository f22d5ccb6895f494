"""Gymnasium registration of every environment id."""

import gymnasium as gym

POINTNAV_STEPS = 500  # a default of 80 m at full speed; `gym.make(..., max_episode_steps=N)` overrides it
FLIGHT_STEPS = 2000  # 100 s: the longest flight at 1 m/s takes 76


def register() -> None:
    """Register the environments; calling it twice changes nothing."""
    if "vssm_gym/PointNav-v0" not in gym.registry:
        gym.register(
            id="vssm_gym/PointNav-v0",
            entry_point="vssm_gym.envs.pointnav:PointNavEnv",
            max_episode_steps=POINTNAV_STEPS,
        )
    if "vssm_gym/Flight-v0" not in gym.registry:
        gym.register(
            id="vssm_gym/Flight-v0", entry_point="vssm_gym.envs.flight:FlightEnv", max_episode_steps=FLIGHT_STEPS
        )
