"""Represent a belief by weighted states, where a Gaussian cannot: several places that look alike."""

from vssm_gym.inference.particles.belief import ParticleBelief
from vssm_gym.inference.particles.bootstrap import BootstrapFilter, Weighted

__all__ = ["BootstrapFilter", "ParticleBelief", "Weighted"]
