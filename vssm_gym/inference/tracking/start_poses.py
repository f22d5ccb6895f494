"""Choose the pose that an alignment starts from (eq. I14)."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import inverse, se3_log
from vssm_gym.inference.alignment import gauss_newton
from vssm_gym.inference.alignment.exposure import expose, gain
from vssm_gym.inference.alignment.reference_view import ReferenceView
from vssm_gym.inference.alignment.residuals import (
    AlignConfig,
    alignment_cost,
    linearise,
    luminance,
    make_observed,
    make_reference,
    stride,
)
from vssm_gym.inference.alignment.rotation import camera_rotation
from vssm_gym.inference.tracking.config import TrackingConfig
from vssm_gym.inference.tracking.solvers import Problem
from vssm_gym.model.emission import RGBD

SEARCHED_PIXELS = 300  # observed pixels that the search from each start uses, and
COMPARED_PIXELS = 1250  # those by which the found poses are compared: about so many


def turned(
    covariance: Float[Array, "p p"], turns: Bool[np.ndarray, "p"], stds: tuple[float, ...]
) -> Float[Array, "starts p"]:
    """``s P[:, j] / sqrt(P[j, j])``: zero, and the likeliest errors where an angle j is off by s stds (eq. I14)."""
    columns = [covariance[:, j] / jnp.sqrt(covariance[j, j]) for j in np.flatnonzero(turns)]
    return jnp.stack([jnp.zeros(len(covariance)), *(s * column for column in columns for s in stds)])


def best(
    starts: Float[Array, "starts 4 4"], precision: Float[Array, "p p"], problem: Problem, align: AlignConfig
) -> Float[Array, "4 4"]:
    """Return the likeliest of the poses that the search on the smallest images finds from each start.

    Args:
        starts: T_ref_cam.
        precision: Of the prior.
        problem: The alignment.
        align: Its configuration; the first level is searched, poses are compared at the last one.
    """
    T_prior, basis, reference, image, camera = problem
    small = replace(align, levels=align.levels[:1], iterations=align.iterations[:1], pixels=SEARCHED_PIXELS)
    search = lambda T: gauss_newton.align(
        T_prior, precision, T, basis, reference.image, image, camera, small, reference.seen, reference.spread
    )[0]
    found = jax.vmap(search)(starts)
    align, factor = replace(align, pixels=COMPARED_PIXELS), align.levels[-1]
    ref = make_reference(reference.image, camera, align, factor)
    every = stride(camera, factor, align)
    obs = make_observed(image, camera, factor, every)
    data = jnp.sum(obs.valid) * (factor * every) ** 2 / align.pixels_per_datum  # independent ones
    coordinates, T_inverse_prior = jnp.linalg.pinv(basis), inverse(T_prior)

    def surprise(T):
        xi = coordinates @ se3_log(T_inverse_prior @ T)
        return data * alignment_cost(T, ref, obs, camera, factor, align) + 0.5 * xi @ precision @ xi

    return found[jnp.argmin(jax.vmap(surprise)(found))]


class Start(NamedTuple):
    """Hold where an alignment starts, and the image that it takes."""

    poses: Float[Array, "starts 4 4"]  # T_ref_cam, the best first
    image: RGBD  # at the map's exposure
    gain: Float[Array, ""]  # of the image
    T_world_turned: Float[Array, "4 4"]  # the last camera pose, turned by the rotation between the images


def first(
    T_prior: Float[Array, "4 4"],
    reference: ReferenceView,
    T_world_last: Float[Array, "4 4"],
    last: RGBD,
    image: RGBD,
    camera: Camera,
    config: TrackingConfig,
) -> Start:
    """Return where the alignment of an image starts.

    Two poses are compared by alignment cost. After a sudden motion, the last pose turned by the estimated rotation is
    better; in front of a tiled wall, only the prediction distinguishes a step to the left from a turn.

    Args:
        T_prior: T_ref_cam, predicted.
        reference: The view that it is aligned to.
        T_world_last: The last camera pose.
        last: The image taken there.
        image: The image.
        camera: Of all images.
        config: Of tracking.
    """
    T_world_turned, poses = T_world_last, T_prior[None]
    if config.rotation is not None:
        # For the rotation alone, whole images are made equally bright; their common part is not known yet.
        grey, before = luminance(image.rgb), luminance(last.rgb)
        alike = jnp.clip(gain(before, grey, jnp.ones_like(grey, bool)) * grey, 0.0, 1.0)
        R = camera_rotation(alike, before, camera, config.rotation)
        T_world_turned = T_world_last.at[:3, :3].set(T_world_last[:3, :3] @ R)
        poses = jnp.stack([inverse(reference.T_world_cam) @ T_world_turned, T_prior])
    brightness, align = jnp.ones(()), config.align
    factor = align.levels[-1]
    observed = lambda image: make_observed(image, camera, factor, stride(camera, factor, align))
    if config.exposure or len(poses) > 1:
        ref, obs = make_reference(reference.image, camera, align, factor), observed(image)
    if config.exposure:
        _, rgb, *_ = linearise(poses[0], ref, obs, camera, factor, align)
        brightness = gain(obs.luminance + align.rgb_sigma * rgb.residual, obs.luminance, rgb.usable)
        image = expose(image, brightness)
        obs = observed(image)
    if len(poses) > 1:
        costs = jax.vmap(lambda T: alignment_cost(T, ref, obs, camera, factor, align))(poses)
        poses = poses[jnp.argsort(costs)]
    return Start(poses, image, brightness, T_world_turned)
