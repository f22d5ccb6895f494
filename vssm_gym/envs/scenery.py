"""What every camera of one kind in one apartment shares: the solid boxes and the renderer over them.

Building a renderer takes a tenth of a second and ten megabytes. A process therefore keeps one :class:`Scenery` for each
(apartment, camera, renderer, threads) as long as an environment uses it: vector environments, and environments made one
after another, render from the same tables.
"""

import threading
import weakref
from functools import cached_property
from typing import Any

import numpy as np

from vssm_gym.axes import Matrix4
from vssm_gym.envs.apartment import Apartment
from vssm_gym.envs.mjcf import World
from vssm_gym.envs.raycast import RaycastCamera, Tracer
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.sensors import CameraConfig, make_camera, make_tracer
from vssm_gym.envs.solids import SolidBox
from vssm_gym.errors import InputError

Key = tuple[str, CameraConfig, str, int | None]

_SCENERIES: "weakref.WeakValueDictionary[Key, Scenery]" = weakref.WeakValueDictionary()
_BUILDING = threading.Lock()


def scenery_of(apartment: Apartment, config: CameraConfig, renderer: str, threads: int | None) -> "Scenery":
    """The process's scenery of these, built where there is none."""
    if threads is not None and (isinstance(threads, bool) or not isinstance(threads, int) or threads < 1):
        raise InputError("environment", "threads", f"a whole number, at least 1, or None; found {threads!r}")
    key = (apartment.content_hash(), config, renderer, threads)
    with _BUILDING:
        scenery = _SCENERIES.get(key)
        if scenery is None:
            scenery = _SCENERIES[key] = Scenery(apartment, config, renderer, threads)
    return scenery


class Scenery:
    """One apartment made ready for one kind of camera; immutable to its users. Get it by :func:`scenery_of`.

    It holds a renderer's threads or context until nothing uses it any more: no user may close what others share.

    Args:
        apartment: the scene.
        config: size and angle of the images.
        renderer: what makes them.
        threads: threads that share an image; None: two where there are two cores.
    """

    def __init__(self, apartment: Apartment, config: CameraConfig, renderer: str, threads: int | None) -> None:
        self.apartment, self.config, self.renderer, self.threads = apartment, config, renderer, threads
        self._world = World(apartment, HolonomicRobot())  # the robot is transparent
        self.boxes: list[SolidBox] = self._world.boxes
        self._eye = make_camera(self._world, config, renderer, threads)
        self.camera, self.renderer_name = self._eye.camera, self._eye.name
        # Whether several threads may render at once.
        self.parallel = isinstance(self._eye, RaycastCamera) and self._eye.tracer.parallel

    def __reduce__(self) -> Any:
        return scenery_of, (self.apartment, self.config, self.renderer, self.threads)

    @cached_property
    def tracer(self) -> Tracer:
        """What finds the first box along rays."""
        return self._eye.tracer if isinstance(self._eye, RaycastCamera) else make_tracer(self._world)

    def render(self, T_world_cam: Matrix4) -> tuple[np.ndarray, np.ndarray]:
        """The exact image at a camera pose: uint8 ``(H, W, 3)`` and z-depth float32 ``(H, W)``, m, 0 = nothing."""
        return self._eye.render(T_world_cam)
