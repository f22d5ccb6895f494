"""Localise a robot with a laser scanner in a model of its scans, by particles, or read the true pose (bounds only)."""

from typing import Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.agents.base import AgentContext, Observation
from vssm_gym.agents.shared.localization import Localization, TruePose
from vssm_gym.errors import InputError
from vssm_gym.inference.particles import BootstrapFilter, ParticleBelief
from vssm_gym.inference.status import Status
from vssm_gym.model.scan_emission import ScanLikelihood
from vssm_gym.model.scan_model import ScanModel
from vssm_gym.model.transition import world_covariance
from vssm_gym.model.transition.base import Transition

COVARIANCE_ROUNDING = 1e-5  # m, rad: of single precision, so that a covariance is never negative


class ScanLocalizer(Protocol):
    """Estimate the pose from the agent's own commands and scans."""

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> Localization:
        """Start at ``context.start_pose``, with the first observation seen from there."""
        ...

    def update(self, command: np.ndarray, observation: Observation) -> Localization:
        """Return the belief after ``command`` ``(turn, o, s)`` was sent and ``observation`` came back."""
        ...


class ObservedPose:
    """Read ``observation["pose"]``: the true pose, for bounds."""

    def __init__(self) -> None:
        self._true = TruePose()

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> Localization:
        """Return the true pose of the first observation."""
        return self._true.reset(context, observation)

    def update(self, command: np.ndarray, observation: Observation) -> Localization:
        """Return the true pose; the command is not used."""
        return self._true.update(command, observation)


class ParticlePose:
    """Filter the pose by particles in ``context.scan_model`` (eq. I70), whatever its map is.

    Args:
        particles: how many.
    """

    def __init__(self, particles: int) -> None:
        self._particles = particles

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> Localization:
        """Start with all particles at the known start pose."""
        if context.scan_model is None:
            raise InputError("AgentContext", "scan_model", "a model of scans: this localizer filters in one")
        self._model, self._transition, self._dt = context.scan_model, context.transition, context.dt
        self._key = jax.random.key(seed)
        start = jnp.broadcast_to(jnp.asarray(context.start_pose, jnp.float32), (self._particles, 3))
        self._belief = ParticleBelief.of(start, self._transition.manifold)
        return Localization(np.asarray(context.start_pose, np.float64), np.zeros(3), Status.OK, 0, np.zeros((3, 3)))

    def update(self, command: np.ndarray, observation: Observation) -> Localization:
        """Move the particles by the command and weigh them by the scan."""
        self._key, key = jax.random.split(self._key)
        control, ranges = jnp.asarray(command, jnp.float32), jnp.asarray(observation["scan"], jnp.float32)
        self._belief, *found = _step(self._model, self._transition, key, self._belief, control, ranges, self._dt)
        planar, std, covariance = (np.asarray(value, np.float64) for value in found)
        covariance = 0.5 * (covariance + covariance.T) + COVARIANCE_ROUNDING**2 * np.eye(3)
        return Localization(planar, std, Status.OK, 0, covariance)


@eqx.filter_jit
def _step(
    model: ScanModel,
    transition: Transition,
    key: PRNGKeyArray,
    belief: ParticleBelief,
    control: Float[Array, "3"],
    ranges: Float[Array, "beams"],
    dt: float,
) -> tuple[ParticleBelief, Array, Array, Array]:
    """Return the particles after a step, and mean, standard deviations and covariance of their Gaussian."""
    weighted = BootstrapFilter(transition).step(key, belief, control, ScanLikelihood(ranges, model), dt)
    gaussian = weighted.belief.gaussian()
    std = jnp.sqrt(jnp.maximum(jnp.diagonal(world_covariance(gaussian)), 0.0))
    return weighted.belief, gaussian.mean, std, gaussian.covariance
