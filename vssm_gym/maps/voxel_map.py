"""Define the map: independent Gaussians over a voxel grid, ``p(M) = prod_cells N(occupancy) N(rgb)`` (VSSM-LM, PRISM).

Occupancy is the negative signed distance in metres, positive inside objects; colour is RGB in [0, 1]. The continuous
field is the trilinear interpolation of the cells and its zero level set is the surface.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vssm_gym.maps import empty_space, map_file
from vssm_gym.maps.block_table import BLOCK, CELLS, PRIOR_SLOT, BlockTable, block_number, corner_offsets, rows
from vssm_gym.maps.empty_space import EmptySpace
from vssm_gym.maps.map_file import read_metadata as read_metadata
from vssm_gym.maps.pose_errors import PoseErrors

PRIOR_OCCUPANCY_STD = 10.0  # m; broad (VSSM-LM); the information gain of exploration depends on it
PRIOR_COLOUR_STD = 10.0  # of each channel in [0, 1]
PRIOR_OCCUPANCY_MEAN = -0.001  # m: unknown space is just free, so an empty map renders nothing
# Std of one real observation of a cell, errors that do not average out included: cautious planning and the slices of
# a report take OBSERVATION_STD^2 / n after n observations. How far the surface is off is surface_std's.
OBSERVATION_STD = 0.03  # m, of occupancy
OBSERVATION_COLOUR_STD = 0.1  # of each channel in [0, 1]
TRUNCATION = 2.0  # voxels: half the width of the band around a surface that an image updates (PRISM)
OBSERVED_PRECISION = 0.1  # a cell with more than this was observed at least once, at any std up to 3

DEFAULT_SLOTS = 40_000  # of a block-sparse map: 0.5 GB, 440 m^3 of seen space in cells of 3.5 cm, 3,500 m^3 of 7 cm


Box = Sequence[int] | np.ndarray  # block coordinates


def _cube(
    centre: Array | np.ndarray | Sequence[float], extent: float, voxel_size: float
) -> tuple[np.ndarray, float, tuple[int, int, int]]:
    """Return origin, voxel size and shape of a cubic grid."""
    n = round(extent / voxel_size)
    return np.asarray(centre, dtype=float) - 0.5 * voxel_size * (n - 1), voxel_size, (n, n, n)


def trilinear(corners: list[Array], x: Array, y: Array, z: Array) -> Array:
    """Interpolate between eight corner values (x slowest, z fastest) at fractions ``x, y, z`` in [0, 1] (eq. M4)."""
    edges = [a + z * (b - a) for a, b in zip(corners[0::2], corners[1::2], strict=True)]
    faces = [a + y * (b - a) for a, b in zip(edges[0::2], edges[1::2], strict=True)]
    return faces[0] + x * (faces[1] - faces[0])


class VoxelMap(eqx.Module):
    """Represent a Gaussian belief ``q(M)`` over occupancy and colour on a grid in the world, in blocks of 8^3 cells.

    Use the queries (:meth:`field`, :meth:`precision`, :meth:`observed_at`), not the arrays: points in the world go in,
    m. Occupancy is the negative signed distance to the nearest surface, m: positive inside objects.

    A *dense* map has a row for every block. A *block-sparse* map has as many rows as it was given slots; a table lists
    which blocks have one, and all others are at the prior (:mod:`vssm_gym.maps.block_table`). Queries do not differ.
    """

    occupancy: Float[Array, "rows cells"]  # mean, m, positive inside objects
    occupancy_precision: Float[Array, "rows cells"]  # 1/m^2
    colour: Float[Array, "rows 3 cells"]  # mean RGB, [0, 1]
    colour_precision: Float[Array, "rows cells"]  # of each colour channel: the three are always observed together
    empty: EmptySpace  # where rays may skip; follows the occupancy mean
    origin: Float[Array, "3"]  # world position of the centre of cell (0, 0, 0), m
    voxel_size: Float[Array, ""]  # m
    blocks: tuple[int, int, int] = eqx.field(static=True)  # blocks along x, y, z
    table: BlockTable | None = None  # which blocks have rows; None: all of them
    # Of the poses at which images entered the map; None: they were true. Samples of the map have them, queries do not.
    pose_errors: PoseErrors | None = None

    @classmethod
    def prior(
        cls,
        origin: Array | np.ndarray | Sequence[float],
        voxel_size: float,
        shape: tuple[int, int, int],
        slots: int | None = None,
    ) -> "VoxelMap":
        """Return ``p(M)``, the broad prior over a grid.

        Args:
            origin: world position of the centre of cell (0, 0, 0), m.
            voxel_size: edge of a cell, m.
            shape: cells along x, y, z at least; rounded up to whole blocks.
            slots: None for a dense map; else the map is block-sparse, and at most ``slots - 1`` blocks can be observed.

        Returns:
            A map in which nothing was observed.
        """
        blocks = (-(-shape[0] // BLOCK), -(-shape[1] // BLOCK), -(-shape[2] // BLOCK))
        n = blocks[0] * blocks[1] * blocks[2] if slots is None else slots
        return cls(
            occupancy=jnp.full((n, CELLS), PRIOR_OCCUPANCY_MEAN, jnp.float32),
            occupancy_precision=jnp.full((n, CELLS), PRIOR_OCCUPANCY_STD**-2, jnp.float32),
            colour=jnp.zeros((n, 3, CELLS), jnp.float32),
            colour_precision=jnp.full((n, CELLS), PRIOR_COLOUR_STD**-2, jnp.float32),
            empty=EmptySpace.of_prior(n, blocks, sparse=slots is not None),
            origin=jnp.asarray(origin, jnp.float32),
            voxel_size=jnp.asarray(voxel_size, jnp.float32),
            blocks=blocks,
            table=None if slots is None else BlockTable.empty(blocks, slots),
        )

    @classmethod
    def cube(
        cls, centre: Array | np.ndarray | Sequence[float], extent: float = 14.0, voxel_size: float = 0.07
    ) -> "VoxelMap":
        """Return the prior on a dense cube; the default is the published grid (PRISM: 200^3 cells over 14 m).

        Args:
            centre: of the cube in the world, m.
            extent: edge of the cube, m.
            voxel_size: edge of a cell, m.

        Returns:
            A map in which nothing was observed.
        """
        return cls.prior(*_cube(centre, extent, voxel_size))

    @classmethod
    def sparse_cube(
        cls,
        centre: Array | np.ndarray | Sequence[float],
        extent: float = 28.0,
        voxel_size: float = 0.07,
        slots: int = DEFAULT_SLOTS,
    ) -> "VoxelMap":
        """Return the prior on a block-sparse cube.

        Args:
            centre: of the cube in the world, m.
            extent: edge of the cube, m.
            voxel_size: edge of a cell, m.
            slots: blocks that have storage, 12.8 kB each; the memory does not depend on the volume.

        Returns:
            A map in which nothing was observed.
        """
        return cls.prior(*_cube(centre, extent, voxel_size), slots=slots)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Return the number of cells along x, y, z."""
        return (self.blocks[0] * BLOCK, self.blocks[1] * BLOCK, self.blocks[2] * BLOCK)

    @property
    def bounds(self) -> np.ndarray:
        """Return the ``(2, 3)`` world positions of the lowest and highest cell centres, m."""
        low = np.asarray(self.origin, dtype=float)
        return np.stack([low, low + (np.array(self.shape) - 1) * float(self.voxel_size)])

    def to_grid(self, p_world: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """Convert points to cell coordinates.

        Args:
            p_world: points, m.

        Returns:
            Continuous coordinates in cells along x, y, z; integers are cell centres.
        """
        return (p_world - self.origin) / self.voxel_size

    def corners(self, p_world: Array) -> tuple[list[Array], list[Array], Array]:
        """Find the eight cells around points, for trilinear interpolation.

        Args:
            p_world: points ``(..., 3)``, m.

        Returns:
            Flat positions of the cells ``(...)``, one array a corner; fractions in [0, 1), one array an axis; and which
            points lie in the grid, ``(...)`` bool.
        """
        # One array a coordinate: operations over an axis of three do not vectorise over points.
        g = [(p_world[..., a] - self.origin[a]) / self.voxel_size for a in range(3)]
        low, inside = [], jnp.ones(p_world.shape[:-1], bool)
        for c, n in zip(g, self.shape, strict=True):
            inside &= (c >= 0.0) & (c <= n - 1.0)
            low.append(jnp.clip(jnp.floor(jax.lax.stop_gradient(c)), 0.0, n - 2.0))
        offsets = corner_offsets([c.astype(jnp.int32) for c in low], self.blocks, self.table)
        return offsets, [c - d for c, d in zip(g, low, strict=True)], inside

    def _interpolate(self, p_world: Array, array: Array, outside: float) -> Array:
        """Interpolate a ``(rows, cells)`` array trilinearly; return ``outside`` beyond the grid."""
        offsets, fraction, inside = self.corners(p_world)
        flat = array.reshape(-1)
        corners = [flat.at[offset].get(mode="promise_in_bounds") for offset in offsets]
        return jnp.where(inside, trilinear(corners, *fraction), outside)

    def occupancy_at(self, p_world: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Interpolate the mean occupancy trilinearly.

        Args:
            p_world: points, m.

        Returns:
            Negative signed distance, m; the prior mean outside the grid.
        """
        return self._interpolate(p_world, self.occupancy, PRIOR_OCCUPANCY_MEAN)

    def colour_at(self, p_world: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """Interpolate the mean colour trilinearly.

        Args:
            p_world: points, m.

        Returns:
            RGB in [0, 1]; the prior mean, black, outside the grid.
        """
        offsets, fraction, inside = self.corners(p_world)
        flat, plane = self.colour.reshape(-1), CELLS * jnp.arange(3)
        # A row holds three planes of cells: from row CELLS + cell to (3 row + channel) CELLS + cell.
        planes = [(o + 2 * (o & -CELLS))[..., None] + plane for o in offsets]
        corners = [flat.at[offset].get(mode="promise_in_bounds") for offset in planes]
        return jnp.where(inside[..., None], trilinear(corners, *(f[..., None] for f in fraction)), 0.0)

    def field(self, p_world: Float[Array, "*batch 3"]) -> Float[Array, "*batch 4"]:
        """``f_M: R^3 -> R^4`` at the mean, by trilinear interpolation.

        Args:
            p_world: points, m.

        Returns:
            Occupancy (m) and RGB in [0, 1]; the prior mean outside the grid.
        """
        return jnp.concatenate([self.occupancy_at(p_world)[..., None], self.colour_at(p_world)], axis=-1)

    def precision(self, p_world: Float[Array, "*batch 3"]) -> Float[Array, "*batch 4"]:
        """Interpolate the precisions trilinearly (eq. M5).

        Args:
            p_world: points, m.

        Returns:
            Precision of occupancy (1/m^2) and of each colour channel; the prior's outside the grid.
        """
        occupancy = self._interpolate(p_world, self.occupancy_precision, PRIOR_OCCUPANCY_STD**-2)
        colour = self._interpolate(p_world, self.colour_precision, PRIOR_COLOUR_STD**-2)
        return jnp.stack([occupancy, colour, colour, colour], axis=-1)

    def observed_at(self, p_world: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Return the interpolation weight of observed cells around each point.

        Behind the truncation band that an image updates, the field falls back to the prior, "just free". That zero
        crossing is no surface: it lies close to unobserved cells, which this weight reveals.

        Args:
            p_world: points, m.

        Returns:
            In [0, 1]: 1 where occupancy and colour of all eight cells around were observed, 0 outside the grid.
        """
        offsets, fraction, inside = self.corners(p_world)
        occupancy, colour = self.occupancy_precision.reshape(-1), self.colour_precision.reshape(-1)
        seen = []
        for offset in offsets:
            a = occupancy.at[offset].get(mode="promise_in_bounds") > OBSERVED_PRECISION
            b = colour.at[offset].get(mode="promise_in_bounds") > OBSERVED_PRECISION
            seen.append((a & b).astype(jnp.float32))
        return jnp.where(inside, trilinear(seen, *fraction), 0.0)

    def with_occupancy(self, occupancy: Float[Array, "rows cells"]) -> "VoxelMap":
        """Return the same map with other occupancy means and an updated empty-space index.

        Args:
            occupancy: means, m, in block storage.

        Returns:
            The map; it shares all other arrays with this one.
        """
        if self.table is not None:  # the row of all blocks without storage stays at the prior
            occupancy = occupancy.at[PRIOR_SLOT].set(PRIOR_OCCUPANCY_MEAN)
        empty = _build_empty(occupancy, self.blocks, self.table)
        return eqx.tree_at(lambda m: (m.occupancy, m.empty), self, (occupancy, empty))

    def dense(self, array: Array, low: Box = (0, 0, 0), high: Box | None = None) -> Array:
        """Lay out an array of cells on the grid, for pictures, meshes and tests.

        Args:
            array: ``(rows, ..., cells)`` in block storage, such as :attr:`occupancy`.
            low: first block along x, y, z.
            high: block after the last; None: all blocks.

        Returns:
            ``(nx, ny, nz, ...)`` cells along x, y, z.
        """
        spans = [np.arange(a, b) for a, b in zip(low, self.blocks if high is None else high, strict=True)]
        bx, by, bz = (len(span) for span in spans)
        number = block_number(jnp.meshgrid(*spans, indexing="ij"), self.blocks).reshape(-1)
        a = array[rows(number, self.table)].reshape(bx, by, bz, -1, BLOCK, BLOCK, BLOCK)
        a = a.transpose(0, 4, 1, 5, 2, 6, 3)
        return a.reshape(bx * BLOCK, by * BLOCK, bz * BLOCK, *array.shape[1:-1])

    def blocked(self, dense: Array) -> Array:
        """Convert cells on the grid to block storage: the inverse of :meth:`dense` for a dense map.

        Args:
            dense: ``(nx, ny, nz)`` or ``(nx, ny, nz, channels)`` cells along x, y, z.

        Returns:
            ``(rows, [channels,] cells)``.
        """
        bx, by, bz = self.blocks
        a = dense.reshape(bx, BLOCK, by, BLOCK, bz, BLOCK, -1).transpose(0, 2, 4, 6, 1, 3, 5)
        return a.reshape((bx * by * bz, *dense.shape[3:], CELLS))

    def rounded(self) -> "VoxelMap":
        """Return the map with numbers rounded to what they are worth: its file takes a third of the space.

        Occupancy keeps 1 mm, colour a 128th, a precision its first 4 binary digits.
        """

        def first_digits(precision: Array) -> Array:
            mantissa, exponent = jnp.frexp(precision)
            return jnp.ldexp(jnp.round(mantissa * 16.0) / 16.0, exponent)

        return replace(
            self,
            occupancy=jnp.round(self.occupancy * 1000.0) / 1000.0,
            colour=jnp.round(self.colour * 128.0) / 128.0,
            occupancy_precision=first_digits(self.occupancy_precision),
            colour_precision=first_digits(self.colour_precision),
        )

    def save(self, path: str | Path, **metadata: Any) -> None:
        """Write an ``.npz`` without pickle; the file is complete or absent.

        Only stored blocks of a block-sparse map are written.

        Args:
            path: the file; one that exists is replaced.
            metadata: what else its header holds, as JSON.
        """
        errors = {} if self.pose_errors is None else {"pose_errors": self.pose_errors.to_json()}
        arrays = {name: np.asarray(getattr(self, name)) for name in map_file.BELIEF}
        place = {"origin": np.asarray(self.origin), "voxel_size": np.asarray(self.voxel_size)}
        if self.table is None:
            held = map_file.StoredMap(self.blocks, place | arrays)
        else:
            slot = np.asarray(self.table.slot).reshape(-1)
            stored = np.flatnonzero(slot != PRIOR_SLOT)
            arrays = {name: array[slot[stored]] for name, array in arrays.items()}
            held = map_file.StoredMap(self.blocks, place | arrays, stored, len(self.occupancy))
        map_file.write(path, held, metadata | errors)

    @classmethod
    def load(cls, path: str | Path) -> "VoxelMap":
        """Read a map written by :meth:`save`.

        Args:
            path: the ``.npz`` file, or the name of a map that comes with the package.

        Returns:
            The map, dense or block-sparse as it was.

        Raises:
            InputError: the file is missing, truncated, of another format or version, or its arrays do not fit.
        """
        held = map_file.read(path)
        device = {name: jnp.asarray(array) for name, array in held.arrays.items()}
        table = None
        if held.stored is not None:
            x, y, z = (BLOCK * b for b in held.blocks)
            prior = cls.prior(held.arrays["origin"], 1.0, (x, y, z), held.slots)
            for name in map_file.BELIEF:  # in NumPy: JAX would compile anew for each number of stored blocks
                rows = np.array(getattr(prior, name))
                rows[1 : 1 + len(held.stored)] = held.arrays[name]
                device[name] = jnp.asarray(rows)
            table = BlockTable.of(held.blocks, held.slots, held.stored)
        return cls(
            occupancy=device["occupancy"],
            occupancy_precision=device["occupancy_precision"],
            colour=device["colour"],
            colour_precision=device["colour_precision"],
            empty=_build_empty(device["occupancy"], held.blocks, table),
            origin=device["origin"],
            voxel_size=device["voxel_size"],
            blocks=held.blocks,
            table=table,
            pose_errors=PoseErrors.from_header(path, held.header),
        )


_build_empty = jax.jit(empty_space.build, static_argnums=1)
