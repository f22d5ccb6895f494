"""Define what a SLAM method has to offer to be scored: ``T_first_t`` of each image as it comes, and in the end."""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from vssm_gym.geometry.camera import Camera


@runtime_checkable
class SlamMethod(Protocol):
    """Describe a method that follows a camera by its RGB-D images; it is made without arguments."""

    name: str  # of the class: the label of its rows

    def begin(self, camera: Camera, seed: int) -> None:
        """Forget the last recording; all randomness of the next one follows from ``seed``."""
        ...

    def track(
        self, time: float, rgb: UInt8[np.ndarray, "height width 3"], depth: Float[np.ndarray, "height width"]
    ) -> Float[np.ndarray, "4 4"]:
        """Return the pose of the camera at an image, in the frame of the camera at the first one.

        Args:
            time: s, of the image.
            rgb: colours.
            depth: z-depth, m; 0 where there is no reading.
        """
        ...

    def finish(self) -> Float[np.ndarray, "images 4 4"] | None:
        """Return the poses of all images as they are known in the end; None for those that `track` has returned."""
        ...
