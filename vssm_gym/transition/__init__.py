"""Transitions ``p(z' | z, u)`` of the model: planar robot, rigid body, IMU-driven body, car (SPEC 1)."""

from vssm_gym.transition.base import Belief, Transition
from vssm_gym.transition.bicycle import Bicycle, BicycleNoise
from vssm_gym.transition.imu import Imu, ImuNoise
from vssm_gym.transition.planar import MotionNoise, Planar, PlanarBelief, planar_mean, planar_predict
from vssm_gym.transition.rigid import Rigid, RigidBelief, RigidNoise, RigidState

__all__ = [
    "Belief",
    "Bicycle",
    "BicycleNoise",
    "Imu",
    "ImuNoise",
    "MotionNoise",
    "Planar",
    "PlanarBelief",
    "Rigid",
    "RigidBelief",
    "RigidNoise",
    "RigidState",
    "Transition",
    "planar_mean",
    "planar_predict",
]
