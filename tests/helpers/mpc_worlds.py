"""Make simple plans and costs-to-go for the tests of the car's planning, and an oracle."""

import jax.numpy as jnp
import numpy as np
from scipy.interpolate import RegularGridInterpolator

from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.mpc.fields import value_units, walled
from vssm_gym.planning.mpc.problem import MpcProblem
from vssm_gym.planning.value_iteration import CostToGo

LOW, HIGH = -2.0, 2.0  # m, the square of every world here
VALUE_CELL, CLEARANCE_CELL, HEADINGS = 0.05, 0.025, 32
MOTION = 0.06  # m: a motion of the cost-to-go is a step of the car at full speed


def value_of(cost) -> CostToGo:
    """Return ``cost(x, y, heading)`` on the grid, step costs."""
    axis = np.arange(LOW, HIGH + 1e-9, VALUE_CELL)
    x, y, heading = np.meshgrid(axis, axis, 2 * np.pi * np.arange(HEADINGS) / HEADINGS, indexing="ij")
    f32 = lambda a: jnp.asarray(a, jnp.float32)
    return CostToGo(f32(cost(x, y, heading)), f32([LOW, LOW]), f32(VALUE_CELL), 0.99, MOTION)


def linear_cost() -> CostToGo:
    """Return a cost-to-go that is linear in the pose, up to heading ``pi`` and from there back."""
    i, j, k = np.meshgrid(np.arange(6), np.arange(5), np.arange(8), indexing="ij")
    return CostToGo(
        values=jnp.asarray(1.0 * i + 2.0 * j + 3.0 * np.abs(k - 4), jnp.float32),
        origin=jnp.array([1.0, -1.0]),
        resolution=jnp.float32(0.5),
        gamma=0.99,
        motion_length=0.1,
    )


def clearance_of(distance) -> ClearanceMap:
    """Return ``distance(x, y)`` to the nearest obstacle on the grid, m."""
    axis = np.arange(LOW, HIGH + 1e-9, CLEARANCE_CELL)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    return ClearanceMap(
        np.ascontiguousarray(distance(x, y) + 0.0 * x, np.float32), np.array([LOW, LOW]), CLEARANCE_CELL
    )


def wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


class Oracle:
    """Compute cost, states and clearances of one plan in float64 NumPy, step by step, from the definitions."""

    def __init__(self, problem: MpcProblem, value: CostToGo, clearance: ClearanceMap) -> None:
        self.problem = problem
        table = np.asarray(value.values, np.float64)
        places = [float(value.origin[a]) + float(value.resolution) * np.arange(table.shape[a]) for a in (0, 1)]
        around = np.arange(table.shape[2] + 1) * 2 * np.pi / table.shape[2]
        self.value = RegularGridInterpolator((*places, around), np.concatenate([table, table[..., :1]], axis=2))
        cells = [clearance.origin[a] + clearance.resolution * np.arange(clearance.clearance.shape[a]) for a in (0, 1)]
        self.distance = RegularGridInterpolator(cells, walled(clearance))
        self.discount, self.step_cost = value_units(value, problem.car)
        counts = [] if value.counts is None else [np.where(value.counts.poses, k, 1.0) for k in value.counts.number]
        self.counts = [RegularGridInterpolator((*places, around[:-1]), k, "nearest", False, None) for k in counts]

    def __call__(self, state, last, controls):
        car, config = self.problem.car, self.problem.config
        centres, radius = self.problem.discs
        z, before, cost, states, clearances = np.array(state, float), np.array(last, float), 0.0, [], []
        passed = 0.0  # steps, as they count
        for u in controls:
            s = u[0] * car.dt
            turn = s * np.tan(u[1]) / car.wheelbase
            dx, dy = s * np.sinc(turn / np.pi), s * turn / 2 * np.sinc(turn / 2 / np.pi) ** 2
            c, n = np.cos(z[2]), np.sin(z[2])
            z = z + np.array([c * dx - n * dy, n * dx + c * dy, turn])
            c, n = np.cos(z[2]), np.sin(z[2])
            points = z[:2] + centres @ np.array([[c, n], [-n, c]])
            clear = self.distance(points) - radius
            value = float(self.value([*z[:2], z[2] % (2 * np.pi)])[0])
            k = float(self.counts[int(u[0] < 0.0)]([*z[:2], z[2] % (2 * np.pi)])[0]) if self.counts else 1.0
            n = 1.0 + (k - 1.0) * abs(u[0]) / car.max_speed
            cost += self.discount**passed * (
                min(value, self.step_cost * (1.0 - self.discount**n) / (1.0 - self.discount))
                + self.step_cost
                * (
                    config.haste * value
                    + config.effort * (u[0] / car.max_speed) ** 2
                    + config.smoothness * np.sum(((u - before) / car.limits) ** 2)
                    + config.proximity * np.mean(np.maximum(0.0, 1.0 - clear / config.comfort) ** 2)
                )
            )
            before, passed = u, passed + n
            states.append(z)
            clearances.append(clear)
        return cost + self.discount**passed * value, np.array(states), np.array(clearances)


def finite_difference(f, x: np.ndarray, h: float = 1e-6) -> np.ndarray:
    """Compute central differences of a scalar function, in the shape of ``x``."""
    gradient = np.zeros_like(x)
    for i in np.ndindex(x.shape):
        d = np.zeros_like(x)
        d[i] = h
        gradient[i] = (f(x + d) - f(x - d)) / (2 * h)
    return gradient
