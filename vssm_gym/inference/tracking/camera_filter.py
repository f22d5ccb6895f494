"""``q(z_t) ~ p(x_t | z_t, q(M)) int p(z_t | z_t-1, u) q(z_t-1)`` for one image (PRISM, steps 1 to 4).

Prior by any linearised transition, pose by MAP against a reference view, Laplace covariance, the rest of the state in
closed form. The filters update the map, and decide how to proceed after an image that is not accepted.
"""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import inverse, se3_adjoint, se3_exp, se3_log
from vssm_gym.inference.alignment.reference_view import ReferenceView
from vssm_gym.inference.alignment.residuals import AlignInfo, score
from vssm_gym.inference.alignment.surface_error import influence
from vssm_gym.inference.filter import Rig
from vssm_gym.inference.tracking import obstacles, process_noise, start_poses
from vssm_gym.inference.tracking.config import TrackingConfig
from vssm_gym.inference.tracking.confirmation import colour_confirms
from vssm_gym.inference.tracking.error_covariance import Considered, nothing
from vssm_gym.inference.tracking.pose_update import gain, propagated, published, surprise
from vssm_gym.inference.tracking.solvers import SOLVERS, Problem
from vssm_gym.model.emission import RGBD
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import Belief, GaussianBelief
from vssm_gym.model.transition.manifold import Manifold


class Past(eqx.Module):
    """Hold what the next image is filtered with."""

    belief: GaussianBelief  # q_t-1(z)
    laplace: Float[Array, "p p"]  # published covariance of the poses up to here; 0: the last image was not accepted
    considered: Considered
    correlation: Float[Array, ""]  # variance of the image's gradient over that of independent data
    noise_scale: process_noise.NoiseScale
    obstructed: Bool[Array, ""]  # an obstacle was met, and no image has shown since that the body moves as commanded
    image: RGBD  # the last accepted one, tracking size, at the map's exposure
    T_world_cam: Float[Array, "4 4"]  # its pose


class Tracked(eqx.Module):
    """Hold the estimate from one image."""

    belief: GaussianBelief  # q_t(z)
    T_world_cam: Float[Array, "4 4"]  # at its mean
    laplace: Float[Array, "p p"]  # as the past's, this image included
    considered: Considered  # likewise
    correlation: Float[Array, ""]  # likewise
    carried: Considered  # likewise, without this image
    predicted: GaussianBelief  # with the transition's whole noise
    noise_scale: process_noise.NoiseScale
    obstructed: Bool[Array, ""]  # likewise
    T_world_turned: Float[Array, "4 4"]  # the last camera pose, turned by the rotation between the images
    gain: Float[Array, ""]  # of the image: see :mod:`exposure`
    fit_quality: AlignInfo
    accepted: Bool[Array, ""]
    expected: Bool[Array, ""]  # the step needs no confirmation (eq. I28)
    repeated: Bool[Array, ""]  # the depth image is that of the last accepted image, bit for bit, of a camera that moves


def begin(prior: Belief, image: RGBD, rig: Rig) -> Past:
    """Return the past after a first image, taken where the prior has the body.

    Raises:
        InputError: a prior that is no Gaussian.
    """
    if not isinstance(prior, GaussianBelief):
        raise InputError("filter.init", "prior", f"a GaussianBelief over the state; found {type(prior).__name__}")
    p = prior.manifold.twists.shape[1]
    considered = nothing(len(prior.covariance))
    return Past(
        prior,
        jnp.zeros((p, p)),
        considered,
        jnp.ones(()),
        process_noise.full(),
        jnp.zeros((), bool),
        image,
        camera_pose(prior, rig),
    )


def camera_twists(manifold: Manifold, rig: Rig) -> Float[Array, "6 p"]:
    """Return the camera's twists when the body's pose moves along each coordinate of its tangent."""
    return se3_adjoint(inverse(rig.T_body_cam)) @ jnp.asarray(manifold.twists, jnp.float32)


def at_rest(
    manifold: Manifold, T_world_body: Array, pose_covariance: Array, velocity: tuple[float, float]
) -> GaussianBelief:
    """Return a belief over a body at a pose whose velocity, where the state has one, is unknown around zero.

    Args:
        manifold: Of the state.
        T_world_body: The pose, (4, 4).
        pose_covariance: Of the pose's tangent, (p, p).
        velocity: Standard deviations of the linear (m/s) and the angular (rad/s) velocity.
    """
    p = len(pose_covariance)
    variances = np.where(manifold.turns[p:], velocity[1], velocity[0]) ** 2
    covariance = jnp.diag(jnp.asarray([0.0] * p + [*variances], jnp.float32)).at[:p, :p].set(pose_covariance)
    return GaussianBelief(manifold.resting(jnp.asarray(T_world_body, jnp.float32)), covariance, manifold)


@jax.jit
def camera_pose(belief: GaussianBelief, rig: Rig) -> Float[Array, "4 4"]:
    """Return ``T_world_cam`` at the mean of a belief over the body."""
    return belief.manifold.pose(belief.mean) @ rig.T_body_cam


@jax.jit
def expected_pose(
    transition: Transition, belief: GaussianBelief, control: Float[Array, "m"], dt: Float[Array, ""], rig: Rig
) -> Float[Array, "4 4"]:
    """Return ``T_world_cam`` where the control leads from the mean of a belief."""
    return transition.manifold.pose(transition.expected(belief.mean, control, dt)) @ rig.T_body_cam


class TrackingInput(NamedTuple):
    """Hold an image and everything that it is filtered with."""

    past: Past  # belief and image before
    transition: Transition  # of the body since then
    control: Float[Array, "m"]  # of the transition
    dt: Float[Array, ""]  # s, above 0
    reference: ReferenceView  # that the image is aligned to
    image: RGBD  # at tracking size
    rig: Rig  # the camera, at that size, and its pose on the body
    key: PRNGKeyArray  # of a solver that draws
    lost: bool | Bool[Array, ""]  # the image before was not accepted


@partial(jax.jit, static_argnums=1)
def track(given: TrackingInput, config: TrackingConfig) -> Tracked:
    """Return the belief over the state given an image; ``config`` has solver, effort and gates."""
    past, transition, control, dt, reference, image, rig, key, lost = given
    manifold = transition.manifold
    possible = predicted = transition.predict(past.belief, control, dt)
    if config.adaptation is not None:
        scale = process_noise.scale(manifold, past.noise_scale)
        predicted = transition.predict(past.belief, control, dt, scale)
    p = past.laplace.shape[0]
    turns, pose_covariance = manifold.turns[:p], predicted.covariance[:p, :p]
    basis = camera_twists(manifold, rig)
    T_ref_world = inverse(reference.T_world_cam)
    T_prior = T_ref_world @ manifold.pose(predicted.mean) @ rig.T_body_cam
    begun = start_poses.first(T_prior, reference, past.T_world_cam, past.image, image, rig.camera, config)
    image, problem = begun.image, Problem(T_prior, basis, reference, begun.image, rig.camera)
    back = _from_prediction(problem, T_ref_world @ manifold.pose(past.belief.mean) @ rig.T_body_cam)
    solved = _solve(past, transition.commanded, predicted, back, begun.poses[0], problem, key, config)
    T, fit_quality, prior = solved.T_ref_cam, solved.fit_quality, solved.prior
    # The new pose's error is measured from the new mean, the conditional's from the predicted one: to first order,
    # and a step is short, the two tangents are one.
    moved = _from_prediction(problem, T)
    distance = jnp.linalg.norm(manifold.pose(predicted.mean)[:3, 3] - manifold.pose(past.belief.mean)[:3, 3])
    carried = _carried(past, transition, control, dt, distance, config)
    if config.surface_error is None:
        both, laplace, smoothed = published(
            past.laplace, prior, moved, solved.precision, fit_quality.information, config.smoothing
        )
        considered, correlation = carried, past.correlation
    else:
        errors = influence(T, basis, reference, image, rig.camera, config.align, config.surface_error)
        fit_quality = eqx.tree_at(lambda q: q.information, fit_quality, errors.curvature)
        made = gain(prior.covariance[:p, :p], past.correlation, errors.curvature)
        both, considered = propagated(carried, prior, moved, made, errors)
        smoothed = laplace = past.correlation * made.K
        correlation = jnp.clip(errors.correlation(made.K), 1.0, config.most_correlated)
    posterior = GaussianBelief(manifold.perturb(prior.mean, both.mean), both.covariance, manifold)
    accepted = (score(fit_quality) >= config.min_score) & (fit_quality.photometric <= config.max_photometric)
    accepted &= jnp.mean(image.hit) >= config.min_reading
    accepted &= surprise(moved, possible) <= config.max_surprise**2
    unexplained = obstacles.unobstructed(moved, back, turns) if transition.commanded else moved
    expected = jnp.logical_not(lost) & (surprise(unexplained, possible) <= config.max_unconfirmed**2)
    met = past.obstructed
    if transition.commanded and config.surface_error is not None:
        shown = obstacles.is_shown(both.covariance[:p, :p], back, turns)
        met = solved.met & ~(shown & (surprise(moved, predicted) <= config.max_unconfirmed**2))
    if config.confirmation is not None:
        accepted &= colour_confirms(
            T, begun.poses, expected, reference, image, rig.camera, config.align, config.confirmation
        )
    # A camera that moves repeats no image; one that stands may, where images have no noise. Where the commands are
    # known, a blocked robot may see the same.
    repeated = jnp.all(image.depth == past.image.depth) & (not transition.commanded)
    repeated &= _displacement(past.belief, predicted, image, rig) > config.repeated_displacement
    accepted &= ~repeated
    accepted &= jnp.all(jnp.isfinite(both.covariance)) & jnp.all(jnp.diagonal(both.covariance) > 0.0)
    if transition.commanded and config.surface_error is not None:
        # A readable image that fits nowhere may show what stopped the body.
        blocked = possible.covariance.at[:p, :p].add(obstacles.obstruction(back, turns))
        doubtful = past.obstructed | (jnp.any(image.hit) & ~accepted)
        possible = replace(possible, covariance=jnp.where(doubtful, blocked, possible.covariance))
    noise_scale = past.noise_scale
    if config.adaptation is not None:
        noise = transition.noise_covariance(past.belief.mean, control, dt)[:p, :p]
        noise_scale = process_noise.adapt(
            past.noise_scale, moved, pose_covariance, laplace, dt, noise, manifold, config.adaptation
        )
    return Tracked(
        belief=posterior,
        T_world_cam=manifold.pose(posterior.mean) @ rig.T_body_cam,
        laplace=smoothed,
        considered=considered,
        correlation=correlation,
        carried=carried,
        predicted=possible,
        noise_scale=noise_scale,
        obstructed=jnp.where(accepted, met, past.obstructed),
        T_world_turned=begun.T_world_turned,
        gain=begun.gain,
        fit_quality=fit_quality,
        accepted=accepted,
        expected=expected,
        repeated=repeated,
    )


class _Solved(NamedTuple):
    """Hold a pose that was searched for."""

    T_ref_cam: Float[Array, "4 4"]
    fit_quality: AlignInfo
    prior: GaussianBelief  # that it was searched with
    precision: Float[Array, "p p"]  # of that prior's pose, as it counts against the data
    met: Bool[Array, ""]  # an obstacle


def _solve(
    past: Past,
    commanded: bool,
    predicted: GaussianBelief,
    back: Float[Array, "p"],
    start: Float[Array, "4 4"],
    problem: Problem,
    key: PRNGKeyArray,
    config: TrackingConfig,
) -> _Solved:
    """Search for the pose; where a command does not explain it, again from where an obstacle may have left the body."""
    p = len(back)
    turns, pose_covariance = predicted.manifold.turns[:p], predicted.covariance[:p, :p]
    T_prior, basis = problem.T_prior, problem.basis
    # Data whose errors are alike weigh less against the prior.
    precision = past.correlation * jnp.linalg.inv(pose_covariance)
    if config.heading_starts:
        turned = start_poses.turned(pose_covariance, turns, config.heading_starts)
        wide = jnp.max(jnp.where(turns, jnp.diagonal(pose_covariance), 0.0)) > config.search_reach**2
        best = lambda starts: start_poses.best(starts, precision, problem, config.align)
        start = jax.lax.cond(wide, best, lambda _: start, T_prior @ se3_exp(turned @ basis.T))
    solver = lambda precision, start: SOLVERS[config.solver](problem, precision, start, config.align, config.adam, key)
    T, fit_quality = solver(precision, start)
    if not commanded or config.surface_error is None:
        return _Solved(T, fit_quality, predicted, precision, past.obstructed)
    met = past.obstructed | (surprise(_from_prediction(problem, T), predicted) > config.max_unconfirmed**2)
    blocked = pose_covariance + obstacles.obstruction(back, turns)
    precision = jnp.where(met, past.correlation * jnp.linalg.inv(blocked), precision)
    slid = jnp.concatenate([T[None], T_prior @ se3_exp(obstacles.slid(back, turns) @ basis.T)])
    again = lambda: solver(precision, start_poses.best(slid, precision, problem, config.align))
    T, fit_quality = jax.lax.cond(met, again, lambda: (T, fit_quality))
    covariance = predicted.covariance.at[:p, :p].set(jnp.where(met, blocked, pose_covariance))
    return _Solved(T, fit_quality, replace(predicted, covariance=covariance), precision, met)


def _from_prediction(problem: Problem, T_ref_cam: Float[Array, "4 4"]) -> Float[Array, "p"]:
    """Return the step from the predicted pose to another one, in the tangent of the predicted pose."""
    return jnp.linalg.pinv(problem.basis) @ se3_log(inverse(problem.T_prior) @ T_ref_cam)


def _carried(
    past: Past,
    transition: Transition,
    control: Float[Array, "m"],
    dt: Float[Array, ""],
    distance: Float[Array, ""],
    config: TrackingConfig,
) -> Considered:
    """Return what is considered before the image: an error of the surfaces is forgotten as they are seen from afar."""
    if config.surface_error is None:
        return past.considered
    F = transition.jacobian(past.belief.mean, control, dt)
    return past.considered.predict(F, jnp.exp(-distance / config.surface_error.patch))


def _displacement(before: GaussianBelief, predicted: GaussianBelief, image: RGBD, rig: Rig) -> Float[Array, ""]:
    """``f (|v| / depth + |w|)``: about how far a step shifts the pixels of an image at its mean depth, pixels."""
    pose = predicted.manifold.pose
    T_before_after = inverse(pose(before.mean) @ rig.T_body_cam) @ pose(predicted.mean) @ rig.T_body_cam
    twist = se3_log(T_before_after)
    depth = jnp.sum(jnp.where(image.hit, image.depth, 0.0)) / jnp.maximum(jnp.sum(image.hit), 1)
    return rig.camera.fx * (jnp.linalg.norm(twist[:3]) / jnp.maximum(depth, 0.1) + jnp.linalg.norm(twist[3:]))
