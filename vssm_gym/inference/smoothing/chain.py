"""``-sum_t log p(z_t | z_t-1, u_t-1)`` to second order in the errors of the states: a block-tridiagonal system.

    e_t = error(E[z_t | z_t-1, u_t-1], z_t) + A_t xi_t-1 + B_t xi_t,    W_t = Q_t^-1

The states hold a pose and what else the transition keeps, such as velocities. No image shows these, so that they are
integrated out of the system: what remains couples the poses, and the states follow from the poses afterwards.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float

from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import GaussianBelief

STEPS_ALIKE = 8  # chains are compiled for multiples of so many steps


class ChainEquations(NamedTuple):
    """Hold the quadratic cost of the states' errors, float64: its Hessian's blocks and its gradient."""

    diagonal: Float[np.ndarray, "time n n"]
    below: Float[np.ndarray, "steps n n"]  # of state t + 1 (rows) and state t (columns)
    gradient: Float[np.ndarray, "time n"]


class PoseEquations(NamedTuple):
    """Hold the cost of the poses alone, and how the rest of the states follows from them."""

    hessian: Float[np.ndarray, "poses poses"]
    gradient: Float[np.ndarray, "poses"]
    rest: Float[np.ndarray, "others"]  # errors of the rest where the poses' are zero
    by_poses: Float[np.ndarray, "others poses"]
    rest_covariance: Float[np.ndarray, "time rest rest"]  # of the rest of each state, the poses known


def chain_equations(
    transition: Transition,
    start: GaussianBelief,
    states: Any,
    controls: Float[Array, "steps control"],
    dt: Float[Array, "steps"],
) -> ChainEquations:
    """Return the cost of the states under the transition and the belief over the first one.

    Args:
        transition: how the body moves.
        start: ``p(z_1)``.
        states: to linearise about, a pytree with a leading time axis.
        controls: one for each step.
        dt: length of each step, s.
    """
    steps, more = len(dt), -len(dt) % STEPS_ALIKE
    padded = jax.tree.map(
        lambda leaf: jnp.concatenate([leaf, jnp.repeat(leaf[-1:], more, axis=0)]), (states, controls, dt)
    )
    e, A, B, W = (np.asarray(part, np.float64)[:steps] for part in _linear(transition, *padded))
    n, time = e.shape[1], len(e) + 1
    diagonal, gradient = np.zeros((time, n, n)), np.zeros((time, n))
    AW, BW = np.einsum("tki,tkl->til", A, W), np.einsum("tki,tkl->til", B, W)
    diagonal[:-1] += AW @ A
    diagonal[1:] += BW @ B
    gradient[:-1] += np.einsum("til,tl->ti", AW, e)
    gradient[1:] += np.einsum("til,tl->ti", BW, e)
    first = jax.tree.map(lambda leaf: leaf[0], states)
    P = np.linalg.inv(np.asarray(start.covariance, np.float64))
    diagonal[0] += P
    gradient[0] += P @ np.asarray(start.manifold.error(start.mean, first), np.float64)
    return ChainEquations(diagonal, BW @ A, gradient)


def of_poses(chain: ChainEquations, poses: int) -> PoseEquations:
    """Integrate what is not a pose out of a chain: the Schur complement, by a banded system.

    Args:
        chain: of the states.
        poses: coordinates of a pose, the first ones of a state.
    """
    time, n = chain.gradient.shape
    p, r = poses, n - poses
    pose_hessian = _dense(chain.diagonal[:, :p, :p], chain.below[:, :p, :p])
    if not r:
        return PoseEquations(
            pose_hessian, chain.gradient.reshape(-1), np.zeros(0), np.zeros((0, time * p)), np.zeros((time, 0, 0))
        )
    across = _dense(chain.diagonal[:, p:, :p], chain.below[:, p:, :p], chain.below[:, :p, p:])
    band = _banded(chain.diagonal[:, p:, p:], chain.below[:, p:, p:])
    right = np.column_stack([chain.gradient[:, p:].reshape(-1), across, np.eye(time * r)])
    solved = scipy.linalg.solveh_banded(band, right, lower=True, check_finite=False)
    rest, by_poses, inverse = -solved[:, 0], -solved[:, 1 : 1 + time * p], solved[:, 1 + time * p :]
    hessian, gradient = pose_hessian + across.T @ by_poses, chain.gradient[:, :p].reshape(-1) + across.T @ rest
    t = np.arange(time)
    return PoseEquations(hessian, gradient, rest, by_poses, inverse.reshape(time, r, time, r)[t, :, t])


def _dense(diagonal: np.ndarray, below: np.ndarray, above: np.ndarray | None = None) -> np.ndarray:
    """Return the matrix of blocks on the diagonal and beside it; symmetric where ``above`` is left out.

    ``above[t]`` is the transpose of the block in row t and column t + 1.
    """
    time, rows, columns = diagonal.shape
    matrix = np.zeros((time, rows, time, columns))
    t = np.arange(time)
    matrix[t, :, t] = diagonal
    matrix[t[1:], :, t[:-1]] = below
    matrix[t[:-1], :, t[1:]] = np.swapaxes(below if above is None else above, 1, 2)
    return matrix.reshape(time * rows, time * columns)


def _banded(diagonal: np.ndarray, below: np.ndarray) -> np.ndarray:
    """Return a block-tridiagonal matrix in the form of :func:`scipy.linalg.solveh_banded`, the lower one."""
    time, n, _ = diagonal.shape
    columns = np.zeros((time, 2 * n, n))
    columns[:, :n] = diagonal
    columns[:-1, n:] = below
    band = np.zeros((2 * n, time, n))
    for j in range(n):
        band[: 2 * n - j, :, j] = columns[:, j:, j].T
    return band.reshape(2 * n, time * n)


@jax.jit
def _linear(
    transition: Transition, states: Any, controls: Array, dt: Array
) -> tuple[Float[Array, "steps n"], Float[Array, "steps n n"], Float[Array, "steps n n"], Float[Array, "steps n n"]]:
    """Return errors, their derivatives by the errors of both states, and the precision, of each step."""
    manifold = transition.manifold
    zero = jnp.zeros(len(manifold.turns))

    def one(before: Any, after: Any, control: Array, dt: Array) -> tuple[Array, Array, Array, Array]:
        def error(xi: Array, eta: Array) -> Array:
            expected = transition.expected(manifold.perturb(before, xi), control, dt)
            return manifold.error(expected, manifold.perturb(after, eta))

        A, B = jax.jacfwd(error, (0, 1))(zero, zero)
        return error(zero, zero), A, B, jnp.linalg.inv(transition.noise_covariance(before, control, dt))

    before, after = (jax.tree.map(lambda leaf, s=s: leaf[s], states) for s in (slice(None, -1), slice(1, None)))
    return jax.vmap(one)(before, after, controls, dt)
