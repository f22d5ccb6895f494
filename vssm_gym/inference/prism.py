"""PRISM: two marginal filters, ``q_t(z_t) ~ p(z_t | x_<=t, u_<t)`` and ``q_t(M) ~ p(M | x_<=t, u_<t)`` (SPEC 3).

One step, for a camera that moves as a rigid body with constant velocity (or a known acceleration):

1. *Prior.* The belief is pushed through the linearised transition and split, ``q(pose) q(velocity | pose)``.
2. *Pose by MAP* against the anchor, an image rendered from the map mean with the image seen there beside it.
3. *Laplace.* ``Sigma^-1 = 2 J^T J + P_prior``, smoothed over time.
4. *Velocity* in closed form: the new ``q(pose)`` times the old ``q(velocity | pose)``.
5. *Map* by the closed-form update; then a new anchor, where the camera has left the old one.

Approximations, where they are made: the pose is found against the map's mean and the map is updated at the pose's mean
(single-sample expectations; ``samples`` widens both), pose and map are not correlated, and cells are independent. An
image that does not fit updates neither belief; recovery then tries other poses (:mod:`recovery`).
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from vssm_gym.camera import Camera
from vssm_gym.emission import RGBD
from vssm_gym.geometry import inverse, se3_exp, se3_log
from vssm_gym.inference import anchor, belief, drift, gauss_newton, keyframes, map_update, process_noise, recentre
from vssm_gym.inference.adam import align_adam
from vssm_gym.inference.alignment import (
    AlignConfig,
    AlignInfo,
    disagreement,
    luminance,
    make_observed,
    make_reference,
    score,
    shrink_camera,
    shrink_rgbd,
    stride,
)
from vssm_gym.inference.anchor import Anchor
from vssm_gym.inference.belief import Gaussian
from vssm_gym.inference.keyframes import Keyframes
from vssm_gym.inference.map_update import MapUpdateConfig
from vssm_gym.inference.recovery import RecoveryConfig, recover
from vssm_gym.inference.rotation import RotationConfig, camera_rotation
from vssm_gym.transition.rigid import RigidBelief, RigidNoise, RigidState, perturb, predict
from vssm_gym.voxel_map import VoxelMap

OK, RECOVERED, LOST, NO_READING = 0, 1, 2, 3
STATUS = {
    OK: "ok",
    RECOVERED: "found again: the image fits the map at a pose other than the expected one",
    LOST: "lost track: the image fits neither the map nor the last image",
    NO_READING: "no depth reading: nothing to align",
}


@dataclass(frozen=True)
class PrismConfig:
    """Noise, solver and effort. Stds of the motion are those of a hand; SPEC 3's are ``RigidNoise()``."""

    # Flatter in depth than one pixel's noise: far points are few but they hold the rotation.
    align: AlignConfig = field(
        default_factory=lambda: AlignConfig(0.006, 0.001, edge=0.02, levels=(4, 2, 1), iterations=(6, 4, 4))
    )
    rotation: RotationConfig = field(default_factory=RotationConfig)
    update: MapUpdateConfig = field(default_factory=MapUpdateConfig)
    recovery: RecoveryConfig = field(default_factory=RecoveryConfig)
    noise: RigidNoise = field(default_factory=lambda: RigidNoise(0.15, 0.01, 0.3, 0.01))
    solver: str = "gauss_newton"  # a key of SOLVERS
    samples: int = 1  # of the pose in the map update; from 2 on the map's uncertainty also widens the pose's residuals
    smoothing: float = 0.8  # of the Laplace covariance over time
    track_width: int = 160  # pixels: images are shrunk to about this for tracking; the map takes them whole
    anchor_distance: float = 0.15  # m and
    anchor_angle: float = 0.15  # rad: the anchor serves until the camera is farther from it than either
    window_margin: float = 0.25  # of the map's edge: the window follows a camera farther than this from its middle
    min_score: float = 0.6  # of :func:`alignment.score`
    max_photometric: float = 5.0  # mean |r_rgb| / sigma; cells of 7 cm blur the rendered image by that much
    max_surprise: float = (
        12.0  # std of the predicted pose, beyond which the camera jumped: the prior would hold it back
    )
    start_velocity: tuple[float, float] = (0.5, 1.0)  # m/s, rad/s: std of an unknown velocity


Problem = tuple[Array, Array, Array, Array, RGBD, RGBD, Camera]  # as the solvers take it, up to the camera


def _by_gauss_newton(problem: Problem, against: Anchor, config: AlignConfig, key: Array) -> tuple[Array, AlignInfo]:
    return gauss_newton.align(*problem, config=config, seen=against.seen, spread=against.spread)


def _by_adam(problem: Problem, against: Anchor, config: AlignConfig, key: Array) -> tuple[Array, AlignInfo]:
    return align_adam(*problem, config=config, key=key)


SOLVERS = {"gauss_newton": _by_gauss_newton, "adam": _by_adam}


class PrismState(eqx.Module):
    """What the next step needs."""

    map: VoxelMap  # q_t(M)
    belief: RigidBelief  # q_t(z_t), of the camera against the map: T_world_cam and its velocity
    last: RGBD  # the last image that fitted, tracking size,
    T_world_last: Float[Array, "4 4"]  # and its pose
    anchor: Anchor
    keyframes: Keyframes
    drift: Float[Array, "6 6"]  # covariance of the map's frame around the camera in the world, tangent of the world
    unrest: process_noise.Level  # how much of the configured process noise this hand has needed of late
    key: PRNGKeyArray


class PrismInfo(eqx.Module):
    """How a step went."""

    status: int  # a key of STATUS
    belief: RigidBelief  # in the world, the map's drift included; lost: the last pose that fitted, its spread growing
    agreement: AlignInfo  # against the anchor; of the best start, where track was found again
    left_window: int = 0  # observed blocks that the map forgot, because the camera left its window


class _Tracked(eqx.Module):
    belief: RigidBelief
    predicted: RigidBelief  # with the configured noise: where the camera may be at all
    unrest: process_noise.Level
    T_world_turned: Float[Array, "4 4"]  # the last pose, turned by the rotation between the images
    agreement: AlignInfo
    fits: Bool[Array, ""]


Clock = Callable[[str, Any], Any]


def _untimed(stage: str, outcome: Any) -> Any:
    return outcome


def tracking_factor(camera: Camera, config: PrismConfig) -> int:
    """By how much images of ``camera`` are shrunk for tracking."""
    return max(1, round(camera.width / config.track_width))


def _at_rest(T_world_cam: Array, pose_covariance: Array, config: PrismConfig) -> RigidBelief:
    """A pose with an unknown velocity around zero."""
    linear, angular = config.start_velocity
    velocity = jnp.asarray([linear**2] * 3 + [angular**2] * 3)
    covariance = jnp.zeros((12, 12)).at[:6, :6].set(pose_covariance).at[6:, 6:].set(jnp.diag(velocity))
    return RigidBelief(RigidState(T_world_cam, jnp.zeros(6)), covariance)


@partial(jax.jit, static_argnums=9)
def _track(
    prior: RigidBelief,
    unrest: process_noise.Level,
    control: Array,
    dt: Array,
    last: tuple[RGBD, Array],
    against: Anchor,
    image: RGBD,
    camera: Camera,
    key: Array,
    config: PrismConfig,
) -> _Tracked:
    """Steps 1 to 4: the belief over pose and velocity given the image."""
    possible = predict(prior, control, dt, config.noise)
    predicted = predict(prior, control, dt, process_noise.scaled(config.noise, unrest))
    pose, velocity_given_pose = belief.split(Gaussian(jnp.zeros(12), predicted.covariance), 6)
    last_image, T_world_last = last
    R = camera_rotation(luminance(image.rgb), luminance(last_image.rgb), camera, config.rotation)
    T_world_turned = T_world_last.at[:3, :3].set(T_world_last[:3, :3] @ R)
    T_anchor_world = inverse(against.T_world_cam)
    T_prior = T_anchor_world @ predicted.state.T_world_body
    precision = jnp.linalg.inv(pose.covariance)
    # A hand jerks, and the last image turned is the better start; facing a wall of tiles only the motion so far tells
    # a step to the left from a turn.
    starts = jnp.stack([T_anchor_world @ T_world_turned, T_prior])
    factor = config.align.levels[-1]
    ref = make_reference(against.image, camera, config.align, factor)
    obs = make_observed(image, camera, factor, stride(camera, factor, config.align))
    costs = [disagreement(T, ref, obs, camera, factor, config.align) for T in starts]
    start = starts[jnp.argmin(jnp.stack(costs))]
    problem = (T_prior, precision, start, jnp.eye(6), against.image, image, camera)
    T, agreement = SOLVERS[config.solver](problem, against, config.align, key)
    laplace = jnp.linalg.inv(2.0 * agreement.information + precision)
    smoothed = config.smoothing * prior.covariance[:6, :6] + (1.0 - config.smoothing) * laplace
    # The new pose's error is measured from the new mean, the conditional's from the predicted one: to first order,
    # and a step is short, the two tangents are one.
    moved = se3_log(inverse(T_prior) @ T)
    both = belief.joint(Gaussian(moved, smoothed), velocity_given_pose)
    posterior = RigidBelief(perturb(predicted.state, both.mean), both.covariance)
    fits = (score(agreement) >= config.min_score) & (agreement.photometric <= config.max_photometric)
    fits &= moved @ jnp.linalg.solve(possible.covariance[:6, :6], moved) <= config.max_surprise**2
    fits &= jnp.all(jnp.isfinite(both.covariance))
    unrest = process_noise.adapt(unrest, moved, dt, config.noise)
    return _Tracked(posterior, possible, unrest, T_world_turned, agreement, fits)


@partial(jax.jit, static_argnums=2)
def _draw_poses(posterior: RigidBelief, key: Array, samples: int) -> Float[Array, "samples 4 4"]:
    """Poses from ``q(z_pose)``, the mean among them: an expectation of few samples must not move the map."""
    root = jnp.linalg.cholesky(posterior.covariance[:6, :6] + 1e-12 * jnp.eye(6))
    half = jax.random.normal(key, (samples // 2, 6)) @ root.T
    errors = jnp.concatenate([jnp.zeros((1, 6)), half, -half])[:samples]
    return posterior.state.T_world_body @ se3_exp(errors)


def _mapped(
    m: VoxelMap, image: RGBD, posterior: RigidBelief, camera: Camera, key: Array, config: PrismConfig
) -> VoxelMap:
    """Step 5, at the pose's mean or in expectation over its samples."""
    if config.samples == 1:
        T = posterior.state.T_world_body
        return map_update.update(m, image.depth, image.rgb, T, camera, config.update)
    poses = _draw_poses(posterior, key, config.samples)
    return map_update.update_expected(m, image.depth, image.rgb, poses, camera, config.update)


def init(
    m: VoxelMap,
    image: RGBD,
    camera: Camera,
    config: PrismConfig,
    key: PRNGKeyArray,
    clock: Clock = _untimed,
) -> PrismState:
    """The belief after the first image, taken at the identity: the world is its camera's frame.

    Args:
        m: The map's prior; consumed.
        image: The first image; it must have depth.
        camera: Its intrinsics.
        config: Noise, solver and effort.
        key: Of everything drawn from here on.
        clock: As of :func:`step`.
    """
    factor = tracking_factor(camera, config)
    small, view = _shrink(image, factor), shrink_camera(camera, factor)
    T = jnp.eye(4, dtype=jnp.float32)
    m = clock("map", map_update.update(m, image.depth, image.rgb, T, camera, config.update))
    kept = keyframes.remember(keyframes.empty(view), T, luminance(small.rgb), view)
    against = clock("anchor", anchor.take(m, T, small, view, config.update.max_depth, config.samples > 1))
    return PrismState(
        m, _at_rest(T, 1e-8 * jnp.eye(6), config), small, T, against, kept, jnp.zeros((6, 6)), process_noise.full(), key
    )


_shrink = jax.jit(shrink_rgbd, static_argnums=1)
_shift = jax.jit(recentre.shift_to_centre)


def step(
    state: PrismState,
    image: RGBD,
    dt: float,
    camera: Camera,
    config: PrismConfig,
    control: Float[Array, "6"] | None = None,
    clock: Clock = _untimed,
) -> tuple[PrismState, PrismInfo]:
    """``q_t-1(z) q_t-1(M) -> q_t(z) q_t(M)``. The state passed in is consumed (the map is updated in place).

    The stages are separate compiled calls: in one, the compiler fuses the renderer into each of the many places that
    read its image and computes it again there (it ignores optimization barriers on the CPU).

    Args:
        state: After the last image.
        image: The new one, at the camera's size.
        dt: Seconds since the last one, above 0.
        camera: Its intrinsics.
        config: Noise, solver and effort.
        control: Linear (m/s^2) and angular (rad/s^2) acceleration in the world; none for constant velocity.
        clock: Given the name and the outcome of each stage, returns the outcome; for timing.

    Returns:
        The next state and how the step went; ``info.status`` is a key of :data:`STATUS`.
    """
    factor = tracking_factor(camera, config)
    small, view = _shrink(image, factor), shrink_camera(camera, factor)
    key, solving, mapping = jax.random.split(state.key, 3)
    state = eqx.tree_at(lambda s: s.key, state, key)
    acceleration = jnp.zeros(6) if control is None else control
    last = (state.last, state.T_world_last)
    tracked = clock(
        "track",
        _track(
            state.belief, state.unrest, acceleration, jnp.float32(dt), last, state.anchor, small, view, solving, config
        ),
    )
    posterior, agreement, unrest, status = tracked.belief, tracked.agreement, tracked.unrest, OK
    if not tracked.fits:
        posterior, agreement, status = _search(state, tracked, small, view, config)
        clock("recover", posterior)
        unrest = process_noise.full()
        if status != RECOVERED:
            lost = eqx.tree_at(lambda s: (s.belief, s.unrest), state, (posterior, unrest))
            return lost, PrismInfo(status, drift.in_world(posterior, state.drift), agreement)
    T = posterior.state.T_world_body
    m, dropped = state.map, 0
    shift = _shift(m, T[:3, 3], config.window_margin * min(m.shape) * m.voxel_size)
    if shift.any():
        m, fell = recentre.recentre(m, shift)
        dropped = int(fell)
    drifted = drift.grow(state.drift, m, posterior, small, view)
    m = clock("map", _mapped(m, image, posterior, camera, mapping, config))
    kept = keyframes.remember(state.keyframes, T, luminance(small.rgb), view)
    against = state.anchor
    if status == RECOVERED or anchor.left(against, T, config.anchor_distance, config.anchor_angle):
        against = anchor.take(m, T, small, view, config.update.max_depth, config.samples > 1)
        against = clock("anchor", against)
    return PrismState(m, posterior, small, T, against, kept, drifted, unrest, key), PrismInfo(
        status, drift.in_world(posterior, drifted), agreement, dropped
    )


def _search(
    state: PrismState, tracked: _Tracked, image: RGBD, camera: Camera, config: PrismConfig
) -> tuple[RigidBelief, AlignInfo, int]:
    """An image that does not fit: the pose where the map explains it, or the last one with a spread that grows."""
    status = LOST if image.hit.any() else NO_READING
    if status == LOST:
        similar = keyframes.similar(
            state.keyframes, luminance(image.rgb), camera, config.rotation, config.recovery.keyframes
        )
        starts = jnp.stack([tracked.T_world_turned, tracked.predicted.state.T_world_body, state.T_world_last, *similar])
        attempt = recover(state.map, starts, image, camera, config.update.max_depth, config.recovery)
        if attempt.fits:
            covariance = jnp.linalg.inv(2.0 * attempt.agreement.information + jnp.eye(6))
            return _at_rest(attempt.T_world_cam, covariance, config), attempt.agreement, RECOVERED
    spread = tracked.predicted.covariance[:6, :6]
    return _at_rest(state.T_world_last, spread, config), tracked.agreement, status
