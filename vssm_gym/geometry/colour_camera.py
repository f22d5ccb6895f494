"""Define a colour camera apart from the depth camera: ``q = T_depth_colour^-1 p_depth``, then a pinhole.

Where a change ``theta`` of the calibration moves the image of a point, a displacement of the point does the same:

    q(theta) = q + D(q) theta,    D(q) = [-1, [q]x, x e_x, y e_y, z e_x, z e_y],    q = (x, y, z)

``theta`` is the translation (m) and rotation (rad) of ``T_depth_colour exp(theta_1:6)``, in the colour camera's frame,
the logarithms of both focal lengths, and the principal point in focal lengths. It has no pixels: one calibration
serves all sizes of an image.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import inverse, se3_exp, se3_log, transform

PARAMETERS = 10  # of theta
PRIOR_STD = np.array(
    [0.05] * 3  # m: cameras of one housing, roughly measured
    + [np.radians(3.0)] * 3  # rad
    + [0.05] * 2  # of a focal length, as a proportion of it: a data sheet's
    + [0.01] * 2  # focal lengths, of the principal point: 5 pixels of a Kinect's 525
)


class ColourCamera(eqx.Module):
    """Represent a colour camera by its pose on the depth camera.

    Attributes:
        camera: intrinsics and size of the colour images.
        T_depth_colour: pose in the depth camera's frame.
    """

    camera: Camera
    T_depth_colour: Float[Array | np.ndarray, "4 4"]

    def project(self, p_depth: Float[Array, "*batch 3"]) -> tuple[Float[Array, "*batch 2"], Float[Array, "*batch"]]:
        """Project points of the depth camera's frame.

        Args:
            p_depth: points, m.

        Returns:
            Column and row in the colour image, pixels, and the depth before the colour camera, m.
        """
        return self.camera.project(transform(inverse(self.T_depth_colour), p_depth))

    def resized(self, width: int, height: int) -> "ColourCamera":
        """Return the camera whose images are resized."""
        return ColourCamera(self.camera.resized(width, height), self.T_depth_colour)

    def moved(self, theta: Float[np.ndarray, "10"]) -> "ColourCamera":
        """Return the camera whose calibration differs by ``theta``."""
        T = np.asarray(self.T_depth_colour, np.float64) @ np.asarray(se3_exp(jnp.asarray(theta[:6])), np.float64)
        c = self.camera
        fx, fy = float(c.fx * np.exp(theta[6])), float(c.fy * np.exp(theta[7]))
        cx, cy = float(c.cx + c.fx * theta[8]), float(c.cy + c.fy * theta[9])
        return ColourCamera(Camera(c.width, c.height, fx, fy, cx, cy), T)

    def difference(self, other: "ColourCamera") -> Float[np.ndarray, "10"]:
        """Return the ``theta`` by which ``other`` differs; both have one size."""
        T = inverse(np.asarray(self.T_depth_colour, np.float64)) @ np.asarray(other.T_depth_colour, np.float64)
        xi = np.asarray(se3_log(jnp.asarray(T, jnp.float32)), np.float64)
        K, other_K = self.camera.K, other.camera.K
        focal = np.log(np.diag(other_K)[:2] / np.diag(K)[:2])
        return np.array([*xi, *focal, *((other_K - K)[:2, 2] / np.diag(K)[:2])])


def displacements(q: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 10"]:
    """Return ``D(q)``: how a point of the colour camera's frame seems to move with each parameter."""
    x, y, z = q[..., 0], q[..., 1], q[..., 2]
    o, one = jnp.zeros_like(x), jnp.ones_like(x)
    rows = (
        (-one, o, o, o, -z, y, x, o, z, o),
        (o, -one, o, z, o, -x, o, y, o, z),
        (o, o, -one, -y, x, o, o, o, o, o),
    )
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
