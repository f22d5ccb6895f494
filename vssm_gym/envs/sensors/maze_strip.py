"""See a maze as one row of pixels all around: the panorama of a camera at the height of the scanner.

    column k = the mean colour along SUBRAYS rays about heading + 2 pi k / columns

as a scan's readings are counted: 0 ahead, counter-clockwise. The rays are pixels of four pinhole images, each a quarter
of a turn wide and one pixel high.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from jaxtyping import UInt8

from vssm_gym.envs.rendering.raycast import RaycastCamera
from vssm_gym.envs.scenes.solids import SolidBox
from vssm_gym.envs.sensors.base import HasPlanar
from vssm_gym.errors import InputError
from vssm_gym.geometry.axes import PlanarPose
from vssm_gym.geometry.camera import Camera

FACES = 4  # pinhole images around
SUBRAYS = 4  # of a column
LEAST_FACE = 32  # pixels, width of a face where there are few columns


@dataclass(frozen=True)
class StripNoise:
    """Define the errors of a strip: ``round(x + e)``, ``e ~ N(0, std^2)`` of each byte; zero switches them off."""

    std: float = 0.0  # grey levels of 255

    def __post_init__(self) -> None:
        if not 0.0 <= self.std < math.inf:
            raise InputError("StripNoise", "std", f"a finite number of grey levels >= 0, not {self.std!r}")


class MazeStrip:
    """Measure ``strip`` uint8 ``(1, columns, 3)``, RGB: column 0 ahead, counter-clockwise.

    Args:
        columns: of a full circle.
        boxes: of the maze, painted.
        height: of the camera, m.
        noise: of each byte.
    """

    stream = "sensors"
    parallel = True
    reads_contacts = False

    def __init__(self, columns: int, boxes: Sequence[SolidBox], height: float, noise: StripNoise) -> None:
        self.noise, self._height = noise, height
        camera = Camera.from_hfov(max(LEAST_FACE, 2 * columns), 1, 2.0 * math.pi / FACES)
        self._eye = RaycastCamera(boxes, camera)
        self._face, self._pixel = _rays(columns, camera)
        self.spaces: dict[str, gym.Space[Any]] = {"strip": gym.spaces.Box(0, 255, (1, columns, 3), np.uint8)}
        self._rng: np.random.Generator | None = None

    def seed(self, rng: np.random.Generator) -> None:
        """Draw errors from this stream."""
        self._rng = rng

    def begin(self, body: HasPlanar) -> None:
        """Do nothing: the errors' stream continues."""

    def measure(self, body: HasPlanar) -> dict[str, np.ndarray]:
        """See the maze once from above the robot's centre."""
        assert self._rng is not None
        exact = self.see(body.planar)
        error = self.noise.std * self._rng.standard_normal(exact.shape)
        return {"strip": np.clip(np.rint(exact + error), 0.0, 255.0).astype(np.uint8)}

    def see(self, planar: PlanarPose) -> UInt8[np.ndarray, "1 columns 3"]:
        """Return the strip without errors at a pose x, y (m), heading (rad)."""
        rows = [self._eye.render(self._pose(planar, face))[0][0] for face in range(FACES)]
        seen = np.array(rows)[self._face, self._pixel].mean(axis=1)
        return np.rint(seen)[None].astype(np.uint8)

    def _pose(self, planar: PlanarPose, face: int) -> np.ndarray:
        """Return the camera's pose of a face: z ahead, x to the right, y down."""
        angle = planar[2] + 2.0 * math.pi * face / FACES
        c, s = math.cos(angle), math.sin(angle)
        x, y = planar[:2]
        return np.array([[s, 0.0, c, x], [-c, 0.0, s, y], [0.0, -1.0, 0.0, self._height], [0.0, 0.0, 0.0, 1.0]])


def _rays(columns: int, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the face and the pixel of each ray of each column, ``(columns, SUBRAYS)`` both."""
    between = (np.arange(SUBRAYS) + 0.5) / SUBRAYS - 0.5
    angle = 2.0 * np.pi * (np.arange(columns)[:, None] + between) / columns
    face = np.rint(angle * FACES / (2.0 * np.pi)).astype(int)
    K = np.asarray(camera.K, dtype=np.float64)
    to_the_right = -np.tan(angle - face * 2.0 * np.pi / FACES)
    pixel = np.rint(K[0, 2] + K[0, 0] * to_the_right).astype(int).clip(0, camera.width - 1)
    return face % FACES, pixel
