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
from vssm_gym.envs.sensors.camera import SceneCamera
from vssm_gym.envs.sensors.depth_image import depth_image
from vssm_gym.envs.sensors.rgbd_noise import NoisySensor, SensorNoise
from vssm_gym.envs.sensors.shared_renderer import SharedRenderer
from vssm_gym.errors import InputError
from vssm_gym.geometry.axes import Matrix4
from vssm_gym.geometry.camera import Camera

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
        self._eye: SharedRenderer | SceneCamera = renderer
        self._light: np.ndarray | None = None  # the byte of each byte, where the light is not the scene's own
        self._sensor: NoisySensor | None = None

    @property
    def camera(self) -> Camera:
        """Return the present intrinsics."""
        return self._eye.camera

    def look(self, renderer: SharedRenderer, hfov: float | None = None, light: np.ndarray | None = None) -> None:
        """Take the images from now on in another scene, with another field of view (rad) or under another light.

        ``light`` is a table of bytes; None, for both, is the scene's own.
        """
        self.renderer, self._light = renderer, light
        self._eye = renderer if hfov is None else renderer.with_hfov(hfov)
        if self._sensor is not None:
            self._sensor.set_camera(self.camera)

    def render(self, T_world_cam: Matrix4) -> tuple[np.ndarray, np.ndarray]:
        """Return the exact image at a camera pose, as it is now: uint8 ``(H, W, 3)``, and z-depth in m."""
        rgb, depth = self._eye.render(T_world_cam)
        return rgb if self._light is None else self._light[rgb], depth

    def seed(self, rng: np.random.Generator) -> None:
        """Restart the camera with this stream."""
        self._sensor = NoisySensor(self.noise, self.camera, rng)

    def begin(self, body: HasCamera) -> None:
        """Do nothing: exposure and stream continue."""

    def measure(self, body: HasCamera) -> dict[str, np.ndarray]:
        """Take the image, ``body.dt`` s after the one before."""
        assert self._sensor is not None
        rgb, depth = self._sensor(*self.render(body.T_world_cam), body.dt)
        return {"rgb": rgb, "depth": depth} | ({"depth_image": depth_image(depth)} if self._scaled else {})
