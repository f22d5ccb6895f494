"""Define reference flights of a multirotor: closed smooth curves, flown from hover to hover (named after Blackbird's).

    x + i y = scale sum_k c_k e^{i k phi} e^{i turn},   z = height + FLIGHT_LIFT Re sum_k z_k e^{i k phi}
    phi' = Omega s(t / ramp)  from rest, Omega, and back to rest;   s(u) = 10 u^3 - 15 u^4 + 6 u^5

``Omega`` is such that the fastest point of the curve is passed at the flight's speed. Position, velocity, acceleration
and jerk are continuous. The attitude follows from them, since rotors push along the body's z only (Mellinger and Kumar,
"Minimum snap trajectory generation and control for quadrotors", ICRA 2011; drag after Faessler et al., RA-L 2018):

    R e_z ∝ a - g + drag v,    R e_x in the vertical plane of the heading

World frame, z up, metres, seconds, radians. Body x forward, y left, z up.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.scenes.scene import Apartment
from vssm_gym.errors import InputError, one_of
from vssm_gym.geometry.gravity import GRAVITY

Yaw = Literal["forward", "constant"]

FLIGHT_HEIGHT, FLIGHT_LIFT = 1.8, 0.6  # m: mean height of a flight, and by how much it rises and falls
FLIGHT_REACH = 5.0  # m, largest half-extent: Blackbird's room is 11 m wide
HOVER = 1.0  # s at rest before and after
RAMP = 3.0  # s from rest to full speed
CLEARANCE = 0.6  # m from the path to the nearest obstacle
_ORIENTATIONS, _SAMPLES = 12, 256  # orientations that are tried, points of the curve that are checked


@dataclass(frozen=True)
class FlightCurve:
    """Define a curve by Fourier coefficients: ``plane`` of x + iy, ``rise`` of z, both by frequency.

    Half-extent and rise are scaled to 1.
    """

    plane: Mapping[int, complex]
    rise: Mapping[int, complex]

    def derivative(self, phi: Float[np.ndarray, "n"], order: int) -> Float[np.ndarray, "n 3"]:
        """``d^order (x, y, z) / d phi^order``."""
        plane, rise = (
            np.sum([c * (1j * k) ** order * np.exp(1j * k * phi) for k, c in series.items()], axis=0)
            for series in (self.plane, self.rise)
        )
        return np.stack([plane.real, plane.imag, rise.real], axis=-1)


def _unit(plane: Mapping[int, complex], rise: Mapping[int, complex]) -> FlightCurve:
    samples = FlightCurve(plane, rise).derivative(np.linspace(0.0, 2.0 * np.pi, 4096), 0)
    across, up = np.linalg.norm(samples[:, :2], axis=1).max(), np.abs(samples[:, 2]).max()
    return FlightCurve({k: c / across for k, c in plane.items()}, {k: c / up for k, c in rise.items()})


CURVES = {
    # A five-pointed star drawn in one line that crosses itself: the hypotrochoid {5/2} with rounded points.
    "star": _unit({2: 1.0, -3: 0.3}, {3: 1.0}),
    # A line drawing without symmetry: loops of different sizes.
    "picasso": _unit({-2: 0.6, 1: 0.4 + 0.1j, -1: 0.3, 3: 0.05 - 0.04j}, {2: 1.0, 1: 0.6j}),
    # Gerono's lemniscate: x = sin(phi), y = sin(2 phi) / 2
    "figure8": _unit({1: -0.5j, -1: 0.5j, 2: 0.25, -2: -0.25}, {1: 1.0}),
    # The rose r = cos(2 phi): four leaves
    "clover": _unit({3: 0.5, -1: 0.5}, {2: 1.0}),
}


@dataclass(frozen=True)
class Placement:
    """Place a curve in a scene."""

    center: tuple[float, float]  # m
    scale: float  # m, half-extent
    turn: float  # rad


@dataclass(frozen=True)
class Motion:
    """Hold a body's motion at ``n`` times, world frame."""

    position: Float[np.ndarray, "n 3"]  # m
    velocity: Float[np.ndarray, "n 3"]  # m/s
    acceleration: Float[np.ndarray, "n 3"]  # m/s^2
    R_world_body: Float[np.ndarray, "n 3 3"]


@dataclass(frozen=True)
class ReferenceFlight:
    """Fly ``laps`` of a curve: a second of hover, a smooth start, full speed, a smooth stop at the start, hover.

    ``speed`` is the peak; ``drag`` (1/s) that of the body, which must lean against it. Raises :class:`InputError` for
    an unknown name or an invalid speed.
    """

    name: str  # a key of CURVES
    speed: float  # m/s
    place: Placement
    yaw: Yaw = "forward"  # nose along the motion, or always along the placement's turn
    laps: int = 1
    drag: float = 0.0  # 1/s
    rate: float = field(init=False)  # rad/s of phi at full speed
    ramp: float = field(init=False)  # s

    def __post_init__(self) -> None:
        for name, value, known in (("name", self.name, tuple(CURVES)), ("yaw", self.yaw, ("forward", "constant"))):
            if value not in known:
                raise InputError("reference flight", name, f"one of {', '.join(known)}; found {value!r}")
        if not 0.0 < self.speed <= 20.0:
            raise InputError("reference flight", "speed", f"metres a second in (0, 20], not {self.speed!r}")
        if not (isinstance(self.laps, int) and 1 <= self.laps <= 100):
            raise InputError("reference flight", "laps", f"1 to 100, not {self.laps!r}")
        fastest = np.linalg.norm(self._curve(np.linspace(0.0, 2.0 * np.pi, 4096), 1), axis=1).max()
        object.__setattr__(self, "rate", float(self.speed / fastest))
        # A ramp covers as much of phi as half of its time at full speed: both must fit.
        object.__setattr__(self, "ramp", min(RAMP, 2.0 * np.pi * self.laps / self.rate))

    @property
    def duration(self) -> float:
        """Return the seconds from the first moment of hover to the last."""
        return 2.0 * HOVER + 2.0 * np.pi * self.laps / self.rate + self.ramp

    def at(self, t: Float[np.ndarray, "n"]) -> Motion:
        """Return the motion at times ``t`` (s); before 0 and after ``duration`` it hovers."""
        t = np.atleast_1d(np.asarray(t, dtype=np.float64))
        phi, dphi, ddphi = self._phase(t)
        first, second = self._curve(phi, 1), self._curve(phi, 2)
        velocity = first * dphi[:, None]
        acceleration = second * dphi[:, None] ** 2 + first * ddphi[:, None]
        heading = first[:, :2] if self.yaw == "forward" else np.tile(_turned(self.place.turn), (len(t), 1))
        push = acceleration + self.drag * velocity - GRAVITY
        return Motion(self._curve(phi, 0), velocity, acceleration, attitude(push, heading))

    def body_rates(self, t: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
        """Return the angular velocity in the body's frame, rad/s: ``log(R(t - h)^T R(t + h)) / 2h``."""
        h = 1e-4
        before, after = (self.at(np.asarray(t, dtype=np.float64) + d).R_world_body for d in (-h, h))
        turn = np.swapaxes(before, -1, -2) @ after
        return Rotation.from_matrix(turn).as_rotvec() / (2.0 * h)

    def push(self) -> float:
        """Return the largest specific force that the flight demands of the rotors, m/s^2; hover demands 9.81."""
        motion = self.at(np.linspace(0.0, self.duration, 2048))
        push = motion.acceleration + self.drag * motion.velocity - GRAVITY
        return float(np.linalg.norm(push, axis=1).max())

    def _phase(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return phi and its first two derivatives; the stop is the start reversed."""
        end = self.duration - 2.0 * HOVER
        since = np.clip(t - HOVER, 0.0, end)
        back = since > 0.5 * end
        u = np.clip(np.where(back, end - since, since) / self.ramp, 0.0, None)
        rising = np.minimum(u, 1.0)
        covered = self.ramp * (rising**4 * (2.5 - 3.0 * rising + rising**2) + (u - rising))
        speed = rising**3 * (10.0 - 15.0 * rising + 6.0 * rising**2)
        change = 30.0 * rising**2 * (1.0 - rising) ** 2 / self.ramp
        phi = self.rate * np.where(back, end - self.ramp - covered, covered)
        return phi, self.rate * speed, self.rate * np.where(back, -change, change)

    def _curve(self, phi: np.ndarray, order: int) -> np.ndarray:
        points = CURVES[self.name].derivative(phi, order)
        c, s = _turned(self.place.turn)
        points = points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        points *= [self.place.scale, self.place.scale, FLIGHT_LIFT]
        return points + np.array([*self.place.center, FLIGHT_HEIGHT]) if order == 0 else points


def attitude(push: Float[np.ndarray, "n 3"], heading: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3 3"]:
    """Return ``R_world_body`` with z along ``push`` and x above or below ``heading``, neither of which is zero."""
    up = push / np.linalg.norm(push, axis=-1, keepdims=True)
    square = np.stack([-heading[:, 1], heading[:, 0], np.zeros(len(heading))], axis=-1)
    nose = np.cross(square, up)
    nose /= np.linalg.norm(nose, axis=-1, keepdims=True)
    return np.stack([nose, np.cross(up, nose), up], axis=-1)


def place(apartment: Apartment, name: str, clearance: float = CLEARANCE) -> Placement:
    """Return the largest placement of a curve, up to FLIGHT_REACH, that keeps ``clearance`` m around the body free.

    Placements are tried on a fixed grid; of those of the largest size the one farthest from everything is taken. Raises
    :class:`InputError` where the curve fits nowhere, or where the ceiling is too low.
    """
    if name not in CURVES:
        raise InputError("reference flight", "name", one_of(CURVES, name))
    top = FLIGHT_HEIGHT + FLIGHT_LIFT + clearance
    if apartment.ceiling_height < top:
        raise InputError(apartment.name, "ceiling_height", f"at least {top:.2f} m for a flight")
    space = FreeSpace.from_apartment(apartment, clearance, top)
    shape = CURVES[name].derivative(np.linspace(0.0, 2.0 * np.pi, _SAMPLES, endpoint=False), 0)[:, :2]
    low, high = np.split(np.array(space.region.bounds), 2)
    x, y = (np.linspace(a, b, max(2, int((b - a) / 0.5) + 1)) for a, b in zip(low, high, strict=True))
    centers = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    turns = 2.0 * np.pi * np.arange(_ORIENTATIONS) / _ORIENTATIONS
    rotated = np.stack([shape @ np.array([[c, s], [-s, c]]) for c, s in map(_turned, turns)])
    for scale in FLIGHT_REACH * 0.9 ** np.arange(16):
        candidates = [(i, j) for i in range(_ORIENTATIONS) for j in range(len(centers))]
        for every in (32, 8, 1):  # most are ruled out by a few of their points
            turn, center = np.array(candidates, dtype=int).reshape(-1, 2).T
            points = centers[center][:, None] + scale * rotated[turn][:, ::every]
            candidates = [candidates[k] for k in np.flatnonzero(np.all(space.contains(points), axis=1))]
        if candidates:
            room = [space.distance_to_obstacle(centers[j] + scale * rotated[i][::4]).min() for i, j in candidates]
            i, j = candidates[int(np.argmax(room))]
            return Placement((float(centers[j, 0]), float(centers[j, 1])), float(scale), float(turns[i]))
    raise InputError(apartment.name, "rooms", f"space for the flight {name!r} with {clearance} m around it")


def _turned(angle: float) -> Float[np.ndarray, "2"]:
    return np.array([np.cos(angle), np.sin(angle)])
