"""Infer the pose of a robot with a laser scanner and the map of its plane, scan by scan: PRISM in two dimensions."""

from vssm_gym.inference.planar.filter import PlanarPrism, PlanarState, ScanInfo

__all__ = ["PlanarPrism", "PlanarState", "ScanInfo"]
