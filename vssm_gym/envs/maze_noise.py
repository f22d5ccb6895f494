"""Define the noise levels of a maze's robot, scanner and camera.

Motion errs by the law of :func:`vssm_gym.envs.robots.execute`, ranges by that of :mod:`vssm_gym.envs.sensors.lidar`,
here with a standard deviation that does not grow with the range: that Gaussian is the emission of the spatial model
DVBF-LM.
"""

import math

from vssm_gym.envs.presets import Presets
from vssm_gym.envs.robots import ExecutionNoise
from vssm_gym.envs.sensors.lidar import LidarNoise
from vssm_gym.envs.sensors.maze_strip import StripNoise

# low: dead reckoning errs by 0.14 after 3000 steps, as path integration does in DVBF-LM (0.14 +- 0.1); high: the low
# level of TNP-SM, 3 degrees and 10 % of a body length a step, with which dead reckoning is lost after 500.
MOTION_NOISE: dict[str, ExecutionNoise] = {
    "none": ExecutionNoise(0.0, 0.0),
    "low": ExecutionNoise(math.radians(0.35), 0.0005),
    "mid": ExecutionNoise(math.radians(1.0), 0.001),
    "high": ExecutionNoise(math.radians(3.0), 0.0025),
}


# In a maze of the unit square: up to the robot's own diameter, and every twentieth reading missing.
RANGE_NOISE: dict[str, LidarNoise] = {
    "none": LidarNoise(),
    "low": LidarNoise(floor=0.005),
    "mid": LidarNoise(floor=0.01, dropout=0.01),
    "high": LidarNoise(floor=0.025, dropout=0.05),
}

# Of each byte of a column: low is that of a good camera by day, high that of a cheap one in the evening.
STRIP_NOISE: dict[str, StripNoise] = {
    "none": StripNoise(),
    "low": StripNoise(std=2.0),
    "mid": StripNoise(std=5.0),
    "high": StripNoise(std=12.0),
}


motion_noise = Presets("environment", "noise", ExecutionNoise, MOTION_NOISE)


range_noise = Presets("environment", "sensor_noise", LidarNoise, RANGE_NOISE)


strip_noise = Presets("environment", "sensor_noise", StripNoise, STRIP_NOISE)
