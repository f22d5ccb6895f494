"""Filter by particles that are moved by the transition and weighed by the observation (Gordon et al., 1993; eq. I70).

    z_t^i ~ p(z_t | z_t-1^i, u_t-1),    w_t^i = w_t-1^i p(x_t | z_t^i, M)

The map enters through the likelihood: the mean of a belief, or a draw, so that the outer expectation over ``q(M)`` of
DVBF-LM is one over likelihoods. As their number grows the particles tend to ``p(z_t | x_1:t, u_1:t-1, M)``.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.errors import InputError
from vssm_gym.inference.particles.belief import ParticleBelief
from vssm_gym.inference.particles.weights import normalised
from vssm_gym.model.transition.base import Transition


@runtime_checkable
class StateLikelihood(Protocol):
    """Describe ``p(x | z)`` of one observation as a function of the state; an implementation is a pytree."""

    def log_prob(self, state: Any) -> Float[Array, "*batch"]:
        """Return ``log p(x | z)`` of states with leading batch axes, nats."""


class Weighted(NamedTuple):
    """Hold the outcome of a step."""

    belief: ParticleBelief  # after the observation
    log_evidence: Float[Array, ""]  # estimates log p(x_t | x_1:t-1); the sum over steps, exponentiated, has no bias


@dataclass(frozen=True)
class BootstrapFilter:
    """Move and weigh particles; draw them anew where few count.

    Args:
        transition: of the states.
        least: share of the particles that must count; below it they are resampled before they move.
    """

    transition: Transition
    least: float = 0.5

    def __post_init__(self) -> None:
        if not 0.0 <= self.least <= 1.0:
            raise InputError("BootstrapFilter", "least", f"a share between 0 and 1, not {self.least}")

    def step(
        self,
        key: PRNGKeyArray,
        belief: ParticleBelief,
        control: Float[Array, "m"],
        likelihood: StateLikelihood,
        dt: float | Array,
    ) -> Weighted:
        """Return the belief after one more control and one more observation.

        Args:
            key: random key.
            belief: before them.
            control: of the transition.
            likelihood: of the observation.
            dt: length of the step, s.
        """
        by_choice, by_motion = jax.random.split(key)
        n = len(belief.log_weight)
        few = belief.effective < self.least * n
        pick = partial(jax.tree.map, lambda a, b: jnp.where(few, a, b))
        start = pick(belief.resampled(by_choice), belief)
        moved = self.transition.sample(by_motion, start.states, jnp.broadcast_to(control, (n, *control.shape)), dt)
        before = normalised(start.log_weight)
        joint = before + likelihood.log_prob(moved)
        evidence = jax.scipy.special.logsumexp(joint)
        return Weighted(ParticleBelief(moved, normalised(joint), belief.manifold), evidence)

    def observe(self, belief: ParticleBelief, likelihood: StateLikelihood) -> Weighted:
        """Return the belief after an observation without a motion before it: the first one."""
        joint = normalised(belief.log_weight) + likelihood.log_prob(belief.states)
        evidence = jax.scipy.special.logsumexp(joint)
        return Weighted(ParticleBelief(belief.states, normalised(joint), belief.manifold), evidence)
