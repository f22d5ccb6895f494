"""Ask a scan model for its ranges at the places of a grid, once, and keep what a planner needs of them (eq. P45).

    clearance(p) = min_i l_i(p),    danger(p) = sum_i s(l_i(p)),    s(l) = 1 / (1 + exp((l - near) / width))
    reach(p, a)  = l_i(p) of the beam that points to a

``l_i`` is the distance from the robot to where beam ``i`` ends. Over a full circle it is a function of the place alone:
headings are asked so that their beams lie between each other's, and all of them count. The table is made in batches of
one static shape through the contract of :class:`~vssm_gym.model.scan_model.ScanModel`, whatever the map is.
"""

from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vssm_gym.errors import InputError
from vssm_gym.model.scan_model import ScanModel

PLACES_AT_ONCE = 256  # places of a batch
MOST_TABLE_PLACES = 4_000_000  # of a table


@dataclass(frozen=True)
class RangeTableConfig:
    """Configure the table.

    Args:
        spacing: of its places, m.
        headings: asked at each place.
        near: range that counts half in the danger, m.
        width: over which the sigmoid falls, m.
    """

    spacing: float = 0.01
    headings: int = 2
    near: float = 0.03
    width: float = 0.005

    def __post_init__(self) -> None:
        for name in ("spacing", "near", "width"):
            if not getattr(self, name) > 0.0:
                raise InputError("RangeTableConfig", name, f"above 0 m, not {getattr(self, name)!r}")
        if self.headings < 1:
            raise InputError("RangeTableConfig", "headings", f"at least 1, not {self.headings!r}")


class RangeTable(NamedTuple):
    """Hold what a model predicts at the places ``(x + i spacing, y + j spacing)``.

    Attributes:
        x: of the first place, m.
        y: of the first place, m.
        spacing: m.
        clearance: to the nearest end of a beam, m.
        danger: of all beams of one scan.
        reach: in directions ``2 pi k / n``, m; the scanner's range where no beam points.
    """

    x: float
    y: float
    spacing: float
    clearance: np.ndarray  # (nx, ny) float32
    danger: np.ndarray  # (nx, ny) float32
    reach: np.ndarray  # (nx, ny, n) float32


def range_table(
    model: ScanModel,
    low: Float[np.ndarray, "2"],
    high: Float[np.ndarray, "2"],
    config: RangeTableConfig | None = None,
) -> RangeTable:
    """Return the table of a rectangle of the plane.

    Args:
        model: whose ranges are asked.
        low: x, y of the first place, m.
        high: which the last place reaches.
        config: spacing, headings and the sigmoid.

    Raises:
        InputError: a rectangle without an area, or with too many places.
    """
    config = config or RangeTableConfig()
    low, high = np.asarray(low, float), np.asarray(high, float)
    shape = np.ceil((high - low) / config.spacing - 1e-9).astype(int) + 1
    if not (shape >= 2).all() or shape.prod() > MOST_TABLE_PLACES:
        size = " x ".join(map(str, shape.tolist()))
        raise InputError("range_table", "spacing", f"2 x 2 to {MOST_TABLE_PLACES:,} places; found {size}")
    nx, ny = shape.tolist()
    i, j = np.divmod(np.arange(nx * ny), ny)
    places = low + config.spacing * np.stack([i, j], axis=-1)
    filled = np.pad(places, ((0, -len(places) % PLACES_AT_ONCE), (0, 0)), mode="edge").astype(np.float32)
    batches = filled.reshape(-1, PLACES_AT_ONCE, 2)
    headings, near, width = config.headings, jnp.float32(config.near), jnp.float32(config.width)
    found = [jax.device_get(_asked(model, jnp.asarray(batch), headings, near, width)) for batch in batches]
    clearance, danger, reach = (np.concatenate([part[k] for part in found])[: nx * ny] for k in range(3))
    return RangeTable(
        float(low[0]), float(low[1]), config.spacing, clearance.reshape(nx, ny), danger.reshape(nx, ny),
        reach.reshape(nx, ny, -1),
    )  # fmt: skip


@eqx.filter_jit
def _asked(model: ScanModel, places: Array, headings: int, near: Array, width: Array) -> tuple[Array, Array, Array]:
    """Return clearance, danger and reach of places ``(n, 2)``."""
    scanner = model.scanner
    beams = len(scanner.angles)
    directions = headings * beams
    # The second heading's beams lie between those of the first, and so on
    heading = 2.0 * np.pi * np.arange(headings) / headings * (1.0 + 1.0 / beams)
    xy = jnp.broadcast_to(places[:, None], (len(places), headings, 2))
    turned = jnp.broadcast_to(jnp.asarray(heading, jnp.float32)[:, None], (len(places), headings, 1))
    states = jnp.concatenate([xy, turned], axis=-1)
    ranges = model.ranges(states)
    ends = jax.vmap(jax.vmap(scanner.endpoints))(states, ranges)
    away = ends - xy[:, :, None]
    distance = jnp.linalg.norm(away, axis=-1)
    bearing = jnp.where(distance > 1e-9, jnp.arctan2(away[..., 1], away[..., 0]), 0.0)
    number = jnp.round(bearing * directions / (2.0 * np.pi)).astype(int) % directions
    empty = jnp.full((len(places), directions), scanner.max_range)
    rows = jnp.arange(len(places))[:, None, None]
    reach = empty.at[rows, number].min(distance)
    danger = jnp.sum(jax.nn.sigmoid((near - distance) / width), axis=-1).mean(axis=-1)
    return jnp.min(distance, axis=(1, 2)), danger, reach
