"""The camera a robot carries: its configuration, and the renderer that stands behind it on this machine."""

import math
import warnings
from dataclasses import dataclass

from vssm_gym.camera import Camera
from vssm_gym.envs.mjcf import FlightWorld, World
from vssm_gym.envs.raycast import EmbreeTracer, MujocoTracer, RaycastCamera, Tracer
from vssm_gym.errors import InputError


@dataclass(frozen=True)
class CameraConfig:
    """Size and angle of the RGB-D camera; pixels are square and the principal point is the image's middle."""

    width: int = 160  # pixels
    height: int = 120  # pixels
    hfov: float = math.pi / 2  # rad, edge to edge of the image

    def __post_init__(self) -> None:
        for field in ("width", "height"):
            size = getattr(self, field)
            if not (isinstance(size, int) and 8 <= size <= 4096):
                raise InputError("CameraConfig", field, f"8 to 4096 pixels, not {size!r}")
        if not 0.0 < self.hfov < math.pi:
            raise InputError("CameraConfig", "hfov", f"an angle in radians between 0 and pi, not {self.hfov!r}")

    def intrinsics(self) -> Camera:
        """The pinhole model."""
        return Camera.from_hfov(self.width, self.height, self.hfov)


def raycast_camera(world: World | FlightWorld, config: CameraConfig, threads: int | None = None) -> RaycastCamera:
    """The raycast camera of a world: by Embree, or, with a warning that says why not, by MuJoCo's rays.

    The renderer's name, ``camera.tracer.name``, belongs with every result.
    """
    tracer: Tracer
    try:
        tracer = EmbreeTracer(world.boxes)
    except ImportError as reason:
        message = f"embreex cannot be imported ({reason}): images are traced by MuJoCo, several times slower"
        warnings.warn(message, RuntimeWarning, stacklevel=2)
        tracer = MujocoTracer(world)
    return RaycastCamera(world.boxes, config.intrinsics(), tracer, threads)
