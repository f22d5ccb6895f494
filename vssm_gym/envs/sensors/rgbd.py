"""Measure colour and depth with a robot's RGB-D camera, and choose which images of it are observed.

The renderer is shared (:mod:`vssm_gym.envs.sensors.shared_renderer`); the sensor owns its noise and its random
stream. Its state, such as the exposure, continues from episode to episode, until a seed restarts it.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from vssm_gym.envs.scenes.apartment_parts import MAX_COORDINATE
from vssm_gym.envs.sensors.base import HasCamera
from vssm_gym.envs.sensors.depth_image import depth_image
from vssm_gym.envs.sensors.rgbd_noise import NoisySensor, SensorNoise
from vssm_gym.envs.sensors.shared_renderer import SharedRenderer
from vssm_gym.errors import InputError

IMAGES = ("rgb", "depth", "depth_image")


def parse_images(source: str, value: Any) -> tuple[str, ...]:
    """Return the keyword ``images`` of the environment ``source``: some of :data:`IMAGES`, each once.

    Raises :class:`InputError` for anything else.
    """
    listed = isinstance(value, Sequence) and not isinstance(value, str)
    if not listed or len(set(map(str, value))) != len(value) or not all(one in IMAGES for one in value):
        raise InputError(source, "images", f"a list of {', '.join(IMAGES)}, each at most once; found {value!r:.80}")
    return tuple(value)


class RGBDSensor:
    """Measure ``rgb`` uint8 ``(H, W, 3)`` and ``depth`` float32 ``(H, W)``, z-depth in m, 0 = no reading.

    Args:
        renderer: the scene and its renderer.
        noise: errors added to the exact image.
        scaled: if True, measure ``depth_image`` too: uint8 ``(H, W, 1)``, the same depth as a grey image.
    """

    stream = "sensors"
    reads_contacts = False

    def __init__(self, renderer: SharedRenderer, noise: SensorNoise, scaled: bool = False) -> None:
        self.renderer, self.noise, self._scaled = renderer, noise, scaled
        size = (renderer.camera.height, renderer.camera.width)
        self.spaces: dict[str, gym.Space[Any]] = {
            "rgb": gym.spaces.Box(0, 255, (*size, 3), np.uint8),
            "depth": gym.spaces.Box(0.0, MAX_COORDINATE, size, np.float32),
        }
        if scaled:
            self.spaces["depth_image"] = gym.spaces.Box(0, 255, (*size, 1), np.uint8)
        self.parallel = renderer.parallel
        self._sensor: NoisySensor | None = None

    def seed(self, rng: np.random.Generator) -> None:
        """Restart the camera with this stream."""
        self._sensor = NoisySensor(self.noise, self.renderer.camera, rng)

    def begin(self, body: HasCamera) -> None:
        """Do nothing: exposure and stream continue."""

    def measure(self, body: HasCamera) -> dict[str, np.ndarray]:
        """Take the image, ``body.dt`` s after the one before."""
        assert self._sensor is not None
        rgb, depth = self._sensor(*self.renderer.render(body.T_world_cam), body.dt)
        return {"rgb": rgb, "depth": depth} | ({"depth_image": depth_image(depth)} if self._scaled else {})
