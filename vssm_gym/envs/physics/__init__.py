"""All that uses MuJoCo: :mod:`physics` moves robots on the floor, :mod:`flight_world` a body in the air and :mod:`car`
a car on its wheels through contacts, :mod:`gl` draws with MuJoCo's renderer, :mod:`static_geoms` compiles the models
that people bring.

No module outside this folder imports MuJoCo.
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
