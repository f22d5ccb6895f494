"""Share one renderer among all cameras of one kind in one apartment.

Building a renderer takes a tenth of a second and ten megabytes. A process therefore keeps one :class:`SharedRenderer`
for each (apartment, camera, backend) as long as an environment uses it: the environments of a vector, and environments
made one after another, render from the same tables.
"""

import threading
import weakref
from dataclasses import replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from vssm_gym.envs.physics import FloorWorld
from vssm_gym.envs.physics.tracing import Tracer
from vssm_gym.envs.rendering.raycast import RaycastCamera
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.envs.scenes.solids import SolidBox
from vssm_gym.envs.sensors.camera import CameraConfig, SceneCamera, make_camera, make_tracer
from vssm_gym.geometry.axes import Matrix4

_Key = tuple[str, CameraConfig, str]


class SharedRenderer:
    """Render images and trace rays in one apartment. Get it by :meth:`of`; it is immutable to its users.

    It keeps the renderer's context until nothing uses it any more: no user may close what others share.

    Args:
        apartment: the scene.
        config: size and field of view of the images.
        backend: ``raycast`` or ``gl``.
    """

    _instances: ClassVar["weakref.WeakValueDictionary[_Key, SharedRenderer]"] = weakref.WeakValueDictionary()
    _lock: ClassVar = threading.Lock()

    def __init__(self, apartment: Apartment, config: CameraConfig, backend: str) -> None:
        self.apartment, self.config, self._backend = apartment, config, backend
        self.boxes: list[SolidBox] = apartment.boxes()
        self.camera = config.intrinsics()

    @classmethod
    def of(cls, apartment: Apartment, config: CameraConfig, backend: str) -> "SharedRenderer":
        """Return the process's renderer of these three, which is built where there is none."""
        key = (apartment.content_hash(), config, backend)
        with cls._lock:
            shared = cls._instances.get(key)
            if shared is None:
                shared = cls._instances[key] = cls(apartment, config, backend)
        return shared

    def __reduce__(self) -> Any:
        return SharedRenderer.of, (self.apartment, self.config, self._backend)

    @cached_property
    def _scene_camera(self) -> SceneCamera:
        """Build the backend on first use: an environment without images needs none."""
        return make_camera(self.boxes, self.config, self._backend)

    @property
    def name(self) -> str:
        """Return the name of the backend that makes the images, to be recorded with results."""
        return self._scene_camera.name

    @property
    def parallel(self) -> bool:
        """Return True if several threads may render at once."""
        return isinstance(self._scene_camera, RaycastCamera)

    @cached_property
    def tracer(self) -> Tracer:
        """Return the ray tracer that finds the first box along each ray."""
        return make_tracer(FloorWorld(self.apartment, HolonomicRobot()))  # the robot is transparent

    def with_hfov(self, hfov: float) -> SceneCamera:
        """Return a camera of another field of view that shares this one's tables; ``raycast`` only."""
        assert isinstance(self._scene_camera, RaycastCamera)
        return self._scene_camera.with_intrinsics(replace(self.config, hfov=hfov).intrinsics())

    def render(self, T_world_cam: Matrix4) -> tuple[np.ndarray, np.ndarray]:
        """Return the exact image at a camera pose: uint8 ``(H, W, 3)`` and z-depth float32 ``(H, W)``, m, 0 = none."""
        return self._scene_camera.render(T_world_cam)
