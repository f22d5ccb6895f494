"""Simulate a flying body: its command limits, its dynamics, and a controller that keeps it on a reference flight.

    v' = R (f + e_f) + g - drag v,    p' = v,    R' = R (w + e_w)^

The command ``(f, w)`` is a specific force (m/s^2) and an angular rate (rad/s) in the body's frame: the control that
the IMU-driven transition takes (:mod:`vssm_gym.model.transition.imu`), so that without drag and gusts a model of the
body is exact. ``e`` are gusts and the rotors' errors, an Ornstein-Uhlenbeck process. An IMU at the body's centre
measures ``(R^T (v' - g), w + e_w)``.

World frame, z up; body x forward, y left, z up.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from vssm_gym.envs.presets import Presets
from vssm_gym.envs.tasks.reference_flights import ReferenceFlight, attitude
from vssm_gym.errors import InputError
from vssm_gym.geometry.axes import Matrix4
from vssm_gym.geometry.gravity import GRAVITY
from vssm_gym.geometry.transforms import R_BODY_CAM


@dataclass(frozen=True)
class FlightBody:
    """Define a small multirotor: a ball for contacts, with camera and IMU at its centre; the camera looks along x."""

    radius: float = 0.25  # m
    drag: float = 0.3  # 1/s, of the rotors: proportional to speed (Faessler et al. 2018)
    max_push: tuple[float, float, float] = (9.81, 9.81, 19.62)  # m/s^2; |f_x|, |f_y|, 0 <= f_z
    max_rate: float = 6.0  # rad/s, of each component
    substep: float = 0.005  # s; the IMU reads once in each

    @property
    def limits(self) -> tuple[Float[np.ndarray, "6"], Float[np.ndarray, "6"]]:
        """Return the lowest and the highest command ``(f, w)``."""
        high = np.array([*self.max_push, *[self.max_rate] * 3])
        low = -high
        low[2] = 0.0
        return low, high

    @property
    def T_body_cam(self) -> Matrix4:
        """Return the constant transform from camera to body; float64 ``(4, 4)``."""
        T = np.eye(4)
        T[:3, :3] = R_BODY_CAM
        return T


@dataclass(frozen=True)
class FlightNoise:
    """Define gusts and actuator errors: standard deviations of a process with correlation time ``time``."""

    push: float  # m/s^2
    rate: float  # rad/s
    time: float = 0.3  # s

    def __post_init__(self) -> None:
        for field in ("push", "rate", "time"):
            value = getattr(self, field)
            if not (math.isfinite(value) and value >= 0.0) or (field == "time" and value == 0.0):
                raise InputError("FlightNoise", field, f"a finite number >= 0 (time: above 0), not {value!r}")

    def following(self, gust: Float[np.ndarray, "6"], dt: float, rng: np.random.Generator) -> Float[np.ndarray, "6"]:
        """Return the gust ``dt`` s after ``gust``; every call draws six normals."""
        keep = math.exp(-dt / self.time)
        std = np.repeat([self.push, self.rate], 3)
        return keep * gust + math.sqrt(1.0 - keep**2) * std * rng.standard_normal(6)


FLIGHT_NOISE: dict[str, FlightNoise] = {
    "none": FlightNoise(0.0, 0.0),
    "low": FlightNoise(0.2, 0.02),
    "mid": FlightNoise(0.5, 0.05),
    "high": FlightNoise(1.0, 0.10),
}


flight_noise = Presets("Flight", "noise", FlightNoise, FLIGHT_NOISE)


@dataclass(frozen=True)
class FlightState:
    """Hold pose and velocity of the body, world frame; float64."""

    position: Float[np.ndarray, "3"]  # m
    velocity: Float[np.ndarray, "3"]  # m/s
    R_world_body: Float[np.ndarray, "3 3"]

    @property
    def T_world_body(self) -> Matrix4:
        """Return the pose; float64 ``(4, 4)``."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.R_world_body, self.position
        return T


def fly(
    state: FlightState, command: Float[np.ndarray, "6"], gust: Float[np.ndarray, "6"], drag: float, h: float
) -> tuple[FlightState, Float[np.ndarray, "6"]]:
    """Integrate ``h`` seconds of free flight by the midpoint rule, with the IMU's exact reading halfway.

    Args:
        state: the state before.
        command: ``(f, w)``, body frame, within the limits.
        gust: disturbance added to the command.
        drag: 1/s.
        h: s; errors of position grow with its square, 5 ms give micrometres a second.

    Returns:
        The state after, and ``(specific force, rate)`` in the body's frame, m/s^2 and rad/s.
    """
    f, w = np.split(command + gust, 2)
    R = state.R_world_body
    R_mid, R_after = R @ rotation(0.5 * h * w), R @ rotation(h * w)
    v_mid = state.velocity + 0.5 * h * (R @ f + GRAVITY - drag * state.velocity)
    felt = R_mid @ f - drag * v_mid
    after = FlightState(state.position + h * v_mid, state.velocity + h * (felt + GRAVITY), R_after)
    return after, np.concatenate([R_mid.T @ felt, w])


def rotation(phi: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """``exp(phi^)``, Rodrigues' formula."""
    x, y, z = (float(v) for v in phi)
    angle2 = x * x + y * y + z * z
    angle = math.sqrt(angle2)
    # Series where the quotients lose their digits
    a = math.sin(angle) / angle if angle > 1e-4 else 1.0 - angle2 / 6.0
    b = (1.0 - math.cos(angle)) / angle2 if angle > 1e-4 else 0.5 - angle2 / 24.0
    W = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + a * W + b * (W @ W)


@dataclass(frozen=True)
class FlightController:
    """Follow a reference by geometric control: rotors push along body z, and rates turn z to the wanted direction.

        a = a_ref + k_p (p_ref - p) + k_v (v_ref - v),   f_z = |a - g + drag v|,   w = w_ref + k_R log(R^T R_wanted)

    Mellinger and Kumar, ICRA 2011.
    """

    body: FlightBody = FlightBody()
    position_gain: float = 6.0  # 1/s^2
    velocity_gain: float = 4.0  # 1/s
    attitude_gain: float = 10.0  # 1/s

    def __call__(self, state: FlightState, reference: ReferenceFlight, t: float, dt: float) -> Float[np.ndarray, "6"]:
        """Return the command for the ``dt`` seconds from ``t`` on, of a body at ``state``."""
        # The command is held: aim at the middle of the interval, towards which the body coasts.
        middle = np.array([t + 0.5 * dt])
        motion = reference.at(middle)
        p = state.position + 0.5 * dt * state.velocity
        wanted = motion.acceleration[0] + self.position_gain * (motion.position[0] - p)
        wanted = wanted + self.velocity_gain * (motion.velocity[0] - state.velocity)
        push = wanted + self.body.drag * state.velocity - GRAVITY
        heading = motion.R_world_body[0, :2, 0]
        R_wanted = attitude(push[None], heading[None])[0]
        error = Rotation.from_matrix(state.R_world_body.T @ R_wanted).as_rotvec()
        rate = reference.body_rates(middle)[0] + self.attitude_gain * error
        f_z = max(0.0, float(push @ state.R_world_body[:, 2]))
        low, high = self.body.limits
        return np.clip(np.concatenate([[0.0, 0.0, f_z], rate]), low, high)
