"""Compute what a robot would learn of its map: entropy, and the expected information of candidate trajectories."""

from vssm_gym.model.posterior import map_entropy as entropy
from vssm_gym.planning.exploration.information.gain import Gain, InformationConfig, expected_gain, gain_of_paths

__all__ = ["Gain", "InformationConfig", "entropy", "expected_gain", "gain_of_paths"]
