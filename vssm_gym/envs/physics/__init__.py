"""Simulate motion with contacts, in MuJoCo and PyBullet, and trace rays.

:mod:`floor_world` moves robots on the floor, :mod:`flight_world` a body in the air, :mod:`mujoco_car` and
:mod:`bullet_car` a car on its wheels; :mod:`gl_camera` draws with MuJoCo's renderer and :mod:`static_geoms` compiles
imported models. No module outside this folder imports MuJoCo, PyBullet or Embree.
"""

from vssm_gym.envs.physics.flight_world import FlightWorld, build_flight_spec
from vssm_gym.envs.physics.floor_world import FloorWorld, build_floor_spec, obstacles
from vssm_gym.envs.physics.mujoco_car import MujocoCar, build_car_spec
from vssm_gym.envs.physics.static_geoms import StaticGeom, static_geoms

__all__ = [
    "FlightWorld",
    "FloorWorld",
    "MujocoCar",
    "StaticGeom",
    "build_car_spec",
    "build_flight_spec",
    "build_floor_spec",
    "obstacles",
    "static_geoms",
]
