"""Measure the robot's pose relative to its start: the GPS and compass of the PointNav literature.

    gps     = R(heading_0)^T (xy - xy_0) + e,    e ~ N(0, position^2 I)       x forward, y left at the start, m
    compass = heading - heading_0 + e_h,         e_h ~ N(0, heading^2)        counter-clockwise, rad, in [-pi, pi)

``(xy_0, heading_0)`` is the body's pose when the episode began. Errors are independent from step to step.

Habitat's ``gps`` of dimensionality 2 is ``(-z, x)`` of its frame with x right, y up and -z forward: forward, then
*right*. Its ``compass`` is the direction of the start's forward axis as the agent sees it, positive to the right, which
is the angle that the agent has turned to the left: our sign. :class:`HabitatGps` converts the observation accordingly
(``EpisodicGPSSensor`` and ``EpisodicCompassSensor`` of habitat-lab, ``habitat/tasks/nav/nav.py``).
"""

import math
from dataclasses import dataclass, fields
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv, VectorObservationWrapper

from vssm_gym.envs.presets import Presets
from vssm_gym.envs.scenes.apartment_parts import MAX_COORDINATE
from vssm_gym.envs.sensors.base import GroundBody
from vssm_gym.envs.sensors.shared_renderer import SharedRenderer
from vssm_gym.errors import InputError
from vssm_gym.geometry.axes import PlanarPose
from vssm_gym.geometry.transforms import wrap_angle

FARTHEST = 4.0 * MAX_COORDINATE  # m, bound of a coordinate: a scene's diagonal, in any direction, and its error


@dataclass(frozen=True)
class GpsCompassNoise:
    """Define the standard deviations of one measurement."""

    position: float = 0.0  # m, of each coordinate
    heading: float = 0.0  # rad

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not 0.0 <= value < math.inf:
                raise InputError("GpsCompassNoise", field.name, f"a finite standard deviation >= 0, not {value!r}")


# Chosen, not measured: an indoor positioning system of ultra-wideband anchors errs by about the highest.
PRESETS = {
    "none": GpsCompassNoise(),
    "low": GpsCompassNoise(0.02, math.radians(0.5)),
    "mid": GpsCompassNoise(0.05, math.radians(1.0)),
    "high": GpsCompassNoise(0.10, math.radians(2.0)),
}

gps_compass_noise = Presets("gps_compass", "noise", GpsCompassNoise, PRESETS)


@dataclass(frozen=True)
class GpsCompassConfig:
    """Configure a GPS and compass; ``noise`` may also be the name of a preset or a mapping of its fields."""

    noise: GpsCompassNoise = GpsCompassNoise()

    def __post_init__(self) -> None:
        object.__setattr__(self, "noise", gps_compass_noise(self.noise))

    def mount(self, renderer: SharedRenderer) -> "GpsCompassSensor":
        """Build the sensor; it does not use the scene."""
        return GpsCompassSensor(self)


class GpsCompassSensor:
    """Measure ``gps`` float32 ``(2,)``, m, and ``compass`` float32 ``(1,)``, rad, relative to the start.

    See the module.
    """

    stream = "gps_compass"
    parallel = True
    reads_contacts = False

    def __init__(self, config: GpsCompassConfig) -> None:
        self.config = config
        self.spaces: dict[str, gym.Space[Any]] = {
            "gps": gym.spaces.Box(-FARTHEST, FARTHEST, (2,), np.float32),
            "compass": gym.spaces.Box(-np.pi, np.pi, (1,), np.float32),
        }
        self._rng: np.random.Generator | None = None
        self._start: PlanarPose = np.zeros(3)

    def seed(self, rng: np.random.Generator) -> None:
        """Draw errors from this stream."""
        self._rng = rng

    def begin(self, body: GroundBody) -> None:
        """Set the origin to the body's present pose."""
        self._start = body.planar.copy()

    def measure(self, body: GroundBody) -> dict[str, np.ndarray]:
        """Measure once; every call draws three normals."""
        assert self._rng is not None
        noise, normals = self.config.noise, self._rng.standard_normal(3)
        x0, y0, heading0 = self._start
        x, y, heading = body.planar
        c, s = math.cos(heading0), math.sin(heading0)
        forward, left = c * (x - x0) + s * (y - y0), c * (y - y0) - s * (x - x0)
        gps = np.array([forward, left]) + noise.position * normals[:2]
        compass = wrap_angle(heading - heading0 + noise.heading * normals[2])
        return {
            "gps": np.clip(gps, -FARTHEST, FARTHEST).astype(np.float32),
            "compass": np.array([compass], dtype=np.float32),
        }


def habitat_order(observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Convert ``gps (*batch, 2)`` from (forward, left) to Habitat's (forward, right), m; other keys stay."""
    return observation | {"gps": observation["gps"] * np.array([1.0, -1.0], np.float32)}


class HabitatGps(gym.ObservationWrapper[Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Observe ``gps`` and ``compass`` in Habitat's order and signs: (forward, right) in m; counter-clockwise in rad.

    Args:
        env: an environment with ``sensors=["gps_compass"]``.
    """

    def __init__(self, env: gym.Env) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        super().__init__(env)
        _check(env.observation_space)

    def observation(self, observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the observation in Habitat's order."""
        return habitat_order(observation)


class VectorHabitatGps(VectorObservationWrapper):
    """Observe ``gps`` and ``compass`` in Habitat's order and signs, for vector environments."""

    def __init__(self, env: VectorEnv) -> None:
        super().__init__(env)
        _check(env.single_observation_space)

    def observations(self, observations: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the observations in Habitat's order."""
        return habitat_order(observations)


def _check(space: gym.Space) -> None:
    if not isinstance(space, gym.spaces.Dict) or "gps" not in space.spaces:
        raise InputError("HabitatGps", "env", f"an environment with sensors=['gps_compass']; found {space!s:.80}")
