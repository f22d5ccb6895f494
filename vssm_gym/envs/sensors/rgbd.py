"""Measure colour and depth with a robot's RGB-D camera.

The renderer is shared (:mod:`vssm_gym.envs.sensors.shared_renderer`); the sensor owns its noise and its random
stream. Its state, such as the exposure, continues from episode to episode, until a seed restarts it.
"""

from typing import Any

import gymnasium as gym
import numpy as np

from vssm_gym.envs.scenes.apartment_parts import MAX_COORDINATE
from vssm_gym.envs.sensors.base import HasCamera
from vssm_gym.envs.sensors.rgbd_noise import NoisySensor, SensorNoise
from vssm_gym.envs.sensors.shared_renderer import SharedRenderer


class RGBDSensor:
    """Measure ``rgb`` uint8 ``(H, W, 3)`` and ``depth`` float32 ``(H, W)``, z-depth in m, 0 = no reading.

    Args:
        renderer: the scene and its renderer.
        noise: errors added to the exact image.
    """

    stream = "sensors"
    reads_contacts = False

    def __init__(self, renderer: SharedRenderer, noise: SensorNoise) -> None:
        self.renderer, self.noise = renderer, noise
        size = (renderer.camera.height, renderer.camera.width)
        self.spaces: dict[str, gym.Space[Any]] = {
            "rgb": gym.spaces.Box(0, 255, (*size, 3), np.uint8),
            "depth": gym.spaces.Box(0.0, MAX_COORDINATE, size, np.float32),
        }
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
        return {"rgb": rgb, "depth": depth}
