"""List the robots that ``robot="name"`` chooses on PointNav, ImageNav and Explore."""

from vssm_gym.envs.robots.base import Robot
from vssm_gym.envs.robots.differential import DifferentialRobot
from vssm_gym.envs.robots.holonomic import HolonomicRobot

ROBOTS: dict[str, type[Robot]] = {
    "holonomic": HolonomicRobot,
    "differential": DifferentialRobot,
}
