"""Define the robot car's geometry, limits and camera pose, which simulators, planners and agents share (thesis, 5.6.1).

The body frame is on the floor below the middle of the rear axle, x forward, y left. These are the nominal values; the
simulators add their own execution errors.
"""

import math
from dataclasses import dataclass, fields

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.geometry.axes import Matrix4
from vssm_gym.geometry.transforms import R_BODY_CAM

# m and rad from a target within which it counts as reached: CarNav's success, and the goal of value iteration.
GOAL_RADIUS, GOAL_HEADING_TOLERANCE = 0.10, math.radians(15.0)


@dataclass(frozen=True)
class Car:
    """Describe a 1:10 car with Ackermann steering, after the Quanser QCar (39 x 19 cm, +-30 deg).

    One command ``(speed, steering)`` lasts ``dt``: m/s, negative backwards, and rad, left positive.
    """

    wheelbase: float = 0.26  # m, between the axles
    track: float = 0.17  # m, between the wheels of an axle
    wheel_radius: float = 0.033  # m
    length: float = 0.39  # m, bumper to bumper
    width: float = 0.19  # m
    height: float = 0.18  # m, top of the body
    rear_overhang: float = 0.065  # m, from the rear axle to the rear bumper
    camera_forward: float = 0.24  # m, from the rear axle to the camera
    camera_height: float = 0.17  # m above the floor
    max_speed: float = 0.6  # m/s, forwards and backwards
    max_steering: float = math.radians(30.0)  # rad
    max_acceleration: float = 2.0  # m/s^2, that may be commanded; the motors have more
    dt: float = 0.1  # s

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (isinstance(value, int | float) and math.isfinite(value) and value > 0.0):
                raise InputError("Car", field.name, f"a positive number; found {value!r:.80}")
        if self.max_steering >= 0.5 * math.pi:
            raise InputError("Car", "max_steering", f"an angle below pi / 2 rad; found {self.max_steering!r}")
        if self.rear_overhang + self.wheelbase > self.length:
            raise InputError("Car", "length", "at least rear_overhang + wheelbase: the axles are under the body")

    @property
    def turning_radius(self) -> float:
        """Return the turning radius of the rear axle at full lock, m."""
        return self.wheelbase / math.tan(self.max_steering)

    @property
    def limits(self) -> np.ndarray:
        """Return ``(max_speed, max_steering)``, m/s and rad; float64 ``(2,)``."""
        return np.array([self.max_speed, self.max_steering])

    @property
    def center_forward(self) -> float:
        """Return the distance from the rear axle to the middle of the footprint, m."""
        return 0.5 * self.length - self.rear_overhang

    @property
    def T_body_cam(self) -> Matrix4:
        """Return the constant transform from camera frame to body frame; float64 ``(4, 4)``."""
        T = np.eye(4)
        T[:3, :3] = R_BODY_CAM
        T[:3, 3] = self.camera_forward, 0.0, self.camera_height
        return T

    def corners(self, planar: np.ndarray) -> np.ndarray:
        """Return footprint corners ``(..., 4, 2)``, m, of poses ``(..., 3)``; counter-clockwise from the rear right."""
        planar = np.asarray(planar, dtype=np.float64)
        rear, front, half = -self.rear_overhang, self.length - self.rear_overhang, 0.5 * self.width
        x, y = np.array([rear, front, front, rear]), np.array([-half, -half, half, half])
        c, s = np.cos(planar[..., 2, None]), np.sin(planar[..., 2, None])
        return planar[..., None, :2] + np.stack([c * x - s * y, s * x + c * y], axis=-1)

    def clip(self, command: np.ndarray) -> np.ndarray:
        """Return the nearest command within the limits, per component: ``(speed, steering)`` float64 ``(2,)``."""
        return np.clip(np.asarray(command, dtype=np.float64), -self.limits, self.limits)
