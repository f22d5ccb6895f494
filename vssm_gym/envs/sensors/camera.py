"""Configure the camera of a robot, and build the renderer and the ray tracer behind it."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from vssm_gym.envs.physics import FlightWorld, FloorWorld
from vssm_gym.envs.physics.tracing import EmbreeTracer, MujocoTracer, Tracer
from vssm_gym.envs.presets import Presets
from vssm_gym.envs.rendering.raycast import RaycastCamera
from vssm_gym.envs.scenes.solids import SolidBox
from vssm_gym.errors import InputError
from vssm_gym.geometry.axes import Matrix4
from vssm_gym.geometry.camera import Camera

RENDERERS = ("raycast", "gl")


@dataclass(frozen=True)
class CameraConfig:
    """Configure the RGB-D camera; pixels are square and the principal point is the middle of the image."""

    width: int = 160  # pixels
    height: int = 120  # pixels; 1 for a scan
    hfov: float = math.pi / 2  # rad, edge to edge of the image

    def __post_init__(self) -> None:
        for field, least in (("width", 8), ("height", 1)):
            size = getattr(self, field)
            if isinstance(size, bool) or not (isinstance(size, int) and least <= size <= 4096):
                raise InputError("CameraConfig", field, f"{least} to 4096 pixels, not {size!r}")
        if isinstance(self.hfov, bool) or not isinstance(self.hfov, int | float) or not 0.0 < self.hfov < math.pi:
            raise InputError("CameraConfig", "hfov", f"an angle in radians between 0 and pi, not {self.hfov!r}")

    def intrinsics(self) -> Camera:
        """Return the pinhole model."""
        return Camera.from_hfov(self.width, self.height, self.hfov)


camera_config = Presets("environment", "camera", CameraConfig, {}, default=CameraConfig())


class SceneCamera(Protocol):
    """Render exact RGB-D images of a scene; ``name`` is recorded with results."""

    camera: Camera

    @property
    def name(self) -> str:
        """Return the name of the renderer, such as ``raycast``."""

    def render(self, T_world_cam: Matrix4) -> tuple[np.ndarray, np.ndarray]:
        """Return ``rgb`` uint8 ``(H, W, 3)`` and z-depth float32 ``(H, W)`` in m, 0 where nothing is seen."""

    def close(self) -> None:
        """Free threads and contexts; the next image creates new ones."""


def make_camera(boxes: Sequence[SolidBox], config: CameraConfig, renderer: str = "raycast") -> SceneCamera:
    """Build a camera among the boxes with the chosen renderer; there is no fallback to the other one.

    Args:
        boxes: the solid boxes.
        config: size and field of view.
        renderer: ``raycast`` or ``gl`` (MuJoCo's OpenGL renderer; its threads are the driver's: ``LP_NUM_THREADS`` for
            Mesa).

    Raises:
        InputError: an unknown renderer, or ``gl`` on a machine without OpenGL, with the reasons and remedies.
    """
    if renderer not in RENDERERS:
        raise InputError("camera", "renderer", f"one of {', '.join(map(repr, RENDERERS))}; found {renderer!r}")
    if renderer == "gl":
        from vssm_gym.envs.physics.gl_camera import GlCamera  # most never draw with it

        return GlCamera(boxes, config.intrinsics())
    return RaycastCamera(boxes, config.intrinsics())


def make_tracer(world: FloorWorld | FlightWorld) -> Tracer:
    """Build a ray tracer with Embree or, with a warning that says why, with MuJoCo's rays."""
    try:
        return EmbreeTracer(world.boxes)
    except ImportError as reason:
        message = f"embreex cannot be imported ({reason}): rays are traced by MuJoCo, several times slower"
        warnings.warn(message, RuntimeWarning, stacklevel=3)
        return MujocoTracer(world)
