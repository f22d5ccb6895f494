"""``score(align(p / s))``: does another scale of the depth fit the reference better? (ours)

A depth sensor whose scale is off shows surfaces that fit the map at a pose in front of or behind the true one, to a
fair degree: the alignment alone does not reject it. Depth at its right scale fits best unscaled, from the same start.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.alignment import gauss_newton
from vssm_gym.inference.alignment.aliasing import COLOUR_MARGIN
from vssm_gym.inference.alignment.residuals import AlignConfig, score
from vssm_gym.model.emission import RGBD

DEPTH_SCALES = (0.83, 0.91, 1.0, 1.1, 1.2)  # factors of the true depth that are compared
SCALE_PRIOR_STD = 0.5  # m, rad, around the pose that is tested


@partial(jax.jit, static_argnums=5)
def fits_unscaled(
    T: Float[Array, "4 4"],
    basis: Float[Array, "6 dof"],
    reference: RGBD,
    image: RGBD,
    camera: Camera,
    config: AlignConfig,
    seen: Float[Array, "height width"] | None = None,
) -> Bool[Array, ""]:
    """Return whether at no other scale the depth has a higher score and the colours fit as well (eq. I29).

    Args:
        T: T_ref_cam, where the alignments begin.
        basis: the twists (camera frame) along which the camera may move from there.
        reference: RGB-D image at the reference pose.
        image: the image, at the reference's exposure.
        camera: intrinsics of both.
        config: scales and gates of the alignment.
        seen: luminance of the camera image taken at the reference pose, if any.
    """
    precision = basis.T @ basis / SCALE_PRIOR_STD**2

    def fit(scale: Array) -> tuple[Array, Array]:
        scaled = eqx.tree_at(lambda i: i.depth, image, image.depth / scale)
        _, info = gauss_newton.align(T, precision, T, basis, reference, scaled, camera, config, seen)
        return score(info), info.photometric

    scores, photometric = jax.lax.map(fit, jnp.asarray(DEPTH_SCALES))
    here = DEPTH_SCALES.index(1.0)
    return ~jnp.any((scores > scores[here]) & (photometric <= photometric[here] + COLOUR_MARGIN))
