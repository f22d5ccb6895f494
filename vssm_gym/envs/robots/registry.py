"""List the robots that ``robot="name"`` chooses on PointNav, ImageNav and Explore."""

from collections.abc import Callable
from functools import partial

from vssm_gym.envs.robots.base import Robot
from vssm_gym.envs.robots.differential import DifferentialRobot
from vssm_gym.envs.robots.drive_response import WORN
from vssm_gym.envs.robots.holonomic import HolonomicRobot

ROBOTS: dict[str, Callable[[], Robot]] = {
    "holonomic": HolonomicRobot,
    "worn": partial(HolonomicRobot, response=WORN),
    "differential": DifferentialRobot,
}
# Those that take the commands of the holonomic robot: its agents and its surveys drive them
HOLONOMIC_ROBOTS = ("holonomic", "worn")
