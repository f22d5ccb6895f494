"""Define the protocol of a simulated car, and the dimensions and masses that both simulators share.

A body follows set points of its wheels (:class:`~vssm_gym.envs.robots.car_noise.CarActuators`).
"""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float

from vssm_gym.geometry.axes import PlanarPose
from vssm_gym.geometry.car import Car

PHYSICS = ("mujoco", "bullet")
TYRES, BODY = 1, 2  # collision bits of both simulators: tyres with the floor, the chassis with obstacles


@dataclass(frozen=True)
class CarDynamics:
    """Define the masses, forces and time step of the car that both simulators share, after the Quanser QCar."""

    clearance: float = 0.02  # m, from the floor to the chassis
    chassis_mass: float = 2.3  # kg; 2.7 with the wheels, as the QCar's
    wheel_mass: float = 0.1  # kg, of each
    max_acceleration: float = 4.0  # m/s^2, of the motors at full torque; tyres of friction 1 transmit it
    bumper_friction: float = 0.2  # of the chassis on obstacles
    substep: float = 0.005  # s, of the simulation

    @property
    def mass(self) -> float:
        """Return the mass of the car with its four wheels, kg."""
        return self.chassis_mass + 4.0 * self.wheel_mass


DYNAMICS = CarDynamics()


class CarBody(Protocol):
    """Simulate a car among a scene's boxes."""

    reads_contacts: bool  # keep contacts for :meth:`contact_bearings`

    def reset(self, planar: PlanarPose) -> None:
        """Place the rear axle at ``(x, y, heading)``, m and rad, at rest."""

    def drive(self, points: Float[np.ndarray, "ticks 2"], friction: float) -> tuple[str, ...]:
        """Follow set points of the wheels, and return the obstacles that the chassis hit.

        Args:
            points: ``(speed m/s, steering rad)``, one for each :data:`~vssm_gym.envs.robots.car_noise.TICK`; steering
                is that of a virtual wheel in the middle of the front axle.
            friction: coefficient of tyres on the floor.

        Returns:
            Names of the obstacles hit, each once, in the order of the apartment's boxes; tyres collide with the floor
            only.
        """

    def contact_bearings(self) -> Float[np.ndarray, "n"]:
        """Return the directions of the obstacles in contact during the last :meth:`drive`, rad, from body x.

        There is one direction for each contact and substep, counter-clockwise, from the car to the obstacle, against
        the contact's normal.
        """

    def pose(self) -> PlanarPose:
        """Return the rear axle's ``(x, y, heading)``, m and rad, heading in [-pi, pi); float64 ``(3,)``."""

    def speed(self) -> float:
        """Return the speed of the rear axle along the heading, m/s."""

    def upright(self) -> bool:
        """Return True if the car can drive: its tilt is below 45 degrees and it is on the floor."""

    def close(self) -> None:
        """Free the simulator's resources."""


def ackermann(steering: float, car: Car) -> tuple[float, float]:
    """``atan(L k / (1 -+ k W / 2))``, ``k = tan(steering) / L``: angles of the left and the right front wheel, rad.

    ``L`` is the wheelbase, ``W`` the track and ``steering`` the angle of a virtual wheel in the middle of the front
    axle.
    """
    tangent = math.tan(steering)
    inward = 0.5 * car.track * tangent / car.wheelbase
    return math.atan2(tangent, 1.0 - inward), math.atan2(tangent, 1.0 + inward)
