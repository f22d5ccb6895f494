"""Decide when a car brakes at its target and when it stops there, by its belief (CarNav-v1).

    miss(z) = max((|xy - goal| + n sigma_xy) / R,  (|heading - goal| + n sigma_heading) / H)

``R`` and ``H`` are the radius and the heading tolerance of the target's region, ``sigma`` the standard deviations of
the belief, zero where the pose is observed, and ``n = 2.5``: a belief with ``miss <= 1`` is inside with 98.8 % a
coordinate. A stop counts only where the car stands, so it brakes first. It brakes where the pose at which it will come
to rest is well inside, or inside and no longer coming closer; once it stands inside, it stops.
"""

from dataclasses import dataclass
from enum import Enum

import numpy as np

from vssm_gym.agents.shared.localization import Localization
from vssm_gym.geometry.arc import poses_after, turn_of
from vssm_gym.geometry.car import GOAL_HEADING_TOLERANCE, GOAL_RADIUS, Car
from vssm_gym.geometry.transforms import wrap_angle


class Parking(Enum):
    """Enumerate what a car does about its target; the value is the line that its status shows."""

    DRIVE = "drives"
    BRAKE = "brakes at the target"
    STOP = "parked at the target"
    TRUST = "parked at the target as far as it knows"  # by the mean alone, after a long wait


@dataclass(frozen=True)
class ParkingConfig:
    """Configure what counts as certain, close and standing.

    Args:
        deviations: standard deviations of the belief that have to lie within the target's region.
        inner: miss up to which the car brakes at once; farther out only where it no longer comes closer.
        still: motion in a step up to which it stands, m.
        longest: steps of braking after which it stands whatever the estimates say.
        patience: steps in a row with the mean in the region, after which the mean suffices: a belief that is wider than
            the region would otherwise wait until the time is out.
    """

    deviations: float = 2.5
    inner: float = 0.6
    still: float = 0.004
    longest: int = 10
    patience: int = 50


def braking(command: np.ndarray, car: Car) -> np.ndarray:
    """Return the command after ``command`` (speed m/s, steering rad) that slows down at the car's acceleration.

    A sudden command to stand would say less of how far the car still rolls: its servos lag.
    """
    most = car.max_acceleration * car.dt
    return np.array([command[0] - np.clip(command[0], -most, most), command[1]])


class ParkingRule:
    """Follow one car to one target; see the module."""

    def __init__(self, car: Car, goal: np.ndarray, config: ParkingConfig | None = None) -> None:
        self._car, self._goal, self._config = car, np.asarray(goal, np.float64), config or ParkingConfig()
        self._braked = self._inside = 0  # steps in a row that it has braked, and that its mean was in the region
        self._before: np.ndarray | None = None
        self._nearest = np.inf  # miss of the pose of rest in the step before

    @property
    def waits(self) -> bool:
        """Return True where the mean is in the target's region: the car stands there until its belief is as narrow."""
        return self._inside > 0

    def step(self, at: Localization, command: np.ndarray) -> Parking:
        """Return what to do at a believed estimate, after ``command`` (speed m/s, steering rad) brought the car there.

        An estimate that is not believed does not come here: a lost car stops nowhere.
        """
        c = self._config
        moved = np.inf if self._before is None else float(np.hypot(*(at.planar[:2] - self._before[:2])))
        self._before = at.planar.copy()
        self._inside = self._inside + 1 if self.miss(at.planar, at, 0.0) <= 1.0 else 0
        deviations = 0.0 if self._inside > c.patience else c.deviations
        rest = self.miss(self._rest(at.planar, command), at, deviations)
        closer, self._nearest = rest < self._nearest, rest
        halted = self._braked > 0 and float(command[0]) == 0.0
        stands = halted and (moved <= c.still or self._braked >= c.longest)
        if stands and self.miss(at.planar, at, deviations) <= 1.0:
            return Parking.STOP if deviations else Parking.TRUST
        brakes = rest <= c.inner or (rest <= 1.0 and not closer) or (rest <= 1.0 and self._braked > 0)
        self._braked = self._braked + 1 if brakes and not stands else 0
        return Parking.BRAKE if self._braked else Parking.DRIVE

    def miss(self, planar: np.ndarray, at: Localization, deviations: float) -> float:
        """Return how far a pose lies from the target with the uncertainty of ``at``; up to 1 inside the region."""
        xy = turn = 0.0
        if at.covariance is not None:
            xy = float(np.sqrt(max(0.0, np.linalg.eigvalsh(at.covariance[:2, :2])[-1])))
            turn = float(np.sqrt(max(0.0, at.covariance[2, 2])))
        away = float(np.hypot(*(planar[:2] - self._goal[:2])))
        position = (away + deviations * xy) / GOAL_RADIUS
        if len(self._goal) == 2:
            return position
        off = abs(float(wrap_angle(planar[2] - self._goal[2])))
        return max(position, (off + deviations * turn) / GOAL_HEADING_TOLERANCE)

    def _rest(self, planar: np.ndarray, command: np.ndarray) -> np.ndarray:
        """Return where a car that drives ``command`` comes to rest if it brakes now at the acceleration it may use."""
        speed, steering = (float(v) for v in command)
        s = np.sign(speed) * speed**2 / (2.0 * self._car.max_acceleration)
        return poses_after(planar[2], np.array(s), turn_of(s, steering, self._car.wheelbase), planar[0], planar[1])
