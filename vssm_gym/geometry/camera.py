"""Define the pinhole camera: ``u = fx x / z + cx``, ``v = fy y / z + cy``, pixel centres at integers, depth along z."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

MAX_DEPTH = 8.0  # m, default range of depth readings and of the renderer (PRISM: 7 to 8 m indoors)


class Camera(eqx.Module):
    """Represent pinhole intrinsics: a pytree of static size whose intrinsics can be differentiated or learned.

    The camera's frame has x to the right, y down and z forward. A point ``p_cam`` (m) is seen at column
    ``u = fx x / z + cx`` and row ``v = fy y / z + cy``, pixel centres at integers; its depth is ``z``.

    Attributes:
        width: of the image, pixels.
        height: of the image, pixels.
        fx: focal length along columns, pixels.
        fy: focal length along rows, pixels.
        cx: column of the principal point, pixels; 0 is the centre of the first column.
        cy: row of the principal point, pixels.
    """

    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)
    fx: ArrayLike
    fy: ArrayLike
    cx: ArrayLike
    cy: ArrayLike

    @classmethod
    def from_hfov(cls, width: int, height: int, hfov: float) -> "Camera":
        """Make a camera with square pixels whose principal point is the middle of the image.

        Args:
            width: of the image, pixels.
            height: of the image, pixels.
            hfov: horizontal field of view from edge to edge, rad.

        Returns:
            The camera; ``fx = fy = width / (2 tan(hfov / 2))``.
        """
        f = 0.5 * width / np.tan(0.5 * hfov)
        return cls(width, height, float(f), float(f), 0.5 * (width - 1), 0.5 * (height - 1))

    @classmethod
    def from_matrix(cls, K: np.ndarray, width: int, height: int) -> "Camera":
        """Make a camera from its intrinsic matrix.

        Args:
            K: ``(3, 3)`` intrinsic matrix, pixels; pixel centres lie at integers.
            width: of the image, pixels.
            height: of the image, pixels.

        Returns:
            The camera; a skew in ``K`` is not represented.
        """
        K = np.asarray(K, dtype=float)
        return cls(width, height, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))

    @property
    def K(self) -> np.ndarray:
        """Return the 3x3 intrinsic matrix, pixels, float64."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]], dtype=np.float64)

    def resized(self, width: int, height: int) -> "Camera":
        """Return the camera of the same view at another size.

        Args:
            width: of the resized image, pixels.
            height: of the resized image, pixels.

        Returns:
            The camera; pixel *edges* keep their place, so that centres move by half a pixel.
        """
        sx, sy = width / self.width, height / self.height
        return Camera(
            width,
            height,
            self.fx * sx,
            self.fy * sy,
            (self.cx + 0.5) * sx - 0.5,
            (self.cy + 0.5) * sy - 0.5,
        )

    def rays(self) -> Float[Array, "height width 3"]:
        """Return ``K^-1 [u, v, 1]^T`` of every pixel: directions in the camera's frame with unit z."""
        u, v = jnp.meshgrid(jnp.arange(self.width), jnp.arange(self.height))
        return jnp.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, jnp.ones(u.shape)], axis=-1)

    def backproject(self, depth: Float[Array, "height width"]) -> Float[Array, "height width 3"]:
        """``p_cam = d K^-1 [u, v, 1]^T``.

        Args:
            depth: z-depth, m; 0 where there is no reading.

        Returns:
            The points in the camera's frame, m; the origin where there is no reading.
        """
        return self.rays() * depth[..., None]

    def project(self, p_cam: Float[Array, "*batch 3"]) -> tuple[Float[Array, "*batch 2"], Float[Array, "*batch"]]:
        """Project points into the image (eq. M7).

        Args:
            p_cam: points in the camera's frame, m.

        Returns:
            Column and row ``(u, v)``, pixels, and z-depth, m. Pixels of points at or behind the camera are far outside.
        """
        z = p_cam[..., 2]
        safe = jnp.where(z > 1e-6, z, 1.0)
        uv = jnp.stack([p_cam[..., 0] / safe * self.fx + self.cx, p_cam[..., 1] / safe * self.fy + self.cy], axis=-1)
        return jnp.where((z > 1e-6)[..., None], uv, -1e6), z
