"""PRISM's steps 1 to 4: ``q(z_t) ~ p(x_t | z_t, q(M)) int p(z_t | z_t-1, u) q(z_t-1)`` for one image (SPEC 3).

Prior by the linearised transition, pose by MAP against the anchor, Laplace covariance, velocity in closed form. The map
is not touched; :mod:`~vssm_gym.inference.prism` does that, and decides what becomes of an image that does not fit.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from vssm_gym.camera import Camera
from vssm_gym.emission import RGBD
from vssm_gym.geometry import inverse, se3_log
from vssm_gym.inference import belief, gauss_newton, process_noise
from vssm_gym.inference.adam import align_adam
from vssm_gym.inference.alignment import (
    AlignConfig,
    AlignInfo,
    disagreement,
    linearise,
    luminance,
    make_observed,
    make_reference,
    score,
    stride,
)
from vssm_gym.inference.anchor import Anchor
from vssm_gym.inference.belief import Gaussian
from vssm_gym.inference.exposure import expose, gain
from vssm_gym.inference.prism_config import PrismConfig
from vssm_gym.inference.rotation import camera_rotation
from vssm_gym.transition.rigid import RigidBelief, perturb, predict

Problem = tuple[Array, Array, Array, Array, RGBD, RGBD, Camera]  # as the solvers take it, up to the camera


def _by_gauss_newton(problem: Problem, against: Anchor, config: AlignConfig, key: Array) -> tuple[Array, AlignInfo]:
    return gauss_newton.align(*problem, config=config, seen=against.seen, spread=against.spread)


def _by_adam(problem: Problem, against: Anchor, config: AlignConfig, key: Array) -> tuple[Array, AlignInfo]:
    return align_adam(*problem, config=config, key=key, spread=against.spread)


SOLVERS = {"gauss_newton": _by_gauss_newton, "adam": _by_adam}


class Past(eqx.Module):
    """What an image is filtered with."""

    belief: RigidBelief  # q_t-1(z)
    laplace: Float[Array, "6 6"]  # smoothed covariance of the poses up to here; 0: the last image did not fit
    unrest: process_noise.Level
    image: RGBD  # the last that fitted, tracking size, at the map's exposure
    T_world_cam: Float[Array, "4 4"]  # its pose


class Tracked(eqx.Module):
    """What an image says."""

    belief: RigidBelief  # q_t(z)
    laplace: Float[Array, "6 6"]  # as the past's, this image included
    predicted: RigidBelief  # with the configured noise: where the camera may be at all
    unrest: process_noise.Level
    T_world_turned: Float[Array, "4 4"]  # the last pose, turned by the rotation between the images
    gain: Float[Array, ""]  # of the image: see :mod:`exposure`
    agreement: AlignInfo
    fits: Bool[Array, ""]


@partial(jax.jit, static_argnums=7)
def track(
    past: Past,
    control: Float[Array, "6"],
    dt: Float[Array, ""],
    against: Anchor,
    image: RGBD,
    camera: Camera,
    key: PRNGKeyArray,
    config: PrismConfig,
) -> Tracked:
    """The belief over pose and velocity given an image.

    Args:
        past: Belief and image before.
        control: Linear (m/s^2) and angular (rad/s^2) acceleration in the world.
        dt: Seconds since then, above 0.
        against: What the image is aligned to.
        image: At tracking size.
        camera: Its intrinsics.
        key: Of a solver that draws.
        config: Noise, solver and effort.
    """
    possible = predict(past.belief, control, dt, config.noise)
    predicted = predict(past.belief, control, dt, process_noise.scaled(config.noise, past.unrest))
    pose, velocity_given_pose = belief.split(Gaussian(jnp.zeros(12), predicted.covariance), 6)
    # For the rotation alone, images are made equally bright as wholes; what they both show is not known yet.
    grey, last = luminance(image.rgb), luminance(past.image.rgb)
    alike = jnp.clip(gain(last, grey, jnp.ones_like(grey, bool)) * grey, 0.0, 1.0)
    R = camera_rotation(alike, last, camera, config.rotation)
    T_world_turned = past.T_world_cam.at[:3, :3].set(past.T_world_cam[:3, :3] @ R)
    T_anchor_world = inverse(against.T_world_cam)
    T_prior = T_anchor_world @ predicted.state.T_world_body
    # A hand jerks, and the last image turned is the better start; facing a wall of tiles only the motion so far tells
    # a step to the left from a turn.
    starts = jnp.stack([T_anchor_world @ T_world_turned, T_prior])
    factor = config.align.levels[-1]
    ref = make_reference(against.image, camera, config.align, factor)
    obs = make_observed(image, camera, factor, stride(camera, factor, config.align))
    _, rgb, *_ = linearise(starts[0], ref, obs, camera, factor, config.align)
    brightness = gain(obs.luminance + config.align.rgb_sigma * rgb.residual, obs.luminance, rgb.usable)
    image = expose(image, brightness)
    obs = make_observed(image, camera, factor, stride(camera, factor, config.align))
    costs = [disagreement(T, ref, obs, camera, factor, config.align) for T in starts]
    start = starts[jnp.argmin(jnp.stack(costs))]
    precision = jnp.linalg.inv(pose.covariance)
    problem = (T_prior, precision, start, jnp.eye(6), against.image, image, camera)
    T, agreement = SOLVERS[config.solver](problem, against, config.align, key)
    laplace = jnp.linalg.inv(2.0 * agreement.information + precision)
    kept = config.smoothing * (jnp.trace(past.laplace) > 0.0)
    smoothed = kept * past.laplace + (1.0 - kept) * laplace
    # The new pose's error is measured from the new mean, the conditional's from the predicted one: to first order,
    # and a step is short, the two tangents are one.
    moved = se3_log(inverse(T_prior) @ T)
    both = belief.joint(Gaussian(moved, smoothed), velocity_given_pose)
    posterior = RigidBelief(perturb(predicted.state, both.mean), both.covariance)
    fits = (score(agreement) >= config.min_score) & (agreement.photometric <= config.max_photometric)
    fits &= jnp.mean(image.hit) >= config.min_reading
    fits &= moved @ jnp.linalg.solve(possible.covariance[:6, :6], moved) <= config.max_surprise**2
    fits &= jnp.all(jnp.isfinite(both.covariance))
    unrest = process_noise.adapt(past.unrest, moved, pose.covariance, laplace, dt, config.noise)
    return Tracked(posterior, smoothed, possible, unrest, T_world_turned, brightness, agreement, fits)
