"""``yaw ~ N(<w, log R>, s^2)``: how a robot that turns in place has turned, from the colours of two images (ours).

A camera on the axis of a robot that turns without driving moves by a rotation alone, which shifts pixels by a
homography whatever their depth. Where an image has no depth, or shows what the map does not know, this is what it still
tells: a gyroscope made of images. It is used only where the images agree after the rotation, about the robot's axis.
"""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Array, Bool, Float

from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.alignment.exposure import gain
from vssm_gym.inference.alignment.residuals import luminance, shrink_camera, shrink_image
from vssm_gym.inference.alignment.rotation import camera_rotation
from vssm_gym.inference.filter import Rig
from vssm_gym.inference.tracking.camera_filter import camera_twists
from vssm_gym.inference.tracking.error_covariance import Considered
from vssm_gym.model.emission import RGBD
from vssm_gym.model.transition.belief import GaussianBelief
from vssm_gym.model.transition.manifold import Manifold

STD = 0.005  # rad, of a rotation between two images: a quarter of a pixel of 80 across a right angle
INDEPENDENT = 0.999  # of the variance that is independent of the rest: a covariance stays regular in single precision
EVERYWHERE = 1e-5  # on the diagonal of a matrix of correlations: what is known exactly, or twice
MIN_CORRELATION = 0.9  # of the luminances after the rotation
MIN_CONTRAST = 0.02  # standard deviation of the luminance: a bare wall shows no turn
MIN_OVERLAP = 0.3  # share of the image that both show
OFF_AXIS = 0.04  # rad, of the rotation about other axes than the robot's
STARTS = (-3.0, -1.5, 0.0, 1.5, 3.0)  # standard deviations of the predicted turn where searches begin
MOST_SEARCHED = 0.2  # rad, of that standard deviation
MOST_TURN_STDS = 3.5  # of the predicted turn: farther ones are no turns of this robot
DRIVEN = 0.01  # m, of the predicted motion: beyond it the robot drove
COMPARED_WIDTH = 80  # pixels, of the images that are compared


def small_grey(image: RGBD, camera: Camera) -> Float[Array, "height width"]:
    """Return the luminance of an image at the size that is compared."""
    return shrink_image(luminance(image.rgb), max(1, camera.width // COMPARED_WIDTH))


@jax.jit
def turned(
    belief: GaussianBelief,
    before: GaussianBelief,
    last: Float[Array, "height width"],
    grey: Float[Array, "height width"],
    rig: Rig,
    considered: Considered,
) -> tuple[GaussianBelief, Bool[Array, ""]]:
    """Correct a predicted belief by the rotation between two images of a robot that turned and did not drive (eq. I38).

    The images measure the turn's error ``e ~ N(0, q)`` with the variance ``s^2``: its mean becomes
    ``q / (q + s^2)`` of what they show, its variance ``q s^2 / (q + s^2)``; q is what the step added to the belief. No
    more is taken from the heading's variance than what is independent of the place and of the map's errors.

    Args:
        belief: predicted, after the turn.
        before: the belief before it.
        last: luminance of the image before, of :func:`small_grey`.
        grey: of the image after it.
        rig: the camera, at full size, and its place on the body.
        considered: what the belief's errors have in common with those of the map.

    Returns:
        The corrected belief, as predicted where the images do not tell; and whether they do.
    """
    manifold = belief.manifold
    k = turn_index(manifold)
    view = shrink_camera(rig.camera, max(1, rig.camera.width // COMPARED_WIDTH))
    alike = jnp.clip(gain(last, grey, jnp.ones_like(grey, bool)) * grey, 0.0, 1.0)
    axis = camera_twists(manifold, rig)[3:, k]
    moved = manifold.error(before.mean, belief.mean)
    variance = jnp.maximum(belief.covariance[k, k] - before.covariance[k, k], 0.0)
    starts = moved[k] + jnp.sqrt(jnp.minimum(variance, MOST_SEARCHED**2)) * np.asarray(STARTS)
    search = lambda start: camera_rotation(alike, last, view, start=jaxlie.SO3.exp(start * axis).as_matrix())
    found = jax.lax.map(search, starts)
    best = jnp.argmax(jax.vmap(lambda R: _agreement(R, last, alike, view))(found))
    turn = jaxlie.SO3.from_matrix(found[best]).log()
    angle = axis @ turn / (axis @ axis)
    error = angle - moved[k]
    told = driven(moved, manifold) <= DRIVEN
    told &= _agreement(found[best], last, alike, view) >= MIN_CORRELATION
    told &= jnp.linalg.norm(turn - angle * axis) <= OFF_AXIS
    told &= jnp.abs(error) <= MOST_TURN_STDS * jnp.sqrt(variance + STD**2)
    share = jnp.where(told, variance / (variance + STD**2), 0.0)
    mean = manifold.perturb(belief.mean, jnp.zeros(len(belief.covariance)).at[k].set(share * error))
    taken = jnp.minimum(share * variance, INDEPENDENT * _alone(considered.joint(belief.covariance), k))
    return GaussianBelief(mean, belief.covariance.at[k, k].add(-taken), manifold), told


def _alone(covariance: Float[Array, "d d"], k: int) -> Float[Array, ""]:
    """``P_kk - P_kr P_rr^-1 P_rk``: the variance of coordinate k given all others, r; more cannot be taken from it."""
    rest = np.delete(np.arange(len(covariance)), k)
    scale = jnp.sqrt(jnp.maximum(jnp.diagonal(covariance), jnp.finfo(jnp.float32).tiny))
    correlation = covariance / scale / scale[:, None]
    shared = correlation[rest, k]
    R = correlation[np.ix_(rest, rest)] + EVERYWHERE * jnp.eye(len(rest))
    return covariance[k, k] * jnp.clip(1.0 - shared @ jnp.linalg.solve(R, shared), 0.0, 1.0)


def turn_index(manifold: Manifold) -> int:
    """Return which coordinate of a body that turns about one axis is its heading."""
    return int(np.flatnonzero(manifold.turns[: manifold.twists.shape[1]])[0])


def driven(moved: Float[Array, "d"], manifold: Manifold) -> Float[Array, ""]:
    """Return how far (m) the body has driven by the error between two states."""
    turns = manifold.turns[: manifold.twists.shape[1]]
    return jnp.linalg.norm(jnp.where(turns, 0.0, moved[: len(turns)]))


def _agreement(R: Float[Array, "3 3"], last: Array, grey: Array, view: Camera) -> Float[Array, ""]:
    """Return the correlation of the images after the rotation ``R_last_cam``; -1 where both show no contrast."""
    q = view.rays() @ R.T
    ahead = q[..., 2] > 0.1
    z = jnp.where(ahead, q[..., 2], 1.0)
    u, v = view.fx * q[..., 0] / z + view.cx, view.fy * q[..., 1] / z + view.cy
    inside = ahead & (u >= 0.0) & (u <= view.width - 1.0) & (v >= 0.0) & (v <= view.height - 1.0)
    moved = map_coordinates(last, [v, u], order=1, mode="nearest")
    weight = inside / jnp.maximum(jnp.sum(inside), 1)
    a, b = (image - jnp.sum(weight * image) for image in (grey, moved))
    deviation = jnp.sqrt(jnp.sum(weight * a * a) * jnp.sum(weight * b * b))
    shown = (deviation >= MIN_CONTRAST**2) & (jnp.mean(inside) >= MIN_OVERLAP)
    return jnp.where(shown, jnp.sum(weight * a * b) / jnp.maximum(deviation, 1e-9), -1.0)
