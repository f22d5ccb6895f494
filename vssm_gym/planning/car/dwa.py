"""Control a car by the dynamic window approach: the best command that it can reach within one step (eq. P16).

    max over (v, s) in window   progress (h(0) - min h) / reach + clear (free / reach - tight)
                                + speed |v| / max_speed - cusp [gear changes]
    subject to                  |v| <= sqrt(2 braking free),   |v| <= sqrt(2 braking d(0))

A steering held for ``reach`` metres drives an arc, of which ``free`` metres are free (exact rectangles) and
``tight`` is the share that keeps less than the margin of comfort (Fox, Burgard and Thrun, "The dynamic window approach
to collision avoidance", IEEE RAM 4, 1997). ``h = d + across |sin(heading - downhill)|`` is the distance to the goal
around obstacles for a point, and how far the car stands across the path there; either end may lead.

The method's weakness remains, local minima: one arc is evaluated, so a manoeuvre that must first drive away from
the goal, such as parking sideways or turning in a dead end, is not found, and the heading at the goal is left open.
Where no arc makes progress the car backs up along a free arc, each time further until it has come nearer to the goal
than ever before; that leaves many such places and not all.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from vssm_gym.errors import InputError
from vssm_gym.geometry.arc import pose_after, turn_of
from vssm_gym.geometry.car import Car
from vssm_gym.planning.car.footprint_levels import COLLIDING, TIGHT, FootprintLevels, level_at
from vssm_gym.planning.grid_search.goal_distance import goal_distance
from vssm_gym.planning.result import Outcome

_PART = 0.02  # m of an arc between two tests for collision: less than a cell of the table


@dataclass(frozen=True)
class DwaConfig:
    """Configure the window, the weights of the objective, and the recovery.

    Args:
        reach: length of an arc, m.
        across: cost of standing square to the path, m.
        acceleration: of the window, m/s^2.
        steering_rate: of the window, rad/s.
        braking: deceleration by which the car can stop in free space, m/s^2.
        speeds: samples across the window.
        steerings: samples across the window.
        progress: weight of coming nearer to the goal.
        clear: weight of the free length, less the share that is tight.
        speed: weight of the speed, as a share of the car's greatest.
        cusp: cost of changing gear.
        tolerance: distance to the goal at which the car stops, m.
        stuck: progress below which an arc counts as blocked, m.
        nearer: distance by which the car must come nearer to the goal than ever before, m.
        recovery_speed: of backing up, m/s.
        recovery_steps: steps for which the car backs up the first time.
        recovery_growth: times as far as that it backs up at most.
        escape_length: distance that may be driven to come free from a collision, m.
    """

    reach: float = 1.2
    across: float = 0.3
    acceleration: float = 1.5
    steering_rate: float = 6.0
    braking: float = 0.6
    speeds: int = 11
    steerings: int = 15
    progress: float = 1.0
    clear: float = 0.15
    speed: float = 0.1
    cusp: float = 0.25
    tolerance: float = 0.05
    stuck: float = 0.02
    nearer: float = 0.1
    recovery_speed: float = 0.25
    recovery_steps: int = 10
    recovery_growth: int = 4
    escape_length: float = 0.1


class DwaStatus(Outcome):
    """Name what the controller is doing; the value is the message that reports print."""

    DRIVING = "driving towards the goal"
    RECOVERING = "backing up: no command makes progress"
    BLOCKED = "standing: every command would collide"
    NO_PATH = "standing: no path leads to the goal"
    ARRIVED = "at the goal"


@dataclass(frozen=True)
class DwaState:
    """Hold what the next step needs of this one, and the decision.

    Attributes:
        control: ``(speed, steering)`` commanded last, m/s and rad.
        status: what the controller was doing.
        recovering: steps for which it continues to back up.
        gear: 1.0 or -1.0, the last direction it drove in.
        nearest: least distance to the goal so far, m.
        attempts: times it backed up since then.
    """

    control: np.ndarray
    status: DwaStatus = DwaStatus.DRIVING
    recovering: int = 0
    gear: float = 1.0
    nearest: float = math.inf
    attempts: int = 0


class DynamicWindow:
    """Control the car to one goal ``(2,)`` among fixed obstacles."""

    def __init__(self, obstacles: FootprintLevels, car: Car, goal: np.ndarray, config: DwaConfig | None = None) -> None:
        self.goal = np.asarray(goal, dtype=np.float64)
        if self.goal.shape != (2,) or not np.isfinite(self.goal).all():
            raise InputError("DynamicWindow", "goal", f"two finite coordinates; found {goal!r:.80}")
        self.obstacles, self.car, self.config = obstacles, car, config or DwaConfig()
        gx, gy = (float(v) for v in (self.goal - obstacles.origin) / obstacles.resolution)
        passable = np.asarray((obstacles.levels < COLLIDING).any(axis=2))
        distance = goal_distance(passable, gx, gy) * np.float32(obstacles.resolution)
        reached = np.isfinite(distance)
        self.cut_off = passable & ~reached  # places that the car fits into and from which no path leads to the goal
        # Where no path leads lies above all else, but finite: places next to it are interpolated with it.
        top = distance[reached].max() if reached.any() else 0.0
        self.distance = np.where(reached, distance, np.float32(top + 1.0))
        slope_x, slope_y = np.gradient(self.distance)
        self.downhill = np.arctan2(-slope_y, -slope_x)  # direction of the path to the goal, rad

    def init(self) -> DwaState:
        """Return the state of a standing car with straight wheels."""
        return DwaState(np.zeros(2))

    def step(self, state: DwaState, planar: np.ndarray) -> DwaState:
        """Return the next command of a car at the pose ``planar`` ``(3,)``, in the ``control`` of the new state."""
        car, c, planar = self.car, self.config, np.asarray(planar, dtype=np.float64)
        away = math.hypot(*(self.goal - planar[:2]))
        if away <= c.tolerance:
            return replace(state, control=np.zeros(2), status=DwaStatus.ARRIVED, recovering=0)
        cell = np.floor((planar[:2] - self.obstacles.origin) / self.obstacles.resolution + 0.5).astype(int)
        cell = np.clip(cell, 0, np.array(self.cut_off.shape) - 1)
        if self.cut_off[cell[0], cell[1]]:
            return replace(state, control=np.zeros(2), status=DwaStatus.NO_PATH, recovering=0)
        here = float(_height(self.obstacles.lookup, self.distance, self.downhill, c.across, *planar)[0])
        if here < state.nearest - c.nearer:
            state = replace(state, nearest=here, attempts=0)
        v0, s0 = (float(v) for v in car.clip(state.control))
        steerings = _window(s0, c.steering_rate * car.dt, car.max_steering, c.steerings)
        if state.recovering > 0:
            return self._back_up(state, planar, steerings)
        speeds = _window(v0, c.acceleration * car.dt, car.max_speed, c.speeds)
        best, control = -math.inf, None
        for gear in (1.0, -1.0):
            driven = speeds[speeds * gear > 1e-6]
            if len(driven) == 0:
                continue
            progress, tight, free = self._arcs(planar, steerings, gear)
            value = c.progress * progress / c.reach + c.clear * (free / c.reach - tight)
            value = value - (c.cusp if gear != state.gear else 0.0)
            score = value[:, None] + c.speed * np.abs(driven) / car.max_speed
            stop = np.sqrt(2.0 * c.braking * np.minimum(free, max(away, c.tolerance)))
            score[(np.abs(driven) > stop[:, None]) | (progress < c.stuck)[:, None]] = -np.inf
            row, column = np.unravel_index(int(np.argmax(score)), score.shape)
            if score[row, column] > best:
                best, control = float(score[row, column]), np.array([driven[column], steerings[row]])
        if control is None:
            steps = c.recovery_steps * (1 + state.attempts % c.recovery_growth)
            stuck = replace(state, recovering=steps, gear=-state.gear, attempts=state.attempts + 1)
            return self._back_up(stuck, planar, steerings)
        gear = 1.0 if control[0] > 0.0 else -1.0
        return replace(state, control=control, status=DwaStatus.DRIVING, recovering=0, gear=gear)

    def _back_up(self, state: DwaState, planar: np.ndarray, steerings: np.ndarray) -> DwaState:
        """Drive a free arc against the gear in which the car got stuck; where there is none, in the other one."""
        c = self.config
        left = c.recovery_speed * self.car.dt * max(1, state.recovering)
        side = 1.0 if state.attempts % 2 else -1.0
        for gear in (state.gear, -state.gear):
            _, _, free = self._arcs(planar, steerings, gear, c.escape_length)
            # Of arcs that are free far enough the one most to one side, each time the other: it turns the car.
            row = int(np.argmax(np.minimum(free, left) + 0.02 * side * steerings))
            if free[row] > c.recovery_speed * self.car.dt + _PART:
                control = np.array([gear * c.recovery_speed, steerings[row]])
                recovering = state.recovering - 1
                return replace(state, control=control, status=DwaStatus.RECOVERING, recovering=recovering, gear=gear)
        return replace(state, control=np.zeros(2), status=DwaStatus.BLOCKED, recovering=0)

    def _arcs(
        self, planar: np.ndarray, steerings: np.ndarray, gear: float, escape: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Evaluate the arc of each steering: progress (m), tight share and free length (m), all ``(n,)``."""
        curvatures = turn_of(1.0, steerings, self.car.wheelbase)
        count = math.ceil(self.config.reach / _PART)
        fields = self.obstacles.lookup, self.distance, self.downhill, self.config.across
        return _follow_arcs(*fields, planar, curvatures, gear, count, escape)


def _window(middle: float, reach: float, limit: float, count: int) -> np.ndarray:
    """Return evenly spread values within the window and the limits, with the middle and, if inside, zero."""
    low, high = max(-limit, middle - reach), min(limit, middle + reach)
    values = np.append(np.linspace(low, high, count), middle)
    return np.unique(np.append(values, 0.0) if low <= 0.0 <= high else values)


@njit(cache=True, nogil=True)
def _height(lookup, distance, downhill, across, x, y, heading):
    """Return the bilinear distance to the goal (m) and ``h``; infinite beyond the grid."""
    u, w = (x - lookup.x) / lookup.resolution, (y - lookup.y) / lookup.resolution
    if not (0.0 <= u < distance.shape[0] - 1 and 0.0 <= w < distance.shape[1] - 1):
        return np.inf, np.inf
    i, j = int(u), int(w)
    a, b = u - i, w - j
    low = (1.0 - b) * distance[i, j] + b * distance[i, j + 1]
    high = (1.0 - b) * distance[i + 1, j] + b * distance[i + 1, j + 1]
    d = (1.0 - a) * low + a * high
    return d, d + across * abs(math.sin(heading - downhill[int(u + 0.5), int(w + 0.5)]))


@njit(cache=True, nogil=True)
def _follow_arcs(lookup, distance, downhill, across, planar, curvatures, gear, count, escape):
    """Follow arcs as `_arcs` asks; an arc ends where the rectangle collides. Progress is at its best place."""
    n = curvatures.shape[0]
    progress, tight, free = np.zeros(n), np.zeros(n), np.zeros(n)
    _, start = _height(lookup, distance, downhill, across, planar[0], planar[1], planar[2])
    touching = level_at(lookup, planar[0], planar[1], planar[2]) == COLLIDING
    for k in range(n):
        x, y, heading = planar[0], planar[1], planar[2]
        turn = gear * _PART * curvatures[k]
        least, narrow, leaving = np.inf, 0, touching
        for i in range(count):
            x, y, heading = pose_after(x, y, heading, gear * _PART, turn)
            level = level_at(lookup, x, y, heading)
            if level == COLLIDING and not (leaving and i * _PART < escape):
                break
            leaving = leaving and level == COLLIDING
            free[k] += _PART
            narrow += level == TIGHT
            least = min(least, _height(lookup, distance, downhill, across, x, y, heading)[1])
        if leaving:  # it never came free
            free[k] = 0.0
            continue
        progress[k] = start - least if np.isfinite(least) else 0.0
        tight[k] = narrow * _PART / max(free[k], _PART)
    return progress, tight, free
