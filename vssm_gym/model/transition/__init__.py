"""Define transitions ``p(z' | z, u)`` of robots, rigid bodies, IMUs, cars, and learned ones; beliefs over states."""

from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import Belief, GaussianBelief
from vssm_gym.model.transition.biased_noise import BiasedNoise
from vssm_gym.model.transition.bicycle import Bicycle, BicycleNoise
from vssm_gym.model.transition.differential import DifferentialDrive, DifferentialNoise
from vssm_gym.model.transition.imu import Imu, ImuNoise
from vssm_gym.model.transition.learned import LearnedTransition
from vssm_gym.model.transition.manifold import PLANAR, RIGID, Manifold, RigidState
from vssm_gym.model.transition.motion_noise import MotionNoise
from vssm_gym.model.transition.planar import Planar, planar_belief, world_covariance
from vssm_gym.model.transition.rigid import Rigid, RigidNoise, rigid_belief

__all__ = [
    "PLANAR",
    "RIGID",
    "Belief",
    "BiasedNoise",
    "Bicycle",
    "BicycleNoise",
    "DifferentialDrive",
    "DifferentialNoise",
    "GaussianBelief",
    "Imu",
    "ImuNoise",
    "LearnedTransition",
    "Manifold",
    "MotionNoise",
    "Planar",
    "Rigid",
    "RigidNoise",
    "RigidState",
    "Transition",
    "planar_belief",
    "rigid_belief",
    "world_covariance",
]
