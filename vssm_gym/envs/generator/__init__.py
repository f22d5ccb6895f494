"""Apartments from code: the seeded generator, the catalogue of furniture and the plans of the built-in scenes."""

from vssm_gym.envs.generator.procedural import SIZES, Size, generate, parse_spec

__all__ = ["SIZES", "Size", "generate", "parse_spec"]
