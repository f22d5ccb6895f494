"""Extend a state space by a latent rest: ``z = (body, rest)``, the rest a vector that no pose shows.

The rest absorbs what a pose and its velocities leave out: the lag of an actuator, a drifting bias (VSSM-LM).
"""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vssm_gym.model.transition.manifold import Manifold


class RestState(eqx.Module):
    """Represent a body and a latent rest.

    Attributes:
        body: a state of the body's manifold.
        rest: without a unit; of about unit size, since its prior is ``N(0, 1)``.
    """

    body: Any
    rest: Float[Array, "*batch r"]


@dataclass(frozen=True)
class WithRest:
    """Describe ``body x R^size``: :class:`RestState`; errors list the body's coordinates, then the rest's.

    Attributes:
        body: the space of poses, and of velocities where it has them.
        size: dimensions of the rest.
    """

    body: Manifold
    size: int

    @property
    def twists(self) -> np.ndarray:
        """Return the twists of the body's pose, whose coordinates come first."""
        return self.body.twists

    @property
    def turns(self) -> np.ndarray:
        """Return those of the body; no coordinate of the rest is an angle."""
        return np.concatenate([self.body.turns, np.zeros(self.size, bool)])

    def perturb(self, state: RestState, xi: Float[Array, "*batch n"]) -> RestState:
        """Move the body by its part of the error, and add the remainder to the rest."""
        split = len(self.body.turns)
        return RestState(self.body.perturb(state.body, xi[..., :split]), state.rest + xi[..., split:])

    def error(self, mean: RestState, state: RestState) -> Float[Array, "*batch n"]:
        """Return the body's error, followed by the difference of the rests."""
        of_body = self.body.error(mean.body, state.body)
        of_rest = jnp.broadcast_to(state.rest - mean.rest, (*of_body.shape[:-1], self.size))
        return jnp.concatenate([of_body, of_rest], axis=-1)

    def log_volume(self, xi: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
        """Return that of the body; the rest is a vector space."""
        return self.body.log_volume(xi[..., : len(self.body.turns)])

    def pose(self, state: RestState) -> Float[Array, "*batch 4 4"]:
        """Return ``T_world_body``."""
        return self.body.pose(state.body)

    def resting(self, T_world_body: Float[Array, "4 4"]) -> RestState:
        """Return a body that does not move, with the rest at its prior mean of zero."""
        return RestState(self.body.resting(T_world_body), jnp.zeros(self.size))
