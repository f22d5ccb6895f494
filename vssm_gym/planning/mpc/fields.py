"""Prepare the two lookup tables of the problem, as the solvers read them: cost-to-go and clearance.

    J(z) trilinear (CostToGo.at), continued a little way into collision;   d(p) bilinear

Beyond its grid nothing is known of a plan, so the border of the clearance's grid counts as a wall: inside,
``d = min(d, distance to the border)``, outside ``d = -distance``.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vssm_gym.errors import InputError
from vssm_gym.geometry.car import Car
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.value_iteration import CostToGo

CONTINUED = 2  # cells: what trilinear interpolation and IPOPT's spline read beyond a free pose
NEVER_SHARE = 0.999  # of the cost of never arriving, from which on a pose counts as having no path


class Fields(eqx.Module):
    """Hold the tables and their places, all of them arrays: another goal or map of the same shape compiles nothing."""

    value: CostToGo
    clearance: Float[Array, "mx my"]  # m
    clearance_origin: Float[Array, "2"]  # m, centre of cell [0, 0]
    clearance_resolution: Float[Array, ""]  # m
    discount: Float[Array, ""]  # of one step of the car
    step_cost: Float[Array, ""]  # of one step of the car, in the unit of the cost-to-go

    @property
    def shapes(self) -> tuple[Any, ...]:
        """Return what compiled code depends on."""
        value = self.value
        return value.values.shape, value.gamma, value.motion_length, self.clearance.shape, value.counts is not None

    def distance(self, points: Float[Array, "*batch 2"]) -> Float[Array, "*batch"]:
        """Return ``d``, m; negative inside obstacles and beyond the grid."""
        mx, my = self.clearance.shape
        g = (points - self.clearance_origin) / self.clearance_resolution
        i, a = _cell(g[..., 0], mx)
        j, b = _cell(g[..., 1], my)
        table, row = self.clearance.reshape(-1), i * my + j
        low = (1.0 - b) * table[row] + b * table[row + 1]
        high = (1.0 - b) * table[row + my] + b * table[row + my + 1]
        excess = jnp.maximum(jnp.maximum(-g, g - jnp.array([mx - 1.0, my - 1.0])), 0.0)
        # the sum, not the norm: steeper, and its derivative exists at the border
        return (1.0 - a) * low + a * high - self.clearance_resolution * jnp.sum(excess, axis=-1)


def _cell(g: Float[Array, "*batch"], n: int) -> tuple[Array, Float[Array, "*batch"]]:
    """Return the cell's lower index and the place within it, in [0, 1]; beyond the grid the nearest place on it."""
    g = jnp.clip(g, 0.0, n - 1.0)
    index = jnp.minimum(g.astype(jnp.int32), n - 2)
    return index, g - index


class FieldCache:
    """Cache the tables of the last goal and map: they are moved to the device once, not at every step."""

    def __init__(self, car: Car) -> None:
        self.car = car
        self.made: tuple[CostToGo, ClearanceMap, Fields] | None = None

    def of(self, value: CostToGo, clearance: ClearanceMap) -> Fields:
        """Return the tables of these two objects, which are never changed in place."""
        if self.made is None or self.made[0] is not value or self.made[1] is not clearance:
            self.made = value, clearance, make_fields(value, clearance, self.car)
        return self.made[2]


def make_fields(value: CostToGo, clearance: ClearanceMap, car: Car) -> Fields:
    """Make the tables on the device."""
    if len(np.shape(value.values)) != 3 or min(np.shape(value.values)) < 2:
        raise InputError(
            "plan", "value", f"a table (nx, ny, headings), each at least 2; found {np.shape(value.values)}"
        )
    if min(clearance.clearance.shape) < 2:
        raise InputError("plan", "clearance", f"at least 2 x 2 cells; found {clearance.clearance.shape}")
    f32 = lambda a: jnp.asarray(a, jnp.float32)
    as_jax = lambda a: jnp.asarray(a) if np.asarray(a).dtype == np.bool_ else f32(a)
    discount, step_cost = value_units(value, car)
    return Fields(
        eqx.tree_at(lambda v: v.values, jax.tree.map(as_jax, value), continued(f32(value.values), value)),
        f32(walled(clearance)),
        f32(clearance.origin),
        f32(clearance.resolution),
        f32(discount),
        f32(step_cost),
    )


@partial(jax.jit, static_argnames=("never", "cost"))
def _a_cell_deeper(table: Array, never: float, cost: float) -> Array:
    """Return ``min over the six neighbours + cost`` where the table says never."""
    padded = jnp.pad(table, ((1, 1), (1, 1), (0, 0)), constant_values=never)
    nearest = jnp.minimum(jnp.roll(table, 1, axis=2), jnp.roll(table, -1, axis=2))
    for beside in (padded[2:, 1:-1], padded[:-2, 1:-1], padded[1:-1, 2:], padded[1:-1, :-2]):
        nearest = jnp.minimum(nearest, beside)
    return jnp.where(table >= NEVER_SHARE * never, jnp.minimum(never, nearest + cost), table)


def continued(table: Array, value: CostToGo) -> Array:
    """Return the cost-to-go, continued :data:`CONTINUED` cells into poses that collide, at the cost of driving there.

    Interpolation mixes the cost of never arriving into every pose within a cell of a collision. A critic alone needs
    that cost; here the constraint keeps the car out, and next to walls the cost would form barriers and hollows that
    hide the differences which guide a tight manoeuvre.
    """
    for _ in range(CONTINUED):
        table = _a_cell_deeper(table, value.never, float(value.resolution) / value.motion_length)
    return table


def value_units(value: CostToGo, car: Car) -> tuple[float, float]:
    """Return discount and cost of one step in the unit of the cost-to-go, where a motion at full speed costs 1.

    With n motions a step, ``gamma = gamma_J^n`` and ``s = (1 - gamma) / (1 - gamma_J)``: never arriving costs the same.
    """
    discount = value.gamma ** (car.dt * car.max_speed / value.motion_length)
    return discount, (1.0 - discount) / (1.0 - value.gamma)


def walled(clearance: ClearanceMap) -> np.ndarray:
    """Return the clearance with a wall along the border of its grid, ``(mx, my)`` float64, m."""
    steps = [np.minimum(np.arange(n), np.arange(n)[::-1]) for n in clearance.clearance.shape]
    border = clearance.resolution * np.minimum(steps[0][:, None], steps[1][None, :])
    return np.minimum(clearance.clearance, border)
