"""Define the protocol of robots on the floor: an upright cylinder with a camera, and a law of motion.

(x, y, heading)' ~ p(. | (x, y, heading), command)        in free space; contacts are the simulator's
"""

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from vssm_gym.geometry.axes import Matrix4, PlanarPose
from vssm_gym.geometry.transforms import R_BODY_CAM


class Robot(Protocol):
    """Define one kind of robot.

    A frozen dataclass whose fields all have defaults, so that ``robot="name"`` builds it.
    """

    @property
    def body_length(self) -> float:
        """Return the diameter of the cylinder, m."""

    @property
    def height(self) -> float:
        """Return the height of the cylinder's top, m."""

    @property
    def camera_height(self) -> float:
        """Return the height of the camera above the floor, m."""

    @property
    def dt(self) -> float:
        """Return the length of a step, s."""

    @property
    def radius(self) -> float:
        """Return the radius of the footprint, m."""

    @property
    def T_body_cam(self) -> Matrix4:
        """Return the constant transform from camera to body (origin on the floor below the axis).

        Float64 ``(4, 4)``.
        """

    @property
    def commands(self) -> tuple[str, ...]:
        """Return the names of a command's components, in order."""

    @property
    def limits(self) -> np.ndarray:
        """Return the largest command; float64, one number for each name."""

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and the highest command; float64, one number for each name."""

    @property
    def moves(self) -> tuple[np.ndarray, ...]:
        """Return the commands of the discrete actions: forward, turn left, turn right."""

    def parse_noise(self, level: str | Mapping[str, Any] | Any) -> Any:
        """Return the execution noise of a level's name, of a mapping of its fields, or the noise itself."""

    def respond(self, reached: np.ndarray, command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what the drive has reached after a step, and the command that it carries out in that step.

        Args:
            reached: before the step; zero where the robot stands.
            command: as commanded.
        """

    def execute(self, planar: PlanarPose, command: np.ndarray, noise: Any, rng: np.random.Generator) -> PlanarPose:
        """Execute one noisy step in free space; every call draws the same amount from ``rng``."""


def camera_ahead(camera_height: float) -> Matrix4:
    """Return ``T_body_cam`` of a camera on the body's axis that looks along body x; float64 ``(4, 4)``."""
    T = np.eye(4)
    T[:3, :3] = R_BODY_CAM
    T[2, 3] = camera_height
    return T
