"""Define the robots on the floor: their dimensions, commands and execution noise.

There is one file for each robot and one row in :mod:`.registry`. The holonomic robot, the default, is exported here.
"""

from vssm_gym.envs.robots.biased_noise import BiasedExecutionNoise
from vssm_gym.envs.robots.holonomic import (
    DIRECTION_FRAMES,
    HOLONOMIC_NOISES,
    NOISE_LEVELS,
    ExecutionNoise,
    HolonomicNoise,
    HolonomicRobot,
    execute,
    execution_noise,
)

__all__ = [
    "DIRECTION_FRAMES",
    "HOLONOMIC_NOISES",
    "NOISE_LEVELS",
    "BiasedExecutionNoise",
    "ExecutionNoise",
    "HolonomicNoise",
    "HolonomicRobot",
    "execute",
    "execution_noise",
]
