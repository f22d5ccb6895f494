"""What every transition ``p(z' | z, u)`` offers the model, and the Gaussian in a tangent space that they share.

A density on a group is taken with respect to its own volume: metres along each axis times the angle turned. Where
``T = T_mean exp(xi)`` and ``xi`` is Gaussian, that is ``p(T) = N(xi) / |det Jr(xi)|``, ``Jr`` the right Jacobian.
"""

from typing import Protocol, TypeVar, runtime_checkable

import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, PRNGKeyArray

QUOTED_STEP = 0.1  # s: standard deviations are quoted for steps this long; variances grow with time (SPEC 1)

State = TypeVar("State")
Mean = TypeVar("Mean", covariant=True)


@runtime_checkable
class Transition(Protocol[State]):
    """``p(z' | z, u)`` with its step length and noise inside; every method takes leading batch axes."""

    def sample(self, key: PRNGKeyArray, state: State, control: Array) -> State:
        """``z' ~ p(z' | z, u)``: one independent draw for each state of the batch."""

    def log_prob(self, following: State, state: State, control: Array) -> Array:
        """``log p(z' | z, u)``."""

    def pose(self, state: State) -> Array:
        """``T_world_body`` (..., 4, 4) of a state."""

    def perturb(self, state: State, xi: Array) -> State:
        """The state an error ``xi`` (..., n) away, in the coordinates in which beliefs are Gaussian."""

    def error(self, mean: State, state: State) -> Array:
        """``xi`` with ``perturb(mean, xi) = state``."""

    def log_volume(self, xi: Array) -> Array:
        """``log |det d perturb / d xi|``: volume of state space per volume of errors."""


@runtime_checkable
class Belief(Protocol[Mean]):
    """``N(mean, covariance)``, the covariance that of a transition's errors."""

    @property
    def mean(self) -> Mean:
        """The state the errors are measured from."""

    @property
    def covariance(self) -> Array:
        """``(n, n)``."""


def normal_log_prob(xi: Float[Array, "*batch n"], covariance: Float[Array, "*shared n n"]) -> Float[Array, "*batch"]:
    """``log N(xi; 0, covariance)``, one covariance for all or one each; NaN where it is not positive definite."""
    root = jnp.linalg.cholesky(covariance)
    whitener = solve_triangular(root, jnp.broadcast_to(jnp.eye(xi.shape[-1]), root.shape), lower=True)
    white = jnp.einsum("...ij,...j->...i", whitener, xi)
    log_det = jnp.sum(jnp.log(jnp.diagonal(root, axis1=-2, axis2=-1)), axis=-1)
    return -0.5 * jnp.sum(white**2, axis=-1) - log_det - 0.5 * xi.shape[-1] * jnp.log(2.0 * jnp.pi)


def turn_log_volume(angle2: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """``log(2 (1 - cos a) / a^2)`` of the squared angle: ``log |det Jr|`` of SO(3) and of SE(2), half that of SE(3)."""
    near = angle2 < 1e-2
    safe2 = jnp.where(near, 1.0, angle2)
    far = jnp.log(jnp.maximum(2.0 * (1.0 - jnp.cos(jnp.sqrt(safe2))) / safe2, 1e-12))
    return jnp.where(near, -angle2 / 12.0 - angle2**2 / 1440.0, far)
