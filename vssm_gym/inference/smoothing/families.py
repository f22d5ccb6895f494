"""Represent ``q(z_1:T)``: the variational families of a trajectory (VSSM-LM, section 4).

    z_t = perturb(mean_t, xi_t),    mean_t = perturb(nominal_t, offset_t),    xi ~ N(0, (L L^T)^-1)
    -log q(z_1:T) = -log N(xi) + sum_t log |det d perturb / d xi|(xi_t)

A family draws whole trajectories, differentiably in its parameters, and says what their entropy is. Means move in the
tangent of nominal states, so that gradient steps stay on the manifold.
:class:`MeanField` is the published one, ``q(z_1:T) = prod_t q(z_t)``. :class:`Chain` also keeps the correlations of
neighbouring steps: its precision is block-tridiagonal, as that of a chain ``p(z_1) prod_t p(z_t | z_t-1, u_t-1)`` is.
"""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.model.transition.manifold import Manifold


class Draws(NamedTuple):
    """Hold trajectories ``z ~ q(z_1:T)`` and what they say of its entropy.

    The sum of ``entropy`` over time has the mean ``E_q[-log q(z_1:T)]``. A family that knows a part of it in closed
    form states that part without noise; one that does not states ``-log q`` of its own draws.
    """

    states: Any  # a pytree with axes (samples, time, ...)
    entropy: Float[Array, "samples time"]  # nats, with respect to the volume of state space


class Marginals(NamedTuple):
    """Hold the Gaussian ``q(z_t)`` of each step: ``z_t = perturb(mean_t, xi_t)``."""

    mean: Any  # states with a leading time axis
    covariance: Float[Array, "time n n"]  # of xi_t, in the coordinates of the manifold (m, rad)


@runtime_checkable
class TrajectoryBelief(Protocol):
    """Describe ``q(z_1:T)``; an implementation is a pytree whose leaves, nominal states apart, are free parameters."""

    def draw(self, key: PRNGKeyArray, samples: int) -> Draws:
        """Draw trajectories, reparameterised: differentiable in the free parameters."""

    def marginals(self) -> Marginals:
        """Return mean and covariance of each step."""


class MeanField(eqx.Module):
    """``q(z_1:T) = prod_t q(z_t)``: independent Gaussians in the tangents at their means (VSSM-LM; eq. I54).

    Attributes:
        nominal: states with a leading time axis, about which means move; not free.
        offset: of the means, in the tangents at the nominal states (m, rad).
        log_std: of the errors, by coordinate.
        manifold: the space of the states.
    """

    nominal: Any
    offset: Float[Array, "time n"]
    log_std: Float[Array, "time n"]
    manifold: Manifold = eqx.field(static=True)

    @classmethod
    def around(cls, states: Any, std: Float[Array, "time n"], manifold: Manifold) -> "MeanField":
        """Return the family's member with given means.

        Args:
            states: the means, with a leading time axis.
            std: of the errors, in the coordinates of the manifold (m, rad).
            manifold: the space of the states.
        """
        return cls(states, jnp.zeros_like(std), jnp.log(std), manifold)

    def draw(self, key: PRNGKeyArray, samples: int) -> Draws:
        """Draw trajectories; each step is independent of the others."""
        white = jax.random.normal(key, (samples, *self.offset.shape))
        return _draws(self, white)

    def marginals(self) -> Marginals:
        """Return mean and covariance of each step; the covariances are diagonal."""
        variance = jnp.exp(2.0 * self.log_std)
        return Marginals(_means(self), variance[:, :, None] * jnp.eye(variance.shape[1]))


class Chain(eqx.Module):
    """``xi ~ N(0, (L L^T)^-1)`` with a block-bidiagonal ``L``: a Gaussian chain over the steps (eq. I55).

    With ``D_t = diag(std_t)``, blocks ``D_t^-1 (1 + N_t)`` on the diagonal of ``L``, ``N_t`` strictly lower triangular,
    and ``D_t+1^-1 B_t`` below it, the whitened errors ``w_t = D_t^-1 xi_t`` follow from ``L^T xi = eps`` backwards:

        (1 + N_t)^T w_t = eps_t - B_t^T w_t+1,    eps ~ N(0, 1)

    So ``std_t`` is the standard deviation of a step given the next one, where ``N`` is zero. All of ``N`` and ``B`` is
    without a unit, which suits solvers that make steps of one size.

    Attributes:
        nominal: states with a leading time axis, about which means move; not free.
        offset: of the means, in the tangents at the nominal states (m, rad).
        log_std: of the errors given the next step, by coordinate.
        within: ``N_t``; only what lies below its diagonal is read.
        below: ``B_t``, of step t + 1 (rows) and step t (columns).
        manifold: the space of the states.
    """

    nominal: Any
    offset: Float[Array, "time n"]
    log_std: Float[Array, "time n"]
    within: Float[Array, "time n n"]
    below: Float[Array, "steps n n"]
    manifold: Manifold = eqx.field(static=True)

    @classmethod
    def around(cls, states: Any, std: Float[Array, "time n"], manifold: Manifold) -> "Chain":
        """Return the member with given means and independent errors; arguments as in :meth:`MeanField.around`."""
        time, n = std.shape
        return cls(
            states, jnp.zeros_like(std), jnp.log(std), jnp.zeros((time, n, n)), jnp.zeros((time - 1, n, n)), manifold
        )

    def draw(self, key: PRNGKeyArray, samples: int) -> Draws:
        """Draw trajectories by back substitution, from the last step to the first."""
        eps = jax.random.normal(key, (samples, *self.offset.shape))

        def back(after: Array, now: tuple[Array, Array, Array]) -> tuple[Array, Array]:
            eps, root, below = now
            white = _solve(root, (eps - after @ below).T).T
            return white, white

        last = jnp.zeros_like(eps[:, 0])
        _, white = jax.lax.scan(back, last, (jnp.swapaxes(eps, 0, 1), *self._blocks()), reverse=True)
        return _draws(self, jnp.swapaxes(white, 0, 1))

    def marginals(self) -> Marginals:
        """Return mean and covariance of each step: the blocks on the diagonal of ``(L L^T)^-1``."""

        def back(after: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
            root, below = now
            covariance = jnp.eye(root.shape[0]) + below.T @ after @ below
            white = _solve(root, _solve(root, covariance).T)
            return white, white

        _, white = jax.lax.scan(back, jnp.zeros_like(self.within[0]), self._blocks(), reverse=True)
        std = jnp.exp(self.log_std)
        return Marginals(_means(self), std[:, :, None] * white * std[:, None, :])

    def _blocks(self) -> tuple[Array, Array]:
        """Return ``1 + N_t``, and ``B_t`` with a zero at the last step."""
        root = jnp.eye(self.within.shape[1]) + jnp.tril(self.within, -1)
        return root, jnp.concatenate([self.below, jnp.zeros_like(self.within[:1])])


def _means(family: MeanField | Chain) -> Any:
    return family.manifold.perturb(jax.lax.stop_gradient(family.nominal), family.offset)


def _draws(family: MeanField | Chain, white: Float[Array, "samples time n"]) -> Draws:
    """Return the trajectories of whitened errors; ``log |det L_tt| = -sum log std_t`` in both families."""
    xi = white * jnp.exp(family.log_std)
    gaussian = 0.5 * xi.shape[-1] * jnp.log(2.0 * jnp.pi * jnp.e) + jnp.sum(family.log_std, axis=-1)
    return Draws(family.manifold.perturb(_means(family), xi), gaussian + family.manifold.log_volume(xi))


def _solve(root: Float[Array, "n n"], right: Float[Array, "n columns"]) -> Float[Array, "n columns"]:
    """Return ``root^-T right`` of a unit lower triangular root."""
    return solve_triangular(root, right, trans=1, lower=True, unit_diagonal=True)
