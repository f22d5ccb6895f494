"""The map: independent Gaussians over a voxel grid, ``p(M) = prod_cells N(occupancy) N(rgb)`` (SPEC 1, VSSM-LM, PRISM).

Occupancy is the negative signed distance in metres, positive inside objects; colour is RGB in [0, 1]. The continuous
field is the trilinear interpolation of the cells and its zero level set is the surface.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vssm_gym import empty_space
from vssm_gym.empty_space import BLOCK, CELLS, EmptySpace
from vssm_gym.errors import InputError
from vssm_gym.files import atomic_write

FORMAT_VERSION = 1
PRIOR_OCCUPANCY_STD = 10.0  # m; the information gain of exploration depends on it (SPEC 1, 8)
PRIOR_COLOUR_STD = 10.0
PRIOR_OCCUPANCY_MEAN = -0.001  # m: unknown space is just free, so an empty map renders nothing
OBSERVED_PRECISION = 0.1  # a cell with more than this was observed at least once, at any std up to 3

_ARRAYS = ("occupancy", "occupancy_precision", "colour", "colour_precision")
_POSITIVE = ("occupancy_precision", "colour_precision", "voxel_size")


def trilinear(corners: list[Array], x: Array, y: Array, z: Array) -> Array:
    """Interpolation between eight corner values (x slowest, z fastest) at fractions ``x, y, z`` in [0, 1]."""
    edges = [a + z * (b - a) for a, b in zip(corners[0::2], corners[1::2], strict=True)]
    faces = [a + y * (b - a) for a, b in zip(edges[0::2], edges[1::2], strict=True)]
    return faces[0] + x * (faces[1] - faces[0])


class VoxelMap(eqx.Module):
    """A Gaussian belief over a dense grid, stored in blocks of 8^3 cells; consumers use the queries, not the arrays."""

    occupancy: Float[Array, "blocks cells"]  # mean, m, positive inside objects
    occupancy_precision: Float[Array, "blocks cells"]  # 1/m^2
    colour: Float[Array, "blocks 3 cells"]  # mean RGB, [0, 1]
    colour_precision: Float[Array, "blocks cells"]  # of each colour channel: the three are always observed together
    empty: EmptySpace  # where rays may skip; follows the occupancy mean
    origin: Float[Array, "3"]  # world position of the centre of cell (0, 0, 0), m
    voxel_size: Float[Array, ""]  # m
    blocks: tuple[int, int, int] = eqx.field(static=True)  # blocks along x, y, z

    @classmethod
    def prior(
        cls, origin: Array | np.ndarray | Sequence[float], voxel_size: float, shape: tuple[int, int, int]
    ) -> "VoxelMap":
        """``p(M)``: the broad prior over a grid of at least ``shape`` cells (rounded up to whole blocks)."""
        blocks = (-(-shape[0] // BLOCK), -(-shape[1] // BLOCK), -(-shape[2] // BLOCK))
        n = blocks[0] * blocks[1] * blocks[2]
        return cls(
            occupancy=jnp.full((n, CELLS), PRIOR_OCCUPANCY_MEAN, jnp.float32),
            occupancy_precision=jnp.full((n, CELLS), PRIOR_OCCUPANCY_STD**-2, jnp.float32),
            colour=jnp.zeros((n, 3, CELLS), jnp.float32),
            colour_precision=jnp.full((n, CELLS), PRIOR_COLOUR_STD**-2, jnp.float32),
            empty=EmptySpace(
                level=jnp.full((n, CELLS), 4, jnp.uint8),
                rings=jnp.full(blocks, empty_space.MAX_RINGS, jnp.int32),
            ),
            origin=jnp.asarray(origin, jnp.float32),
            voxel_size=jnp.asarray(voxel_size, jnp.float32),
            blocks=blocks,
        )

    @classmethod
    def cube(
        cls, centre: Array | np.ndarray | Sequence[float], extent: float = 14.0, voxel_size: float = 0.07
    ) -> "VoxelMap":
        """The published grid: ``extent`` metres along each axis around ``centre`` (PRISM: 200^3 over 14 m)."""
        n = round(extent / voxel_size)
        origin = np.asarray(centre, dtype=float) - 0.5 * voxel_size * (n - 1)
        return cls.prior(origin, voxel_size, (n, n, n))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Cells along x, y, z."""
        return (self.blocks[0] * BLOCK, self.blocks[1] * BLOCK, self.blocks[2] * BLOCK)

    @property
    def bounds(self) -> np.ndarray:
        """``(2, 3)`` world positions of the lowest and highest cell centres, m."""
        low = np.asarray(self.origin, dtype=float)
        return np.stack([low, low + (np.array(self.shape) - 1) * float(self.voxel_size)])

    def to_grid(self, p_world: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """Continuous cell coordinates of world points; integers are cell centres."""
        return (p_world - self.origin) / self.voxel_size

    def _corners(self, p_world: Array) -> tuple[list[Array], Array, Array]:
        """Flat positions of the eight cells around points, the fractions between them, and which points are inside."""
        g = self.to_grid(p_world)
        top = jnp.asarray(self.shape, jnp.float32) - 1.0
        inside = jnp.all((g >= 0.0) & (g <= top), axis=-1)
        low = jnp.clip(jnp.floor(jax.lax.stop_gradient(g)), 0.0, top - 1.0)
        cell = low.astype(jnp.int32)
        offsets = empty_space.corner_offsets(cell[..., 0], cell[..., 1], cell[..., 2], self.blocks)
        return offsets, jnp.moveaxis(g - low, -1, 0), inside

    def _interpolate(self, p_world: Array, *channels: tuple[Array, float]) -> Array:
        """Trilinear interpolation of ``(blocks, cells)`` arrays; outside the grid each has its given value."""
        offsets, fraction, inside = self._corners(p_world)
        values = []
        for array, outside in channels:
            flat = array.reshape(-1)
            corners = [flat.at[offset].get(mode="promise_in_bounds") for offset in offsets]
            values.append(jnp.where(inside, trilinear(corners, *fraction), outside))
        return jnp.stack(values, axis=-1)

    def occupancy_at(self, p_world: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Mean occupancy (negative signed distance, m) at world points; the prior mean outside the grid."""
        return self._interpolate(p_world, (self.occupancy, PRIOR_OCCUPANCY_MEAN))[..., 0]

    def field(self, p_world: Float[Array, "*batch 3"]) -> Float[Array, "*batch 4"]:
        """``f_M: R^3 -> R^4`` at the mean: occupancy (m) and RGB by trilinear interpolation; the prior mean outside."""
        colour = [(self.colour[:, c], 0.0) for c in range(3)]
        return self._interpolate(p_world, (self.occupancy, PRIOR_OCCUPANCY_MEAN), *colour)

    def precision(self, p_world: Float[Array, "*batch 3"]) -> Float[Array, "*batch 4"]:
        """Precision of occupancy and of each colour channel, interpolated; the prior's outside the grid."""
        colour = (self.colour_precision, PRIOR_COLOUR_STD**-2)
        return self._interpolate(p_world, (self.occupancy_precision, PRIOR_OCCUPANCY_STD**-2), colour, colour, colour)

    def observed_at(self, p_world: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Share of the field's value at a point that comes from cells whose occupancy and colour were observed, [0, 1].

        Behind the band that an image updates the field falls back to "just free"; that crossing is no surface, and it
        lies close to a cell that nothing observed, which gives it away.
        """
        offsets, fraction, inside = self._corners(p_world)
        occupancy, colour = self.occupancy_precision.reshape(-1), self.colour_precision.reshape(-1)
        seen = []
        for offset in offsets:
            a = occupancy.at[offset].get(mode="promise_in_bounds") > OBSERVED_PRECISION
            b = colour.at[offset].get(mode="promise_in_bounds") > OBSERVED_PRECISION
            seen.append((a & b).astype(jnp.float32))
        return jnp.where(inside, trilinear(seen, *fraction), 0.0)

    def with_occupancy(self, occupancy: Float[Array, "blocks cells"]) -> "VoxelMap":
        """The same map with other occupancy means; the empty-space index follows."""
        empty = _build_empty(occupancy, self.blocks)
        return eqx.tree_at(lambda m: (m.occupancy, m.empty), self, (occupancy, empty))

    def dense(self, array: Array) -> Array:
        """A ``(blocks, ..., cells)`` array laid out as ``(nx, ny, nz, ...)``: for pictures, meshes and tests."""
        bx, by, bz = self.blocks
        extra = array.shape[1:-1]
        a = array.reshape(bx, by, bz, -1, BLOCK, BLOCK, BLOCK)
        a = a.transpose(0, 4, 1, 5, 2, 6, 3).reshape(*self.shape, *extra)
        return a

    def blocked(self, dense: Array) -> Array:
        """The inverse of :meth:`dense`: ``(nx, ny, nz[, channels])`` to block storage."""
        bx, by, bz = self.blocks
        a = dense.reshape(bx, BLOCK, by, BLOCK, bz, BLOCK, -1).transpose(0, 2, 4, 6, 1, 3, 5)
        return a.reshape((bx * by * bz, *dense.shape[3:], CELLS))

    def save(self, path: str | Path, **metadata: str | float | int | list) -> None:
        """Write an ``.npz`` (no pickle) with a version and ``metadata``; the file appears whole or not at all."""
        header = {"format": "vssm_gym.VoxelMap", "version": FORMAT_VERSION, "blocks": list(self.blocks), **metadata}
        arrays: dict[str, Any] = {name: np.asarray(getattr(self, name)) for name in _ARRAYS}
        with atomic_write(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(
                file,
                header=np.frombuffer(json.dumps(header).encode(), np.uint8),
                origin=np.asarray(self.origin),
                voxel_size=np.asarray(self.voxel_size),
                **arrays,
            )

    @classmethod
    def load(cls, path: str | Path) -> "VoxelMap":
        """Read a map written by :meth:`save`.

        Raises:
            InputError: the file is missing, truncated, of another format or version, or its arrays do not fit.
        """
        header, arrays = _read(Path(path))
        blocks = _blocks(path, header)
        n = blocks[0] * blocks[1] * blocks[2]
        shapes = {
            "occupancy": (n, CELLS),
            "occupancy_precision": (n, CELLS),
            "colour": (n, 3, CELLS),
            "colour_precision": (n, CELLS),
            "origin": (3,),
            "voxel_size": (),
        }
        for name, shape in shapes.items():
            array = arrays[name]
            if array.shape != shape or array.dtype.kind != "f" or not np.isfinite(array).all():
                raise InputError(path, name, f"finite floats of shape {shape}, found {array.dtype} {array.shape}")
            if name in _POSITIVE and not (array > 0.0).all():
                raise InputError(path, name, "positive numbers")
        device = {name: jnp.asarray(arrays[name], jnp.float32) for name in shapes}
        empty = _build_empty(device["occupancy"], blocks)
        return cls(empty=empty, blocks=blocks, **device)


def _read(path: Path) -> tuple[dict, dict[str, np.ndarray]]:
    if not path.is_file():
        raise InputError(path, "file", "an existing map file (.npz); `vssm-gym map build` makes one")
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        header = json.loads(arrays.pop("header").tobytes().decode())
    except Exception as error:  # zipfile, zlib and NumPy raise whatever a damaged file leads them to
        raise InputError(path, "file", f"a whole vssm_gym map; it cannot be read ({error})") from error
    known = header if isinstance(header, dict) else {}
    if known.get("format") != "vssm_gym.VoxelMap" or known.get("version") != FORMAT_VERSION:
        found = f"{known.get('format')} version {known.get('version')}"
        raise InputError(path, "version", f"vssm_gym.VoxelMap version {FORMAT_VERSION}, found {found}")
    missing = [name for name in (*_ARRAYS, "origin", "voxel_size") if name not in arrays]
    if missing:
        raise InputError(path, missing[0], "this array in the map file")
    return header, arrays


def _blocks(path: str | Path, header: dict) -> tuple[int, int, int]:
    """The blocks along x, y, z that a header declares."""
    match header.get("blocks"):
        case [int(x), int(y), int(z)] if min(x, y, z) > 0:
            return x, y, z
    raise InputError(path, "blocks", f"three positive whole numbers, found {header.get('blocks')!r}")


def read_metadata(path: str | Path) -> dict:
    """The header of a map file: format, version and what was passed to :meth:`VoxelMap.save`."""
    return _read(Path(path))[0]


_build_empty = jax.jit(empty_space.build, static_argnums=1)
