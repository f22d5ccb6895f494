"""Apartments from code: the seeded generator, the catalogue of furniture and the plans of the built-in scenes."""

from vssm_gym.envs.scenes.generator.procedural import PREFIX, SIZES, Size, generate, parse_spec

__all__ = ["PREFIX", "SIZES", "Size", "generate", "parse_spec"]
