"""Define the robots on the floor: their dimensions, commands and execution noise.

There is one file for each robot and one row in :mod:`.registry`. The holonomic robot, the default, is exported here.
"""

from vssm_gym.envs.robots.holonomic import NOISE_LEVELS, ExecutionNoise, HolonomicRobot, execute, execution_noise

__all__ = ["NOISE_LEVELS", "ExecutionNoise", "HolonomicRobot", "execute", "execution_noise"]
