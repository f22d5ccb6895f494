"""What every camera of one kind in one apartment shares: the solid boxes and the renderer over them.

Building a renderer takes a tenth of a second and ten megabytes. A process therefore keeps one :class:`Scenery` for each
(apartment, camera, renderer) as long as an environment uses it: vector environments, and environments made one
after another, render from the same tables.
"""

import threading
import weakref
from functools import cached_property
from typing import Any

import numpy as np

from vssm_gym.envs.physics import World
from vssm_gym.envs.physics.tracing import Tracer
from vssm_gym.envs.rendering.raycast import RaycastCamera
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.envs.scenes.solids import SolidBox
from vssm_gym.envs.sensors.camera import CameraConfig, SceneCamera, make_camera, make_tracer
from vssm_gym.geometry.axes import Matrix4

Key = tuple[str, CameraConfig, str]

_SCENERIES: "weakref.WeakValueDictionary[Key, Scenery]" = weakref.WeakValueDictionary()
_BUILDING = threading.Lock()


def scenery_of(apartment: Apartment, config: CameraConfig, renderer: str) -> "Scenery":
    """The process's scenery of these, built where there is none."""
    key = (apartment.content_hash(), config, renderer)
    with _BUILDING:
        scenery = _SCENERIES.get(key)
        if scenery is None:
            scenery = _SCENERIES[key] = Scenery(apartment, config, renderer)
    return scenery


class Scenery:
    """One apartment made ready for one kind of camera; immutable to its users. Get it by :func:`scenery_of`.

    It holds a renderer's context until nothing uses it any more: no user may close what others share.

    Args:
        apartment: the scene.
        config: size and angle of the images.
        renderer: what makes them.
    """

    def __init__(self, apartment: Apartment, config: CameraConfig, renderer: str) -> None:
        self.apartment, self.config, self.renderer = apartment, config, renderer
        self.boxes: list[SolidBox] = apartment.boxes()
        self.camera = config.intrinsics()

    def __reduce__(self) -> Any:
        return scenery_of, (self.apartment, self.config, self.renderer)

    @cached_property
    def _eye(self) -> SceneCamera:
        """The renderer, built when it is first asked for: who sees nothing needs none."""
        return make_camera(self.boxes, self.config, self.renderer)

    @property
    def renderer_name(self) -> str:
        """What makes the images, to be recorded with results."""
        return self._eye.name

    @property
    def parallel(self) -> bool:
        """Whether several threads may render at once."""
        return isinstance(self._eye, RaycastCamera)

    @cached_property
    def tracer(self) -> Tracer:
        """What finds the first box along rays."""
        return make_tracer(World(self.apartment, HolonomicRobot()))  # the robot is transparent

    def render(self, T_world_cam: Matrix4) -> tuple[np.ndarray, np.ndarray]:
        """The exact image at a camera pose: uint8 ``(H, W, 3)`` and z-depth float32 ``(H, W)``, m, 0 = nothing."""
        return self._eye.render(T_world_cam)
