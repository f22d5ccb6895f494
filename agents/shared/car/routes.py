"""Drive down a cost-to-go: the route of its best motions, and the way out of poses from which it knows none."""

from typing import Any

import numpy as np

from vssm_gym.agents.shared.car.looking import SEEN_MARGIN, between
from vssm_gym.agents.shared.car.plan_window import PlanWindow
from vssm_gym.geometry.arc import poses_after, turn_of
from vssm_gym.geometry.car import Car
from vssm_gym.planning.value_iteration import CostToGo

ROUTE_MOTIONS = 120  # of the route at most: 16 m


def descend(value: CostToGo, planar: Any, car: Car) -> np.ndarray:
    """Return the poses ``(n, 3)`` along the best motions of a cost-to-go, up to the target or a minimum."""
    steering = np.linspace(-car.max_steering, car.max_steering, 5)
    length: Any = value.motion_length * np.repeat([1.0, -1.0], len(steering))
    turn = turn_of(length, np.tile(steering, 2), car.wheelbase)
    route, cost = [np.asarray(planar, np.float64)], float(value.at(planar))
    for _ in range(ROUTE_MOTIONS):
        here: Any = np.broadcast_to(route[-1], (len(length), 3))
        ends: Any = poses_after(here[:, 2], length, turn, here[:, 0], here[:, 1])
        costs, share = np.asarray(value.at(ends)), value.gamma ** np.asarray(value.counted(here, length))
        best = int(((1.0 - share) * value.never + share * costs).argmin())
        if cost <= 0.0 or costs[best] >= cost:
            break
        route.append(ends[best])
        cost = float(costs[best])
    return np.array(route)


def way_out(value: CostToGo, planar: np.ndarray, car: Car, window: PlanWindow, dared: np.ndarray) -> np.ndarray | None:
    """Return a short arc ``(2, 3)`` to the best pose around one from which the cost-to-go knows no motion.

    Its margin or an error of the map may block where the car stands. The arc meets nothing more than the car does
    there. Where no pose around has a path either, the best is the one with the most room. None without such an arc.

    Args:
        value: the cost-to-go.
        planar: the pose, m and rad.
        car: that drives.
        window: the newest plan.
        dared: its unseen cells that the car may drive onto, bool.
    """
    steering = np.linspace(-car.max_steering, car.max_steering, 5)
    shares = np.array([0.3, 0.6, 1.0, -0.3, -0.6, -1.0])  # of a motion
    length: Any = np.repeat(value.motion_length * shares, len(steering))
    turn = turn_of(length, np.tile(steering, len(shares)), car.wheelbase)
    ends: Any = poses_after(planar[2], length, turn, planar[0], planar[1])
    kept_off = window.occupied | (window.unseen & ~dared)

    def met(pose: np.ndarray, margin: float) -> set[tuple[int, ...]]:
        under = window.under(pose, car, margin)
        return {tuple(cell) for cell in under[kept_off[tuple(under.T)]].tolist()}

    here, crowded = met(planar, 0.0), len(met(planar, SEEN_MARGIN))
    costs = np.asarray(value.at(ends))
    room = [value.never + len(met(pose, SEEN_MARGIN)) for pose in ends]
    costs = np.where(costs < value.never, costs, room)
    for k in np.argsort(costs):
        if costs[k] >= value.never + crowded:
            return None
        if all(met(pose, 0.0) <= here for pose in between(np.stack([planar, ends[k]]))):
            return np.stack([planar, ends[k]])
    return None
