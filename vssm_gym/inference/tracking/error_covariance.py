"""``e_t = A (F e_t-1 + w) + K (G u_t + v)``: how the errors of a filter follow from all that it was given (ours).

The alignment's errors are not independent between images: the surfaces that poses are aligned to stay displaced, and
what an image writes into a map keeps the error of its pose. Beside the covariance of the state, the filter therefore
keeps its covariance with the errors of surfaces and with the drift of the map's frame, neither of which it estimates:
they are considered, as in Schmidt's filter ("Application of state-space methods to navigation problems", 1966).
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.geometry.transforms import inverse, se3_adjoint
from vssm_gym.inference.alignment.surface_error import SLOTS, Influence
from vssm_gym.model.transition.belief import GaussianBelief

ERRORS = 2 * SLOTS  # unit errors of surfaces: a displacement and an error of colour for each slot


class Considered(eqx.Module):
    """Hold covariances of what is considered but not estimated; those of the unit surface errors are the identity.

    ``d`` is the drift of the map's frame around the body, in the world's tangent, ``e`` the error of the state against
    the map, ``u`` the surfaces' errors.
    """

    drift: Float[Array, "6 6"]  # cov(d, d)
    drift_state: Float[Array, "6 n"]  # cov(d, e)
    state_surfaces: Float[Array, "n errors"]  # cov(e, u)
    drift_surfaces: Float[Array, "6 errors"]  # cov(d, u)

    def predict(self, F: Float[Array, "n n"], kept: Float[Array, ""]) -> "Considered":
        """Return the covariances after a step; the surfaces' errors keep the share ``kept``, the rest is new."""
        return Considered(
            self.drift, self.drift_state @ F.T, kept * F @ self.state_surfaces, kept * self.drift_surfaces
        )

    def correct(
        self, covariance: Float[Array, "n n"], A: Float[Array, "n n"], K: Float[Array, "n p"], given: Influence
    ) -> tuple[Float[Array, "n n"], "Considered"]:
        """``A P A^T + A C G K^T + (...)^T + K (G^T G + N) K^T``: covariances after ``e <- A e + K g`` (eq. I17).

        Args:
            covariance: P of the state, predicted.
            A: What the estimator leaves of an error.
            K: What it makes of the gradient's error.
            given: Errors of the gradient.
        """
        G = given.surfaces
        cross = A @ (self.state_surfaces @ G) @ K.T
        after = A @ covariance @ A.T + cross + cross.T + K @ given.covariance @ K.T
        return 0.5 * (after + after.T), Considered(
            self.drift,
            self.drift_state @ A.T + (self.drift_surfaces @ G) @ K.T,
            A @ self.state_surfaces + K @ G.T,
            self.drift_surfaces,
        )

    def write(self, belief: GaussianBelief, share: Float[Array, ""]) -> "Considered":
        """``d <- d + nu Ad_T e``: the map takes over the error of the pose that it is written at (eq. I23).

        Args:
            belief: Over the state against the map.
            share: nu, of the map in view that is written.
        """
        carry = share * _world_twists(belief)
        p = carry.shape[1]
        new = carry @ self.drift_state[:, :p].T
        return Considered(
            self.drift + new + new.T + carry @ belief.covariance[:p, :p] @ carry.T,
            self.drift_state + carry @ belief.covariance[:p],
            self.state_surfaces,
            self.drift_surfaces + carry @ self.state_surfaces[:p],
        )

    def in_world(self, belief: GaussianBelief) -> GaussianBelief:
        """Return the belief in the world, drift included, from the belief against the map (eq. I24)."""
        twists = belief.manifold.twists
        n, p = len(belief.covariance), twists.shape[1]
        # For a robot on a floor only drift within the floor's plane matters: twists are orthonormal.
        pose = twists.T @ se3_adjoint(inverse(belief.manifold.pose(belief.mean)))
        carry = jnp.zeros((n, 6)).at[:p].set(pose)
        both = carry @ self.drift_state
        covariance = belief.covariance + carry @ self.drift @ carry.T + both + both.T
        return eqx.tree_at(lambda q: q.covariance, belief, covariance)


def nothing(n: int) -> Considered:
    """Return the covariances of a state of ``n`` coordinates whose errors have nothing to do with drift or surfaces."""
    return Considered(jnp.zeros((6, 6)), jnp.zeros((6, n)), jnp.zeros((n, ERRORS)), jnp.zeros((6, ERRORS)))


def estranged(considered: Considered) -> Considered:
    """Return the same drift, of which a new state's error is independent."""
    n = considered.drift_state.shape[1]
    return eqx.tree_at(lambda c: c.drift, nothing(n), considered.drift)


def _world_twists(belief: GaussianBelief) -> Float[Array, "6 p"]:
    """Return the twists of the world in which a body moves along each coordinate of its tangent."""
    return se3_adjoint(belief.manifold.pose(belief.mean)) @ belief.manifold.twists
