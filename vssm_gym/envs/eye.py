"""One robot's RGB-D camera: an image is rendered and measured once a pose, however often it is asked for.

Its renderer is shared (:mod:`vssm_gym.envs.scenery`); what is its own is the sensor's random stream and the last image.
"""

from typing import Any

import gymnasium as gym
import numpy as np

from vssm_gym.axes import Matrix4
from vssm_gym.envs.scenery import Scenery
from vssm_gym.envs.sensor_noise import NoisySensor, SensorNoise

EXTENT = 1000.0  # m, bound of depths and coordinates: the same for all scenes, so that a policy fits each
PICTURE = 360  # pixels, height of a rendered picture and width of its plan


class Eye:
    """A camera in a scene, on a robot; see the module.

    Args:
        scenery: what is seen, and the renderer.
        noise: what the sensor adds to the exact image.
    """

    def __init__(self, scenery: Scenery, noise: SensorNoise) -> None:
        self.scenery, self.noise, self.camera = scenery, noise, scenery.camera
        self._sensor: NoisySensor | None = None
        self._image: tuple[np.ndarray, np.ndarray] | None = None

    def spaces(self) -> dict[str, gym.Space[Any]]:
        """The spaces of :meth:`observation`."""
        size = (self.camera.height, self.camera.width)
        return {
            "rgb": gym.spaces.Box(0, 255, (*size, 3), np.uint8),
            "depth": gym.spaces.Box(0.0, EXTENT, size, np.float32),
        }

    def seed(self, rng: np.random.Generator) -> None:
        """Measure with a new sensor, whose noise is of this stream."""
        self._sensor = NoisySensor(self.noise, self.camera, rng)

    def moved(self) -> None:
        """The robot has moved: the next look takes a new image."""
        self._image = None

    def look(self, T_world_cam: Matrix4, dt: float) -> None:
        """Take the image, ``dt`` s after the one before, unless there is one since the robot moved."""
        if self._image is None:
            assert self._sensor is not None
            self._image = self._sensor(*self.scenery.render(T_world_cam), dt)

    @property
    def rgb(self) -> np.ndarray:
        """The colour image taken last, uint8 ``(H, W, 3)``; not to be changed."""
        assert self._image is not None
        return self._image[0]

    def observation(self) -> dict[str, np.ndarray]:
        """``rgb`` uint8 ``(H, W, 3)`` and ``depth`` float32 ``(H, W)``, m, 0 = no reading; the caller's own copies."""
        assert self._image is not None
        return {"rgb": self._image[0].copy(), "depth": self._image[1].copy()}
