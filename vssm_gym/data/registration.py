"""``(u, v) = pi(T_colour_depth d K^-1 [i, j, 1])``: find the colour of depth pixels in another camera's image.

A depth pixel's point is projected into the colour image. It has no colour where it falls outside of that image, or
where a nearer surface covers it there. Pixels without a reading take the depth of the nearest one that has it: their
colour is a guess, which keeps false edges out of the image's derivatives.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt

from vssm_gym.data.distortion import distort, reach
from vssm_gym.data.intrinsics import ColourCalibration
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import inverse, transform

COVERED = 1.1  # times the depth of the nearest surface in a cell of the colour image: farther points are behind it
COLOUR_CELL = 1.5  # widths of a depth pixel, of that cell: no surface has holes there
NEAREST_SEEN = 0.05  # m before the colour camera


class Registration:
    """Look up the places of depth pixels in colour images as recorded.

    Args:
        camera: of the depth images, without distortion.
        colour: calibration of the colour images.
    """

    def __init__(self, camera: Camera, colour: ColourCalibration) -> None:
        v, u = np.mgrid[0 : camera.height, 0 : camera.width]
        self._rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
        self._colour = colour
        self._T_colour_depth = inverse(np.asarray(colour.view.T_depth_colour, np.float64))
        self._reach = reach(colour.distortion)
        self._cell = COLOUR_CELL * max(1.0, colour.view.camera.K[0, 0] / camera.K[0, 0])  # pixels of the colour image

    def __call__(
        self, depth: Float[np.ndarray, "height width"]
    ) -> tuple[Float[np.ndarray, "height width"], Float[np.ndarray, "height width"], Bool[np.ndarray, "height width"]]:
        """Return column and row of each depth pixel in the colour image, and whether its colour is known.

        Args:
            depth: z-depth, m; 0 where there is no reading.
        """
        camera, read = self._colour.view.camera, depth > 0.0
        if not read.any():
            return np.zeros(depth.shape), np.zeros(depth.shape), read
        i, j = distance_transform_edt(~read, return_distances=False, return_indices=True)
        q = transform(self._T_colour_depth, self._rays * np.asarray(depth, np.float64)[i, j][..., None])
        z = np.maximum(q[..., 2], NEAREST_SEEN)
        x, y = q[..., 0] / z, q[..., 1] / z
        seen = x**2 + y**2 < self._reach**2  # beyond it, the lens model turns back towards the middle
        x, y = distort(x, y, self._colour.distortion)
        u, v = x * camera.fx + camera.cx, y * camera.fy + camera.cy
        inside = (
            seen & (q[..., 2] > NEAREST_SEEN) & (u >= 0) & (u <= camera.width - 1) & (v >= 0) & (v <= camera.height - 1)
        )
        u, v = np.clip(u, 0.0, camera.width - 1.0), np.clip(v, 0.0, camera.height - 1.0)
        columns = int(camera.width / self._cell) + 1
        cell = (v / self._cell).astype(int) * columns + (u / self._cell).astype(int)
        nearest = np.full(columns * (int(camera.height / self._cell) + 1), np.inf)
        known = read & inside
        np.minimum.at(nearest, cell[known], z[known])
        return u, v, known & (z < COVERED * nearest[cell])
