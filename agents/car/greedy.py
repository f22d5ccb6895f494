"""Descend the cost-to-go of ``vi_mpc`` by single arcs: the value of the critic without a horizon (eq. P22).

u = argmin_u |s| / l + gamma^(|s| / l) J(z exp(arc(u)))       s: length of the arc, l: of one motion of J

Described in ``docs/agents/car.md``.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from vssm_gym.agents.shared.car.critic import Critic
from vssm_gym.agents.shared.car.driver import SURFACE_ERROR, CarCommand, Driver
from vssm_gym.agents.shared.localization import TruePose
from vssm_gym.geometry.arc import poses_after, turn_of
from vssm_gym.geometry.car import Car
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.planning.car.footprint import Arena, collides
from vssm_gym.planning.value_iteration import CostToGo


@dataclass(frozen=True)
class GreedyConfig:
    """Configure the arcs among which the best is driven.

    Args:
        steerings: number of them, from full lock to full lock.
        lengths: of the arcs, m, forwards and backwards.
        parts: poses of an arc that are tested for collision, at most 6 cm apart.
        pace: share of the greatest speed at which the car drives.
    """

    steerings: int = 11
    lengths: tuple[float, ...] = (0.06, 0.12, 0.24)
    parts: int = 4
    pace: float = 0.5


class GreedyDescent:
    """Drive one step of the best arc, then choose again."""

    def __init__(self, arena: Arena, car: Car, config: GreedyConfig) -> None:
        self._arena, self._car, self._config, self._critic = arena, car, config, Critic(arena, car)
        steering = np.linspace(-car.max_steering, car.max_steering, config.steerings)
        lengths = np.array([sign * length for length in config.lengths for sign in (1.0, -1.0)])
        grid = np.meshgrid(lengths, steering, indexing="ij")
        self._length, self._steering = (values.ravel() for values in grid)
        self._value: CostToGo

    def begin(self, planar: np.ndarray, goal: np.ndarray, control: np.ndarray) -> str | None:
        """Run value iteration to the target; return the reason where the car cannot get there."""
        result = self._critic.aim(planar, goal)
        if result.cost_to_go is None:
            return result.status.message
        self._value = result.cost_to_go
        return None

    def step(self, planar: Any) -> CarCommand:
        """Return the free arc with the least cost."""
        poses = self._along(planar)
        motions = np.abs(self._length) / self._value.motion_length
        cost = motions + self._value.gamma**motions * np.asarray(self._value.at(poses[:, -1]))
        here = float(self._value.at(planar))
        if here <= 0.0:
            return CarCommand(np.zeros(2), "at the target")
        for best in np.argsort(cost):
            if not any(collides(self._arena, pose, self._car, SURFACE_ERROR) for pose in poses[best]):
                speed = np.sign(self._length[best]) * min(
                    self._config.pace * self._car.max_speed, abs(self._length[best]) / self._car.dt
                )
                return CarCommand(np.array([speed, self._steering[best]]), "descends", poses[best, :, :2])
        return CarCommand(np.zeros(2), "stands: every arc collides")

    def _along(self, planar: np.ndarray) -> Any:
        """Return the poses of every arc, ``(arcs, parts, 3)``."""
        parts = self._config.parts
        s = self._length[:, None] * np.arange(1, parts + 1) / parts
        turn = turn_of(s, self._steering[:, None], self._car.wheelbase)
        poses = poses_after(planar[2], s, turn, planar[0], planar[1])
        poses[..., 2] = wrap_angle(poses[..., 2])
        return poses


class GreedyAgent:
    """Descend the cost-to-go greedily; the pose is observed."""

    name = "greedy"
    robot = "car"
    task = "pointgoal"
    needs_pose = True
    needs_map = True

    def __init__(self, config: GreedyConfig | None = None) -> None:
        chosen = config or GreedyConfig()
        driver = Driver(TruePose(), lambda arena, car: GreedyDescent(arena, car, chosen))
        self.reset, self.act = driver.reset, driver.act
