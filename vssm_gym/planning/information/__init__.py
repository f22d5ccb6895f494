"""What a robot would learn of the map on its way: entropy, and the expected information of candidate trajectories."""

from vssm_gym.planning.information.gain import Gain, InformationConfig, expected_gain, gain_of_paths
from vssm_gym.posterior import map_entropy as entropy

__all__ = ["Gain", "InformationConfig", "entropy", "expected_gain", "gain_of_paths"]
