"""Sweep ``W = gamma max_a share_a sum_c w_c W_c``: value iteration over (x, y, heading), in JAX (eq. P19).

``share_a`` is 1, or ``gamma^(k - 1)`` from poses where motion ``a`` counts ``k`` times.

With step cost 1 and ``V = 1 / (1 - gamma) - W`` the Bellman equation ``V = min_a 1 + gamma E[V']`` has no constant:
``W`` is the discounted reward of arriving, ``1 / (1 - gamma)`` at the goal, and exactly 0 in collision and wherever no
motion leads to the goal. From ``W = 0`` such states stay there, so a sealed room costs no sweeps, and the rounding of
large values does not stop the sweeps.

A motion moves all cells of a heading by the same displacement, so its successors are one window of the target heading's
plane, shifted by a fraction of a cell. Planes are stored flat with empty cells around them, in which windows may wrap
from one row into the next: one contiguous piece per motion, which vectorises.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vssm_gym.planning.value_iteration.motions import Motions

CHECK_EVERY = 4  # sweeps between two measurements of the residual


class Problem(NamedTuple):
    """Hold what the sweeps read of motions and map; planes are ``nx + 2 pad`` rows of ``ny + pad`` cells."""

    windows: Int[Array, "headings motions"]  # where the successors' window starts in the flat planes
    weights: Float[Array, "headings motions 4"]  # of the corners (x, y), (x, y + 1), (x + 1, y), (x + 1, y + 1)
    allowed: Int[Array, "headings interior"]  # bit a: motion a from this cell is free
    shares: Float[Array, "headings 2 interior"] | None  # of motions forwards, backwards; None: all are 1


class Layout(NamedTuple):
    """Place cell ``[ix, iy]`` of a heading in its flat plane; static."""

    nx: int
    ny: int
    pad: int

    @property
    def row(self) -> int:
        """Return the number of cells between neighbours along x."""
        return self.ny + self.pad

    @property
    def interior(self) -> int:
        """Return the number of cells from the first one to the end of the last row."""
        return self.nx * self.row

    def flat(self, cells: np.ndarray) -> np.ndarray:
        """Reshape ``(headings, nx, ny)`` to ``(headings, interior)``; padding is zero."""
        return np.pad(cells, ((0, 0), (0, 0), (0, self.pad))).reshape(len(cells), self.interior)

    def cells(self, flat: np.ndarray) -> np.ndarray:
        """Invert :meth:`flat`."""
        return flat.reshape(len(flat), self.nx, self.row)[:, :, : self.ny]


def layout_of(motions: Motions, shape: tuple[int, ...], resolution: float) -> Layout:
    """Return the layout with padding for the longest motion and the corner behind it."""
    return Layout(shape[0], shape[1], int(np.floor(motions.length / resolution)) + 2)


def corners_of(motions: Motions, resolution: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of motions in cells from their starts: the lower corner and the bilinear weights of all four.

    Returns:
        int64 ``(headings, motions, 2)`` and float64 ``(headings, motions, 4)``, as in :class:`Problem`.
    """
    cells = motions.displacements / resolution
    # An arc along an axis must not read two columns because of a rounding error.
    cells = np.where(np.abs(cells - np.round(cells)) < 1e-9, np.round(cells), cells)
    low = np.floor(cells).astype(np.int64)
    u, v = np.moveaxis(cells - low, -1, 0)
    return low, np.stack([(1 - u) * (1 - v), (1 - u) * v, u * (1 - v), u * v], axis=-1)


def problem_of(
    motions: Motions,
    layout: Layout,
    resolution: float,
    blocked_motions: np.ndarray,
    shares: np.ndarray | None = None,
) -> Problem:
    """Prepare the sweeps from ``(headings, motions, nx, ny)`` bool, the arcs that collide.

    ``shares`` ``(headings, 2, nx, ny)`` are those of the motions forwards and backwards; None: all are 1.
    """
    n, n_motions = blocked_motions.shape[:2]
    low, weights = corners_of(motions, resolution)
    target = (np.arange(n)[:, None] + motions.heading_steps) % n
    plane = (layout.nx + 2 * layout.pad) * layout.row
    windows = target * plane + (layout.pad + low[..., 0]) * layout.row + low[..., 1]
    allowed = np.zeros((n, layout.nx, layout.ny), np.int32)
    for a in range(n_motions):
        allowed |= np.left_shift((~blocked_motions[:, a]).astype(np.int32), a)
    if shares is not None:
        shares = layout.flat(shares.reshape(2 * n, layout.nx, layout.ny)).reshape(n, 2, layout.interior)
    return Problem(
        jnp.asarray(windows, jnp.int32),
        jnp.asarray(weights, jnp.float32),
        jnp.asarray(layout.flat(allowed)),
        None if shares is None else jnp.asarray(shares, jnp.float32),
    )


@partial(jax.jit, static_argnames="layout")
def iterate(
    problem: Problem,
    goal: Bool[Array, "headings interior"],
    start: Float[Array, "headings interior"],
    layout: Layout,
    gamma: Float[Array, ""],
    top: Float[Array, ""],
    tolerance: Float[Array, ""],
    max_sweeps: Int[Array, ""],
) -> tuple[Float[Array, "headings interior"], Float[Array, ""], Int[Array, ""]]:
    """Sweep from ``start`` until ``max |W - gamma max_a E[W']| < tolerance`` or ``max_sweeps``.

    ``top = 1 / (1 - gamma)``, rounded once by the caller, is ``W`` at the goal.

    Returns:
        ``W``, the largest change of the last sweep, which bounds the Bellman residual of ``W``, and the sweeps done.
    """

    def sweep(planes: Array) -> Array:
        new = jnp.where(goal, top, gamma * _best(problem, planes, layout))
        return jax.lax.dynamic_update_slice(planes, new, (0, layout.pad * layout.row))

    def several(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        planes, _, sweeps = carry
        before = jax.lax.fori_loop(0, CHECK_EVERY - 1, lambda _, p: sweep(p), planes)
        after = sweep(before)
        return after, jnp.max(jnp.abs(after - before)), sweeps + CHECK_EVERY

    planes, residual, sweeps = jax.lax.while_loop(
        lambda carry: (carry[1] >= tolerance) & (carry[2] < max_sweeps),
        several,
        (_padded(jnp.where(goal, top, start), layout), jnp.float32(jnp.inf), jnp.int32(0)),
    )
    return _interior(planes, layout), residual, sweeps


def _best(problem: Problem, planes: Array, layout: Layout) -> Array:
    """Return ``max_a sum_c w_c W_c`` over the motions allowed in each cell; 0 where there is none."""
    stored = planes.reshape(-1)

    def heading(of: Problem) -> Array:
        window = _windows(stored, of.windows, layout)
        best = jnp.zeros(layout.interior, jnp.float32)
        for a in range(len(window)):
            w, (c00, c01, c10, c11) = of.weights[a], _corners(window[a], layout)
            mean = w[0] * c00 + w[1] * c01 + w[2] * c10 + w[3] * c11
            if of.shares is not None:
                mean = mean * of.shares[2 * a // len(window)]
            mean = jnp.where((of.allowed & (1 << a)) != 0, mean, 0.0)
            best = jnp.where(mean > best, mean, best)
        return best

    return jax.lax.map(heading, problem)


def _windows(stored: Array, starts: Array, layout: Layout) -> Array:
    """Copy one contiguous piece per motion, ``(motions, interior + row + 1)``.

    A copy, not a view: sliced where they are used, XLA would read them one cell at a time on a CPU.
    """
    return jax.vmap(lambda s: jax.lax.dynamic_slice(stored, (s,), (layout.interior + layout.row + 1,)))(starts)


def _corners(window: Array, layout: Layout) -> list[Array]:
    """Return the four cells around each cell's successor, in the order of ``Problem.weights``."""
    return [window[k : k + layout.interior] for k in (0, 1, layout.row, layout.row + 1)]


def _padded(interior: Array, layout: Layout) -> Array:
    """Return flat planes with empty rows before and after."""
    margin = layout.pad * layout.row
    return jnp.pad(interior, ((0, 0), (margin, margin)))


def _interior(planes: Array, layout: Layout) -> Array:
    """Invert :func:`_padded`."""
    margin = layout.pad * layout.row
    return planes[:, margin : margin + layout.interior]
