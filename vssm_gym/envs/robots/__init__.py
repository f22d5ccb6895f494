"""Define the robots on the floor: measures, commands and how a noisy body executes them. One file a robot, one row each
in :mod:`.registry`; the holonomic one, which most of the project is about, is offered here.
"""

from vssm_gym.envs.robots.holonomic import NOISE_LEVELS, ExecutionNoise, HolonomicRobot, execute, execution_noise

__all__ = ["NOISE_LEVELS", "ExecutionNoise", "HolonomicRobot", "execute", "execution_noise"]
