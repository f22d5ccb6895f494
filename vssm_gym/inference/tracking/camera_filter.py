"""``q(z_t) ~ p(x_t | z_t, q(M)) int p(z_t | z_t-1, u) q(z_t-1)`` for one image (PRISM, steps 1 to 4).

Prior by any linearised transition, pose by MAP against a reference view, Laplace covariance, the rest of the state in
closed form. The filters update the map, and decide how to proceed after an image that is not accepted.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from vssm_gym.errors import InputError
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import inverse, se3_adjoint, se3_exp, se3_log
from vssm_gym.inference import linear_gaussian
from vssm_gym.inference.alignment import gauss_newton
from vssm_gym.inference.alignment.adam import AdamConfig, align_adam
from vssm_gym.inference.alignment.exposure import expose, gain
from vssm_gym.inference.alignment.reference_view import ReferenceView
from vssm_gym.inference.alignment.residuals import (
    AlignConfig,
    AlignInfo,
    alignment_cost,
    linearise,
    luminance,
    make_observed,
    make_reference,
    score,
    stride,
)
from vssm_gym.inference.alignment.rotation import RotationConfig, camera_rotation
from vssm_gym.inference.alignment.surface_error import Influence, SurfaceErrorConfig, influence
from vssm_gym.inference.filter import Rig
from vssm_gym.inference.linear_gaussian import Gaussian
from vssm_gym.inference.tracking import process_noise
from vssm_gym.inference.tracking.confirmation import ConfirmationConfig, colour_confirms
from vssm_gym.inference.tracking.error_covariance import Considered, nothing
from vssm_gym.inference.tracking.process_noise import ProcessNoiseConfig
from vssm_gym.model.emission import RGBD
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import Belief, GaussianBelief
from vssm_gym.model.transition.manifold import Manifold

Problem = tuple[Array, Array, Array, Array, RGBD, RGBD, Camera]  # as the solvers take it, up to the camera


@dataclass(frozen=True)
class TrackingConfig:
    """Configure how the pose is estimated and when it is accepted. The defaults are those of a hand-held camera."""

    # Grows less with depth than one pixel's noise: far points are few but they constrain the rotation.
    align: AlignConfig = field(
        default_factory=lambda: AlignConfig(0.006, 0.001, edge=0.02, levels=(4, 2, 1), iterations=(6, 4, 4))
    )
    solver: str = "gauss_newton"  # a key of SOLVERS
    adam: AdamConfig = field(default_factory=AdamConfig)  # of the solver of that name
    rotation: RotationConfig | None = field(default_factory=RotationConfig)  # of the start; None: start as predicted
    heading_starts: tuple[float, ...] = ()  # stds: further starts are turned by them from the prediction
    search_reach: float = 0.075  # rad: no further starts where the angles' stds are smaller
    exposure: bool = True  # whether to estimate the camera's gain
    adaptation: ProcessNoiseConfig | None = field(
        default_factory=ProcessNoiseConfig
    )  # of the process noise; None: fixed
    surface_error: SurfaceErrorConfig | None = field(
        default_factory=SurfaceErrorConfig
    )  # of what poses are aligned to; None: the published Laplace covariance
    most_correlated: float = 1.0  # factor by which data weigh less against the prior, at most: their errors are alike
    smoothing: float = 0.8  # of the published Laplace covariance over time
    min_reading: float = 0.05  # share of the pixels that have depth; an image with fewer has no reading
    min_score: float = 0.6  # of :func:`alignment.score`
    max_photometric: float = 5.0  # mean |r_rgb| / sigma; cells of 7 cm blur the rendered image by that much
    repeated_displacement: float = 0.5  # pixels: a camera that is predicted to move by more repeats no depth image
    max_surprise: float = 12.0  # stds of the predicted pose: beyond them the camera jumped and the prior is wrong
    max_unconfirmed: float = 4.0  # stds of the predicted pose: a larger step must be confirmed
    confirmation: ConfirmationConfig | None = field(
        default_factory=ConfirmationConfig
    )  # by the colour; None: not needed
    start_velocity: tuple[float, float] = (0.5, 1.0)  # m/s, rad/s: std of an unknown velocity

    def __post_init__(self) -> None:
        if self.solver not in SOLVERS:
            raise InputError("TrackingConfig", "solver", f"one of {', '.join(SOLVERS)}; found {self.solver!r}")


def _by_gauss_newton(
    problem: Problem, reference: ReferenceView, config: "TrackingConfig", key: Array
) -> tuple[Array, AlignInfo]:
    return gauss_newton.align(*problem, config=config.align, seen=reference.seen, spread=reference.spread)


def _by_adam(
    problem: Problem, reference: ReferenceView, config: "TrackingConfig", key: Array
) -> tuple[Array, AlignInfo]:
    return align_adam(*problem, config=config.align, key=key, adam=config.adam, spread=reference.spread)


SOLVERS = {"gauss_newton": _by_gauss_newton, "adam": _by_adam}


class Past(eqx.Module):
    """Hold what the next image is filtered with."""

    belief: GaussianBelief  # q_t-1(z)
    laplace: Float[Array, "p p"]  # published covariance of the poses up to here; 0: the last image was not accepted
    considered: Considered
    correlation: Float[Array, ""]  # variance of the image's gradient over that of independent data
    noise_scale: process_noise.NoiseScale
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
    T_world_turned: Float[Array, "4 4"]  # the last camera pose, turned by the rotation between the images
    gain: Float[Array, ""]  # of the image: see :mod:`exposure`
    fit_quality: AlignInfo
    accepted: Bool[Array, ""]
    expected: Bool[Array, ""]  # the step needs no confirmation (eq. I28)
    repeated: Bool[Array, ""]  # the depth image is that of the last accepted image, bit for bit, of a camera that moves


# For a body whose commands are known. Three degrees of freedom and a known command suffice where six and constant
# velocity do not: in front of a bare wall, and in turns that start and end within a frame. A badly executed turn ends
# further from the predicted one than the search reaches from there.
COMMANDED = TrackingConfig(
    rotation=None,
    heading_starts=(-2.0, -1.0, 1.0, 2.0),
    exposure=False,
    adaptation=None,
    most_correlated=10.0,
    smoothing=0.0,
    min_reading=0.0,
    min_score=0.5,
    max_surprise=float("inf"),
    confirmation=None,
)


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
        prior, jnp.zeros((p, p)), considered, jnp.ones(()), process_noise.full(), image, camera_pose(prior, rig)
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
    pose_covariance = predicted.covariance[:p, :p]
    basis = camera_twists(manifold, rig)
    T_ref_world = inverse(reference.T_world_cam)
    T_prior = T_ref_world @ manifold.pose(predicted.mean) @ rig.T_body_cam
    starts, image, brightness, T_world_turned = _start(past, T_prior, T_ref_world, reference, image, rig.camera, config)
    start = starts[0]
    # Data whose errors are alike weigh less against the prior.
    precision = past.correlation * jnp.linalg.inv(pose_covariance)
    if config.heading_starts:
        turned = _turned(pose_covariance, manifold.turns[:p], config.heading_starts)
        wide = jnp.max(jnp.where(manifold.turns[:p], jnp.diagonal(pose_covariance), 0.0)) > config.search_reach**2
        best = lambda starts: _best_start(starts, T_prior, precision, basis, reference, image, rig, config)
        start = jax.lax.cond(wide, best, lambda _: start, T_prior @ se3_exp(turned @ basis.T))
    solve = lambda precision, start: SOLVERS[config.solver](
        (T_prior, precision, start, basis, reference.image, image, rig.camera), reference, config, key
    )
    T, fit_quality = solve(precision, start)
    if transition.commanded:
        back = jnp.linalg.pinv(basis) @ se3_log(inverse(T_prior) @ T_ref_world @ past.T_world_cam)
    if transition.commanded and config.surface_error is not None:
        first = jnp.linalg.pinv(basis) @ se3_log(inverse(T_prior) @ T)
        wide = pose_covariance + _obstruction(back, manifold.turns[:p])
        met = _surprise(first, predicted) > config.max_unconfirmed**2
        precision = jnp.where(met, past.correlation * jnp.linalg.inv(wide), precision)
        covariance = predicted.covariance.at[:p, :p].set(jnp.where(met, wide, pose_covariance))
        predicted = replace(predicted, covariance=covariance)
        T, fit_quality = jax.lax.cond(met, lambda: solve(precision, T), lambda: (T, fit_quality))
    # The new pose's error is measured from the new mean, the conditional's from the predicted one: to first order,
    # and a step is short, the two tangents are one.
    moved = jnp.linalg.pinv(basis) @ se3_log(inverse(T_prior) @ T)
    distance = jnp.linalg.norm(manifold.pose(predicted.mean)[:3, 3] - manifold.pose(past.belief.mean)[:3, 3])
    carried = _carried(past, transition, control, dt, distance, config)
    if config.surface_error is None:
        both, laplace, smoothed = _published(past, predicted, moved, precision, fit_quality, config)
        considered, correlation = carried, past.correlation
    else:
        given_image = influence(T, basis, reference, image, rig.camera, config.align, config.surface_error)
        fit_quality = eqx.tree_at(lambda q: q.information, fit_quality, given_image.curvature)
        both, laplace, considered = _propagated(carried, predicted, moved, precision, given_image)
        smoothed = laplace = past.correlation * laplace
        correlation = jnp.clip(given_image.correlation(precision), 1.0, config.most_correlated)
    posterior = GaussianBelief(manifold.perturb(predicted.mean, both.mean), both.covariance, manifold)
    accepted = (score(fit_quality) >= config.min_score) & (fit_quality.photometric <= config.max_photometric)
    accepted &= jnp.mean(image.hit) >= config.min_reading
    surprise = _surprise(moved, possible)
    accepted &= surprise <= config.max_surprise**2
    if transition.commanded:
        expected = _surprise(_unobstructed(moved, back, manifold.turns[:p]), possible) <= config.max_unconfirmed**2
    else:
        expected = jnp.logical_not(lost) & (surprise <= config.max_unconfirmed**2)
    if config.confirmation is not None:
        accepted &= colour_confirms(
            T, starts, expected, reference, image, rig.camera, config.align, config.confirmation
        )
    # A camera that moves repeats no image; one that stands may, where images have no noise. Where the commands are
    # known, a blocked robot may see the same.
    repeated = jnp.all(image.depth == past.image.depth) & (not transition.commanded)
    repeated &= _displacement(past.belief, predicted, image, rig) > config.repeated_displacement
    accepted &= ~repeated
    accepted &= jnp.all(jnp.isfinite(both.covariance))
    noise_scale = past.noise_scale
    if config.adaptation is not None:
        noise = transition.noise_covariance(past.belief.mean, control, dt)[:p, :p]
        noise_scale = process_noise.adapt(
            past.noise_scale, moved, pose_covariance, laplace, dt, noise, manifold, config.adaptation
        )
    T_world_cam = manifold.pose(posterior.mean) @ rig.T_body_cam
    return Tracked(
        posterior,
        T_world_cam,
        smoothed,
        considered,
        correlation,
        carried,
        possible,
        noise_scale,
        T_world_turned,
        brightness,
        fit_quality,
        accepted,
        expected,
        repeated,
    )


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


def _published(
    past: Past,
    predicted: GaussianBelief,
    moved: Float[Array, "p"],
    precision: Float[Array, "p p"],
    fit_quality: AlignInfo,
    config: TrackingConfig,
) -> tuple[Gaussian, Float[Array, "p p"], Float[Array, "p p"]]:
    """``Sigma^-1 = 2 J^T J + P^-1``, averaged over time: the belief, the covariance of this pose, and the average."""
    p = len(moved)
    laplace = jnp.linalg.inv(2.0 * fit_quality.information + precision)
    kept = config.smoothing * (jnp.trace(past.laplace) > 0.0)
    smoothed = kept * past.laplace + (1.0 - kept) * laplace
    both = Gaussian(moved, smoothed)
    if p < predicted.covariance.shape[0]:
        _, rest_given_pose = linear_gaussian.split(
            Gaussian(jnp.zeros_like(predicted.covariance[0]), predicted.covariance), p
        )
        both = linear_gaussian.joint(both, rest_given_pose)
    return both, laplace, smoothed


def _propagated(
    carried: Considered,
    predicted: GaussianBelief,
    moved: Float[Array, "p"],
    precision: Float[Array, "p p"],
    given: Influence,
) -> tuple[Gaussian, Float[Array, "p p"], Considered]:
    """``e <- (1 - K H) e + K g``, ``K = (P^-1 + H)^-1``: the errors that the estimate has, by their sources (eq. I15).

    Returns:
        The step of the state with its covariance, the covariance of the pose if pixels had independent errors, and
        what is considered.
    """
    p, n = len(moved), predicted.covariance.shape[0]
    laplace = jnp.linalg.inv(given.curvature + precision)
    K = laplace
    if p < n:
        _, rest = linear_gaussian.split(Gaussian(jnp.zeros(n), predicted.covariance), p)
        K = jnp.concatenate([laplace, rest.A @ laplace])
        moved = jnp.concatenate([moved, rest.A @ moved])
    A = jnp.eye(n) - jnp.pad(K @ given.curvature, ((0, 0), (0, n - p)))
    covariance, considered = carried.correct(predicted.covariance, A, K, given)
    return Gaussian(moved, covariance), laplace, considered


def _surprise(moved: Float[Array, "p"], predicted: GaussianBelief) -> Float[Array, ""]:
    """``e^T P^-1 e``: the squared size of a step away from the predicted pose, in standard deviations."""
    p = len(moved)
    return moved @ jnp.linalg.solve(predicted.covariance[:p, :p], moved)


def _unobstructed(moved: Float[Array, "p"], back: Float[Array, "p"], turns: Bool[np.ndarray, "p"]) -> Float[Array, "p"]:
    """Return what no obstacle explains of the step from the predicted pose to the estimate (eq. I28).

    An obstacle stops a body between its last pose and the predicted one, or lets it slide along a wall: the projections
    of the commanded translation onto all walls fill the sphere with that translation as its diameter.

    Args:
        moved: from the predicted pose to the estimate, tangent of the predicted pose.
        back: from the predicted pose to the last one.
        turns: True for the coordinates that are angles.
    """
    turned = moved - jnp.clip(moved, jnp.minimum(back, 0.0), jnp.maximum(back, 0.0))
    off, radius = jnp.where(turns, 0.0, moved - back / 2), jnp.linalg.norm(jnp.where(turns, 0.0, back)) / 2
    beyond = jnp.maximum(0.0, 1.0 - radius / jnp.maximum(jnp.linalg.norm(off), 1e-9))
    return jnp.where(turns, turned, beyond * off)


def _obstruction(back: Float[Array, "p"], turns: Bool[np.ndarray, "p"]) -> Float[Array, "p p"]:
    """Return the covariance of what an obstacle does to a step: it stops a body, or lets it slide, in any direction.

    Args:
        back: from the predicted pose to the last one.
        turns: True for the coordinates that are angles.
    """
    length = jnp.linalg.norm(jnp.where(turns, 0.0, back))
    return jnp.diag(jnp.where(turns, back**2, length**2))


def _displacement(before: GaussianBelief, predicted: GaussianBelief, image: RGBD, rig: Rig) -> Float[Array, ""]:
    """``f (|v| / depth + |w|)``: about how far a step shifts the pixels of an image at its mean depth, pixels."""
    pose = predicted.manifold.pose
    T_before_after = inverse(pose(before.mean) @ rig.T_body_cam) @ pose(predicted.mean) @ rig.T_body_cam
    twist = se3_log(T_before_after)
    depth = jnp.sum(jnp.where(image.hit, image.depth, 0.0)) / jnp.maximum(jnp.sum(image.hit), 1)
    return rig.camera.fx * (jnp.linalg.norm(twist[:3]) / jnp.maximum(depth, 0.1) + jnp.linalg.norm(twist[3:]))


def _turned(
    covariance: Float[Array, "p p"], turns: Bool[np.ndarray, "p"], stds: tuple[float, ...]
) -> Float[Array, "starts p"]:
    """``s P[:, j] / sqrt(P[j, j])``: zero, and the likeliest errors where an angle j is off by s stds (eq. I14)."""
    columns = [covariance[:, j] / jnp.sqrt(covariance[j, j]) for j in np.flatnonzero(turns)]
    return jnp.stack([jnp.zeros(len(covariance)), *(s * column for column in columns for s in stds)])


def _best_start(
    starts: Float[Array, "starts 4 4"],
    T_prior: Float[Array, "4 4"],
    precision: Float[Array, "p p"],
    basis: Float[Array, "6 p"],
    reference: ReferenceView,
    image: RGBD,
    rig: Rig,
    config: TrackingConfig,
) -> Float[Array, "4 4"]:
    """Return the likeliest of the poses that the search on the smallest images finds from each start."""
    camera, align = rig.camera, config.align
    small = replace(align, levels=align.levels[:1], iterations=align.iterations[:1])
    search = lambda T: gauss_newton.align(
        T_prior, precision, T, basis, reference.image, image, camera, small, reference.seen, reference.spread
    )[0]
    found = jax.vmap(search)(starts)
    factor = align.levels[-1]
    ref = make_reference(reference.image, camera, align, factor)
    every = stride(camera, factor, align)
    obs = make_observed(image, camera, factor, every)
    data = jnp.sum(obs.valid) * (factor * every) ** 2 / align.pixels_per_datum  # independent ones
    coordinates, T_inverse_prior = jnp.linalg.pinv(basis), inverse(T_prior)

    def surprise(T):
        xi = coordinates @ se3_log(T_inverse_prior @ T)
        return data * alignment_cost(T, ref, obs, camera, factor, align) + 0.5 * xi @ precision @ xi

    return found[jnp.argmin(jax.vmap(surprise)(found))]


def _start(
    past: Past,
    T_prior: Float[Array, "4 4"],
    T_ref_world: Float[Array, "4 4"],
    reference: ReferenceView,
    image: RGBD,
    camera: Camera,
    config: TrackingConfig,
) -> tuple[Array, RGBD, Array, Array]:
    """Return the start poses, the best first, the image at the map's exposure, its gain, and the last pose turned.

    Two start poses are compared by alignment cost. After a sudden motion, the last pose turned by the estimated
    rotation is better; in front of a tiled wall, only the prediction distinguishes a step to the left from a turn.
    """
    T_world_turned, starts = past.T_world_cam, T_prior[None]
    if config.rotation is not None:
        # For the rotation alone, whole images are made equally bright; their common part is not known yet.
        grey, last = luminance(image.rgb), luminance(past.image.rgb)
        alike = jnp.clip(gain(last, grey, jnp.ones_like(grey, bool)) * grey, 0.0, 1.0)
        R = camera_rotation(alike, last, camera, config.rotation)
        T_world_turned = past.T_world_cam.at[:3, :3].set(past.T_world_cam[:3, :3] @ R)
        starts = jnp.stack([T_ref_world @ T_world_turned, T_prior])
    brightness, align = jnp.ones(()), config.align
    factor = align.levels[-1]
    observed = lambda image: make_observed(image, camera, factor, stride(camera, factor, align))
    if config.exposure or len(starts) > 1:
        ref, obs = make_reference(reference.image, camera, align, factor), observed(image)
    if config.exposure:
        _, rgb, *_ = linearise(starts[0], ref, obs, camera, factor, align)
        brightness = gain(obs.luminance + align.rgb_sigma * rgb.residual, obs.luminance, rgb.usable)
        image = expose(image, brightness)
        obs = observed(image)
    if len(starts) == 1:
        return starts, image, brightness, T_world_turned
    costs = jax.vmap(lambda T: alignment_cost(T, ref, obs, camera, factor, align))(starts)
    return starts[jnp.argsort(costs)], image, brightness, T_world_turned
