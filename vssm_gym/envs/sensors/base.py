"""Define the sensor protocol, and the true state of a robot that sensors may read.

    observation = union over sensors of measure(body)        body: the robot's true state

An environment holds a list of sensors (:class:`~vssm_gym.envs.sensors.suite.SensorSuite`), whose measurements are its
observation. Each draws its noise from a stream of its own, so that adding or removing one changes no byte of the
others.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, TypeVar

import gymnasium as gym
import numpy as np
from jaxtyping import Float

from vssm_gym.envs.sensors.shared_renderer import SharedRenderer
from vssm_gym.geometry.axes import Matrix4, PlanarPose
from vssm_gym.geometry.transforms import planar_to_matrix

NO_CONTACTS = np.zeros(0)  # no contact

Body = TypeVar("Body", contravariant=True)


class Sensor(Protocol[Body]):
    """Measure the true state of one robot, mounted in one scene; ``Body`` is the kind of state that it reads."""

    @property
    def spaces(self) -> Mapping[str, gym.Space[Any]]:
        """Return the keys that it adds to the observation, and their spaces."""

    @property
    def stream(self) -> str:
        """Return the name of its stream of random numbers (:mod:`vssm_gym.envs.streams`)."""

    @property
    def parallel(self) -> bool:
        """Return True if sensors of several robots may measure at once, in threads of one process."""

    @property
    def reads_contacts(self) -> bool:
        """Return True if it reads the body's contacts, which the simulator keeps only then."""

    def seed(self, rng: np.random.Generator) -> None:
        """Restart the sensor with this stream of random numbers, as a seeded reset does."""

    def begin(self, body: Body) -> None:
        """Start an episode with the robot as it is; without a seed the stream continues."""

    def measure(self, body: Body) -> dict[str, np.ndarray]:
        """Measure once, after every motion; return an array of its space for each key."""


class SensorConfig(Protocol):
    """Configure a sensor of a robot on the ground: a frozen dataclass whose class is a row of the registry.

    Every field has a default.
    """

    def mount(self, renderer: SharedRenderer) -> "Sensor[GroundBody]":
        """Build the sensor in a scene."""


class GroundBody(NamedTuple):
    """Hold the true state of a robot on the floor at one moment.

    It is ground truth: sensors read it, agents never do.
    """

    planar: PlanarPose  # (x, y, heading), m and rad, world
    T_world_body: Matrix4  # on the floor
    T_world_cam: Matrix4
    dt: float  # s since the measurement before
    contacts: Float[np.ndarray, "n"]  # bearings of the last step's obstacles in contact, rad, if read

    @classmethod
    def at(
        cls, planar: PlanarPose, T_body_cam: Matrix4, dt: float, contacts: Float[np.ndarray, "n"] = NO_CONTACTS
    ) -> "GroundBody":
        """Return the state of a robot with a camera at ``T_body_cam``."""
        T_world_body = planar_to_matrix(planar)
        return cls(planar, T_world_body, T_world_body @ T_body_cam, dt, contacts)


class HasPlanar(Protocol):
    """Have a pose on the floor."""

    @property
    def planar(self) -> PlanarPose:
        """Return ``(x, y, heading)``, m and rad, world frame."""


class HasPose(Protocol):
    """Have a pose in space."""

    @property
    def T_world_body(self) -> Matrix4:
        """Return the pose of the body."""


class HasCamera(Protocol):
    """Carry a camera."""

    @property
    def T_world_cam(self) -> Matrix4:
        """Return the pose of the camera."""

    @property
    def dt(self) -> float:
        """Return the seconds since the previous measurement."""
