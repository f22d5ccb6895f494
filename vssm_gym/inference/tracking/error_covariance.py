"""``e_t = A (F e_t-1 + w) + K (G^T u_t + v)``: how the errors of a filter follow from all that it was given (ours).

The alignment's errors are not independent between images: the surfaces that poses are aligned to stay displaced, and
what an image writes into a map keeps the error of its pose. Beside the covariance of the state, the filter therefore
keeps its covariance with the errors of surfaces and with the drift of the map's frame, neither of which it estimates:
they are considered, as in Schmidt's filter ("Application of state-space methods to navigation problems", 1966).
"""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.geometry.transforms import inverse, se3_adjoint
from vssm_gym.inference.alignment.surface_error import SLOTS, Influence
from vssm_gym.model.transition.belief import GaussianBelief

ERRORS = 2 * SLOTS  # unit errors of surfaces: a displacement and an error of colour for each slot


class Considered(eqx.Module):
    """Hold covariances of what is considered but not estimated; those of the unit surface errors are the identity.

    ``e`` is the error of the state against the reference view, in its tangent, and ``u`` are the surfaces' errors.
    ``d`` and ``m``, stacked, are errors of two frames, in the world's tangent: of the map as the reference view shows
    it, and of the map as it is by now.
    """

    frames: Float[Array, "12 12"]  # cov((d, m), (d, m))
    frames_state: Float[Array, "12 n"]  # cov((d, m), e)
    state_surfaces: Float[Array, "n errors"]  # cov(e, u)
    frames_surfaces: Float[Array, "12 errors"]  # cov((d, m), u)

    def joint(self, covariance: Float[Array, "n n"]) -> Float[Array, "all all"]:
        """Return the covariance of the state, of the frames and of the surfaces' errors, in this order.

        Args:
            covariance: of the state.
        """
        surfaces = jnp.eye(self.state_surfaces.shape[1])
        return jnp.block(
            [
                [covariance, self.frames_state.T, self.state_surfaces],
                [self.frames_state, self.frames, self.frames_surfaces],
                [self.state_surfaces.T, self.frames_surfaces.T, surfaces],
            ]
        )

    @property
    def drift(self) -> Float[Array, "6 6"]:
        """Return the covariance of the map's frame in the world."""
        return self.frames[6:, 6:]

    def predict(self, F: Float[Array, "n n"], kept: Float[Array, ""]) -> "Considered":
        """Return the covariances after a step; the surfaces' errors keep the share ``kept``, the rest is new."""
        return Considered(
            self.frames, self.frames_state @ F.T, kept * F @ self.state_surfaces, kept * self.frames_surfaces
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
            self.frames,
            self.frames_state @ A.T + (self.frames_surfaces @ G) @ K.T,
            A @ self.state_surfaces + K @ G.T,
            self.frames_surfaces,
        )

    def write(self, belief: GaussianBelief, share: Float[Array, ""]) -> "Considered":
        """``m <- (1 - nu) m + nu (d + Ad_T e)``: the map takes over a share of the pose's error in the world (eq. I23).

        The error of the pose in the world, ``d + Ad_T e``, stays as it is.

        Args:
            belief: Over the state against the reference view.
            share: nu, of the map in view that is written.
        """
        one, twists = jnp.eye(6), _world_twists(belief)
        kept = jnp.block([[one, 0.0 * one], [share * one, (1.0 - share) * one]])
        new = jnp.concatenate([jnp.zeros_like(twists), share * twists])
        p = twists.shape[1]
        both = kept @ self.frames_state[:, :p] @ new.T
        return Considered(
            kept @ self.frames @ kept.T + both + both.T + new @ belief.covariance[:p, :p] @ new.T,
            kept @ self.frames_state + new @ belief.covariance[:p],
            self.state_surfaces,
            kept @ self.frames_surfaces + new @ self.state_surfaces[:p],
        )

    def renew(self, belief: GaussianBelief) -> "tuple[GaussianBelief, Considered]":
        """``e <- e + Ad_T^-1 (d - m),  d <- m``: the belief against a new view of the map (eq. I24).

        Args:
            belief: Over the state against the old one.
        """
        n, pose = len(belief.covariance), _body_coordinates(belief)
        apart = jnp.zeros((n, 12)).at[: len(pose)].set(jnp.concatenate([pose, -pose], axis=1))
        both = apart @ self.frames_state
        covariance = belief.covariance + apart @ self.frames @ apart.T + both + both.T
        state = self.frames_state[6:] + self.frames[6:] @ apart.T
        surfaces = self.frames_surfaces[6:]
        return eqx.tree_at(lambda q: q.covariance, belief, 0.5 * (covariance + covariance.T)), Considered(
            jnp.tile(self.drift, (2, 2)),
            jnp.concatenate([state, state]),
            self.state_surfaces + apart @ self.frames_surfaces,
            jnp.concatenate([surfaces, surfaces]),
        )

    def in_world(self, belief: GaussianBelief) -> GaussianBelief:
        """``e + Ad_T^-1 d``: return the belief in the world from that against the reference view (eq. I24)."""
        # For a robot on a floor only drift within the floor's plane matters: twists are orthonormal.
        n, pose = len(belief.covariance), _body_coordinates(belief)
        carry = jnp.zeros((n, 6)).at[: len(pose)].set(pose)
        both = carry @ self.frames_state[:6]
        covariance = belief.covariance + carry @ self.frames[:6, :6] @ carry.T + both + both.T
        return eqx.tree_at(lambda q: q.covariance, belief, covariance)


def nothing(n: int) -> Considered:
    """Return the covariances of a state of ``n`` coordinates whose errors are independent of frames and surfaces."""
    return Considered(jnp.zeros((12, 12)), jnp.zeros((12, n)), jnp.zeros((n, ERRORS)), jnp.zeros((12, ERRORS)))


def estranged(considered: Considered) -> Considered:
    """Return the same drift of the map, of which the error of a new state against a new view of it is independent."""
    none, drift = nothing(considered.frames_state.shape[1]), considered.drift
    return replace(none, frames=jnp.tile(drift, (2, 2)))


def _world_twists(belief: GaussianBelief) -> Float[Array, "6 p"]:
    """Return the twists of the world in which a body moves along each coordinate of its tangent."""
    return se3_adjoint(belief.manifold.pose(belief.mean)) @ jnp.asarray(belief.manifold.twists)


def _body_coordinates(belief: GaussianBelief) -> Float[Array, "p 6"]:
    """Return what a twist of the world is in each coordinate of the body's tangent."""
    return jnp.asarray(belief.manifold.twists.T) @ se3_adjoint(inverse(belief.manifold.pose(belief.mean)))
