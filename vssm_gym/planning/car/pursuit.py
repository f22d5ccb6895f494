"""Follow a drive with a car: pure pursuit of the rear axle, forwards and backwards, one gear at a time.

    steering = atan(wheelbase (k + p(planar) - p(drive))),   p(pose) = 2 y / (x^2 + y^2)

``p`` is the curvature of the arc from the rear axle through ``(x, y)``, a place of the drive ``look_ahead`` metres
ahead in the pose's own frame (Coulter, "Implementation of the pure pursuit path tracking algorithm", CMU-RI-TR-92-01,
1992); it holds in both gears. Alone it cuts bends: a car exactly on the drive would be sent off it. So only the
difference to its value at the nearest pose of the drive corrects ``k``, the drive's own curvature. Beyond a cusp or
the goal the aim lies on the tangent there, so that the car arrives with the heading of the drive; the speed is what
``braking`` can still stop before it, ``v = sqrt(2 braking left)``.
"""

import math
from dataclasses import dataclass

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.geometry.car import Car
from vssm_gym.geometry.transforms import wrap_angle

_NEARBY = 0.5  # m of the drive, from the last progress on, in which the nearest place is searched


@dataclass(frozen=True)
class PursuitConfig:
    """Configure how a drive is followed.

    Args:
        look_ahead: distance along the drive to the place that is driven at, m.
        braking: deceleration before a cusp and the goal, and acceleration behind a cusp, m/s^2.
        crawl: least speed short of a cusp, m/s: slower a real car does not start to roll.
        setting_off: first command of each gear's piece, m/s.
        arrived: distance along the drive from a cusp or the goal at which it counts as reached, m.
        bend: share of the speed that is given up at full lock.
        preview: time that the wheels need to turn, s.
    """

    look_ahead: float = 0.25
    braking: float = 0.4
    crawl: float = 0.06
    setting_off: float = 0.15
    arrived: float = 0.02
    bend: float = 0.4
    preview: float = 0.1


@dataclass(frozen=True)
class PursuitCommand:
    """Hold the command, and how far the car is from the drive.

    Attributes:
        control: ``(speed, steering)``, m/s and rad; zeros once done.
        progress: m of the drive that lie behind; give it to the next call.
        deviation: m from the rear axle to the drive.
        heading_error: of the car from the drive's heading, rad, left positive.
        done: whether the end of the drive is reached.
    """

    control: np.ndarray
    progress: float
    deviation: float
    heading_error: float
    done: bool


class CarPath:
    """Prepare a drive for following: poses, gears and the length driven up to each pose."""

    def __init__(self, poses: np.ndarray, gears: np.ndarray, config: PursuitConfig | None = None) -> None:
        """Take poses ``(n, 3)`` at most a few centimetres apart and gears ``(n,)``, as a ``CarPlan`` holds them."""
        self.poses, self.gears = np.asarray(poses, dtype=np.float64), np.asarray(gears)
        self.config = config or PursuitConfig()
        if self.poses.ndim != 2 or self.poses.shape[1:] != (3,) or len(self.poses) == 0:
            raise InputError("CarPath", "poses", f"shape (n, 3) with n > 0; found {self.poses.shape}")
        if self.gears.shape != self.poses.shape[:1] or not np.isin(self.gears, (-1, 1)).all():
            raise InputError("CarPath", "gears", "1 or -1 for each pose")
        hops = np.hypot(*np.diff(self.poses[:, :2], axis=0).T)
        self.along = np.concatenate([[0.0], np.cumsum(hops)])
        self._headings = np.unwrap(self.poses[:, 2])
        bends = self.gears[1:] * np.diff(self._headings) / np.maximum(hops, 1e-9)
        self._bends = np.append(np.where(hops > 1e-6, bends, 0.0), 0.0)  # curvature from each pose to the next, 1/m
        ends = np.flatnonzero(self.gears[1:-1] != self.gears[2:]) + 1
        self._ends = np.array([*ends, len(self.poses) - 1])  # poses at which the car stops: cusps, then the goal

    @property
    def length(self) -> float:
        """Return the length of the whole drive, m."""
        return float(self.along[-1])

    def follow(self, planar: np.ndarray, progress: float, car: Car) -> PursuitCommand:
        """Return the command of a car at the pose ``planar`` ``(3,)`` that has come so far (m; 0 at first).

        Progress never falls, and passes a cusp only when the car has ``arrived`` there or is beyond, so that where the
        drive crosses itself, or goes back over its own track, no piece of it is left out.
        """
        c = self.config
        k = int(np.searchsorted(self.along[self._ends], progress + 1e-9))
        if k == len(self._ends):
            return self._report(planar, progress, np.zeros(2), done=True)
        first, last = (int(self._ends[k - 1]) if k else 0), int(self._ends[k])
        progress, left = self._project(planar, progress, first, last)
        if left < c.arrived:
            progress = float(self.along[last])
            if last == len(self.poses) - 1:
                return self._report(planar, progress, np.zeros(2), done=True)
            return self.follow(planar, progress, car)
        gear = float(self.gears[last])
        aim = self._aim(progress, last, gear)
        correction = self._pursuit(planar, aim) - self._pursuit(self._at(progress), aim)
        # The wheels need a moment to turn, so the bend ahead of the car counts.
        soon = min(progress + c.preview * car.max_speed, float(self.along[last]) - 1e-6)
        bend = self._bends[int(np.searchsorted(self.along, soon, side="right")) - 1]
        steering = math.atan(car.wheelbase * (bend + correction))
        steering = max(-car.max_steering, min(car.max_steering, steering))
        # From a cusp on the wheels turn while the car gathers speed.
        driven = progress - float(self.along[first])
        speed = math.sqrt(c.setting_off**2 + 2.0 * c.braking * driven)
        # The length of the coming step is not available for braking.
        speed = min(speed, math.sqrt((c.braking * car.dt) ** 2 + 2.0 * c.braking * left) - c.braking * car.dt)
        speed = min(speed, car.max_speed * (1.0 - c.bend * abs(steering) / car.max_steering))
        speed = max(speed, min(c.crawl, left / car.dt))
        return self._report(planar, progress, np.array([gear * speed, steering]), done=False)

    def _project(self, planar: np.ndarray, progress: float, first: int, last: int) -> tuple[float, float]:
        """Return the progress at the nearest place of the current gear's piece, and the m of it that are left."""
        near = slice(
            max(first, int(np.searchsorted(self.along, progress, side="right")) - 1),
            min(last, int(np.searchsorted(self.along, progress + _NEARBY))) + 1,
        )
        points, along = self.poses[near, :2], self.along[near]
        a, edge = points[:-1], np.diff(points, axis=0)
        share = np.sum((planar[:2] - a) * edge, axis=1) / np.maximum(np.sum(edge**2, axis=1), 1e-12)
        share = np.clip(share, 0.0, 1.0)
        nearest = int(np.argmin(np.hypot(*(a + share[:, None] * edge - planar[:2]).T)))
        here = float(along[nearest] + share[nearest] * (along[nearest + 1] - along[nearest]))
        progress = max(progress, here)
        left = float(self.along[last]) - progress
        look_ahead = self.config.look_ahead
        if left < look_ahead:
            # Near the end the car may be beside it, or past it: what counts is how far it lies ahead.
            x, y, heading = self.poses[last]
            ahead = math.cos(heading) * (x - planar[0]) + math.sin(heading) * (y - planar[1])
            left = min(left, max(0.0, float(self.gears[last]) * ahead)) if left < 0.5 * look_ahead else left
        return progress, left

    def _at(self, progress: float) -> np.ndarray:
        """Return the pose ``(3,)`` of the drive at ``progress``."""
        columns = (self.poses[:, 0], self.poses[:, 1], self._headings)
        return np.array([np.interp(progress, self.along, column) for column in columns])

    def _aim(self, progress: float, last: int, gear: float) -> np.ndarray:
        """Return the point to drive at, ``(2,)``: on the drive, or on the tangent at the end of the gear's piece."""
        aim, end = progress + self.config.look_ahead, float(self.along[last])
        if aim <= end:
            return self._at(aim)[:2]
        x, y, heading = self.poses[last]
        beyond = gear * (aim - end)
        return np.array([x + beyond * math.cos(heading), y + beyond * math.sin(heading)])

    def _report(self, planar: np.ndarray, progress: float, control: np.ndarray, done: bool) -> PursuitCommand:
        x, y, heading = self._at(progress)
        deviation = math.hypot(planar[0] - x, planar[1] - y)
        return PursuitCommand(control, progress, deviation, float(wrap_angle(np.asarray(planar[2] - heading))), done)

    def _pursuit(self, planar: np.ndarray, aim: np.ndarray) -> float:
        """Return the curvature (1/m, left positive) of the arc from a pose ``(3,)``, along its heading, to ``aim``."""
        dx, dy, c, s = aim[0] - planar[0], aim[1] - planar[1], math.cos(planar[2]), math.sin(planar[2])
        forward, left = c * dx + s * dy, c * dy - s * dx
        return 2.0 * left / max(forward**2 + left**2, (0.5 * self.config.look_ahead) ** 2)
