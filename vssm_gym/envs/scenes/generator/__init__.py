"""Generate apartments from code: by seed, from a catalogue of furniture, and from the plans of the built-in scenes."""

from vssm_gym.envs.scenes.generator.furnish_plan import furnish_plan
from vssm_gym.envs.scenes.generator.procedural import PREFIX, SIZES, Size, generate, parse_spec, recorded_spec

__all__ = ["PREFIX", "SIZES", "Size", "furnish_plan", "generate", "parse_spec", "recorded_spec"]
