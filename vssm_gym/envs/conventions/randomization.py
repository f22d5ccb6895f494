"""Draw what varies from episode to episode of an environment: scene, noise, camera height, field of view and light.

    scene ~ U{scenes}      noise = (1 - u) low + u high,  u ~ U(0, 1)      camera height, hfov, light ~ U(low, high)

The draws are those of a stream of its own (:mod:`vssm_gym.envs.streams`): every episode draws five numbers, whatever
varies, so that adding one quantity changes no other, and none of them changes the tasks or the noise that follow.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np

from vssm_gym.envs.presets import Presets
from vssm_gym.errors import InputError

STREAM = "randomization"
# The least and the most that each range may hold.
_LIMITS = {
    "camera_height": (0.02, 3.0, "m"),
    "hfov": (0.1, 3.0, "rad"),
    "light": (0.05, 4.0, "times the light"),
}


class Variation(NamedTuple):
    """Hold the draw of one episode; None where the environment's own value holds."""

    scene: int | None = None  # index in the scenes
    noise: float | None = None  # u
    camera_height: float | None = None  # m
    hfov: float | None = None  # rad
    light: float | None = None  # factor on all colours


@dataclass(frozen=True)
class Randomization:
    """Define what varies between episodes.

    Attributes:
        scene: scenes of which each episode takes one, in place of the keyword ``scene``.
        noise: two noise levels; each episode's parameters are between theirs.
        camera_height: lowest and highest camera, m above the floor.
        hfov: narrowest and widest horizontal field of view, rad.
        light: weakest and strongest light, as a factor on the colours.
    """

    scene: Sequence[Any] = ()
    noise: Sequence[Any] | None = None
    camera_height: Sequence[float] | None = None
    hfov: Sequence[float] | None = None
    light: Sequence[float] | None = None

    def __post_init__(self) -> None:
        if isinstance(self.scene, str | Mapping) or not isinstance(self.scene, Sequence):
            raise InputError("randomize", "scene", f"a list of scenes; found {self.scene!r:.80}")
        pair = isinstance(self.noise, Sequence) and not isinstance(self.noise, str) and len(self.noise) == 2
        if self.noise is not None and not pair:
            raise InputError("randomize", "noise", f"two noise levels; found {self.noise!r:.80}")
        for name, (least, most, unit) in _LIMITS.items():
            value = getattr(self, name)
            if value is not None and not _is_range(value, least, most):
                expected = f"two numbers, low <= high, from {least} to {most} {unit}; found {value!r:.80}"
                raise InputError("randomize", name, expected)

    def draw(self, rng: np.random.Generator) -> Variation:
        """Draw one episode."""
        scene, *rest = rng.random(5)
        u, height, hfov, light = (float(one) for one in rest)
        between = lambda ends, at: None if ends is None else float(ends[0] + at * (ends[1] - ends[0]))
        return Variation(
            scene=int(scene * len(self.scene)) if self.scene else None,
            noise=None if self.noise is None else u,
            camera_height=between(self.camera_height, height),
            hfov=between(self.hfov, hfov),
            light=between(self.light, light),
        )

    def noises(self, parse: Callable[[Any], Any]) -> tuple[Any, Any] | None:
        """Return the ends of the noise range, parsed by the robot; None where the noise does not vary."""
        if self.noise is None:
            return None
        low, high = parse(self.noise[0]), parse(self.noise[1])
        if type(low) is not type(high):
            raise InputError("randomize", "noise", f"two noise levels of one law; found {self.noise!r:.80}")
        return low, high


parse_randomization = Presets("environment", "randomize", Randomization, {}, default=Randomization())


def between_noises(low: Any, high: Any, u: float) -> Any:
    """Return the noise whose every parameter is ``(1 - u) low + u high``; both are one dataclass."""
    mix = lambda a, b: (1.0 - u) * a + u * b
    ends = {one.name: (getattr(low, one.name), getattr(high, one.name)) for one in fields(low)}
    mixed = {name: tuple(map(mix, a, b)) if isinstance(a, tuple) else mix(a, b) for name, (a, b) in ends.items()}
    return replace(low, **mixed)


def light_table(light: float) -> np.ndarray:
    """Return the byte of each byte under ``light`` times the light; uint8 ``(256,)``."""
    return np.clip(np.rint(light * np.arange(256)), 0, 255).astype(np.uint8)


def _is_range(value: Any, least: float, most: float) -> bool:
    if isinstance(value, str) or not isinstance(value, Sequence) or len(value) != 2:
        return False
    if any(isinstance(one, bool) or not isinstance(one, int | float) or not math.isfinite(one) for one in value):
        return False
    return bool(least <= value[0] <= value[1] <= most)
