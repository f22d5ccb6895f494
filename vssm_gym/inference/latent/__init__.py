"""Infer the pose of a robot with a laser scanner and a latent map of its plane (DVBF-LM)."""

from vssm_gym.inference.latent.config import LatentConfig

__all__ = ["LatentConfig"]
