"""What a simulated car is to its environment, and what both simulators know of it.

A body gets set points of its wheels (:class:`~vssm_gym.envs.robots.car_noise.CarActuators`) and says where that leads.
"""

import math
from typing import Protocol

import numpy as np
from jaxtyping import Float

from vssm_gym.geometry.axes import PlanarPose
from vssm_gym.geometry.car import Car

PHYSICS = ("mujoco", "bullet")
CLEARANCE = 0.02  # m from the floor to the chassis
CHASSIS_MASS, WHEEL_MASS = 2.3, 0.1  # kg, 2.7 in all: the QCar's
PUSH = 4.0  # m/s^2, at which the motors at full torque accelerate the car; tyres of friction 1 transmit it
BUMPER = 0.2  # friction of the chassis on obstacles


class CarBody(Protocol):
    """A car among a scene's boxes."""

    reads_contacts: bool  # whether contacts are kept for :meth:`contact_bearings`

    def reset(self, planar: PlanarPose) -> None:
        """Put the rear axle at ``(x, y, heading)``, m and rad, at rest."""

    def drive(self, points: Float[np.ndarray, "ticks 2"], friction: float) -> tuple[str, ...]:
        """Follow set points of the wheels and name what the chassis touched meanwhile.

        Args:
            points: ``(speed m/s, steering rad)``, one a :data:`~vssm_gym.envs.robots.car_noise.TICK`; steering is that
            of the
                wheel in the middle of the front axle that there is not.
            friction: coefficient of tyres on the floor.

        Returns:
            Names of the obstacles touched, each once, in the order of the apartment's boxes; tyres touch floor only.
        """

    def contact_bearings(self) -> Float[np.ndarray, "n"]:
        """Directions in which obstacles pressed against the chassis during the last :meth:`drive`, rad.

        Against the contact's normal, from the car to the obstacle, counter-clockwise from body x; one a contact and
        substep, none where nothing was touched.
        """

    def pose(self) -> PlanarPose:
        """The rear axle's ``(x, y, heading)``, m and rad, heading in [-pi, pi); float64 ``(3,)``."""

    def speed(self) -> float:
        """Of the rear axle along the heading, m/s."""

    def upright(self) -> bool:
        """Whether its wheels can carry it: tilted by less than 45 degrees, and on the floor."""

    def close(self) -> None:
        """Let go of what the simulator holds."""


def ackermann(steering: float, car: Car) -> tuple[float, float]:
    """``atan(L k / (1 -+ k W / 2))``, ``k = tan(steering) / L``: angles of the left and the right front wheel, rad.

    ``L`` is the wheelbase and ``W`` the track; ``steering`` is the angle of the wheel in the middle that there is not.
    """
    tangent = math.tan(steering)
    inward = 0.5 * car.track * tangent / car.wheelbase
    return math.atan2(tangent, 1.0 - inward), math.atan2(tangent, 1.0 + inward)
