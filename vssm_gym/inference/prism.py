"""PRISM: two marginal filters, ``q_t(z_t) ~ p(z_t | x_<=t, u_<t)`` and ``q_t(M) ~ p(M | x_<=t, u_<t)`` (SPEC 3).

One step, for a camera that moves as a rigid body with constant velocity (or a known acceleration); 1 to 4 are in
:mod:`camera_filter`:

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
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.camera import Camera
from vssm_gym.emission import RGBD
from vssm_gym.errors import InputError
from vssm_gym.geometry import se3_exp
from vssm_gym.inference import anchor, drift, keyframes, map_update, process_noise, recentre
from vssm_gym.inference.alignment import AlignInfo, luminance, shrink_camera, shrink_rgbd
from vssm_gym.inference.anchor import Anchor
from vssm_gym.inference.camera_filter import SOLVERS, Past, Tracked, track
from vssm_gym.inference.exposure import expose
from vssm_gym.inference.keyframes import Keyframes
from vssm_gym.inference.prism_config import PrismConfig
from vssm_gym.inference.recovery import recover
from vssm_gym.transition.rigid import RigidBelief, RigidState
from vssm_gym.voxel_map import VoxelMap

__all__ = ["LOST", "NO_READING", "OK", "RECOVERED", "SOLVERS", "STATUS", "PrismConfig", "PrismInfo", "PrismState"]
__all__ += ["init", "readable", "step", "tracking_factor"]

OK, RECOVERED, LOST, NO_READING = 0, 1, 2, 3
STATUS = {
    OK: "ok",
    RECOVERED: "found again: the image fits the map at a pose other than the expected one",
    LOST: "lost track: the image fits neither the map nor the last image",
    NO_READING: "no depth reading, or next to none: nothing to align",
}


class PrismState(eqx.Module):
    """What the next step needs."""

    map: VoxelMap  # q_t(M)
    past: Past  # q_t(z_t), of the camera against the map: T_world_cam and its velocity; and the image behind it
    anchor: Anchor
    keyframes: Keyframes
    drift: Float[Array, "6 6"]  # covariance of the map's frame around the camera in the world, tangent of the world
    lost: bool  # the last image did not fit
    key: PRNGKeyArray


class PrismInfo(eqx.Module):
    """How a step went."""

    status: int  # a key of STATUS
    belief: RigidBelief  # in the world, the map's drift included; lost: the last pose that fitted, its spread growing
    agreement: AlignInfo  # against the anchor; of the best start, where track was found again
    left_window: int = 0  # observed blocks that the map forgot, because the camera left its window


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


@partial(jax.jit, static_argnums=2)
def _draw_poses(posterior: RigidBelief, key: Array, samples: int) -> Float[Array, "samples 4 4"]:
    """Poses from ``q(z_pose)``, the mean among them: an expectation of few samples must not move the map.

    The others lie in pairs on either side of it, so much farther out that the second moment is the covariance.
    """
    root = jnp.linalg.cholesky(posterior.covariance[:6, :6] + 1e-12 * jnp.eye(6))
    half = (samples / (samples - 1)) ** 0.5 * jax.random.normal(key, (samples // 2, 6)) @ root.T
    errors = jnp.concatenate([jnp.zeros((1, 6)), half, -half])
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
        image: The first image.
        camera: Its intrinsics.
        config: Noise, solver and effort.
        key: Of everything drawn from here on.
        clock: As of :func:`step`.

    Raises:
        InputError: An image without a reading: see :func:`readable`.
    """
    if not readable(image, config):
        expected = f"depth at {config.min_reading:.0%} of its pixels at least: there is nothing to map"
        raise InputError("prism.init", "image", expected)
    factor = tracking_factor(camera, config)
    small, view = _shrink(image, factor), shrink_camera(camera, factor)
    T = jnp.eye(4, dtype=jnp.float32)
    m = clock("map", map_update.update(m, image.depth, image.rgb, T, camera, config.update))
    kept = keyframes.remember(keyframes.empty(view), T, luminance(small.rgb), view)
    against = clock("anchor", anchor.take(m, T, small, view, config.update.max_depth, config.samples > 1))
    belief = _at_rest(T, 1e-8 * jnp.eye(6), config)
    past = Past(belief, jnp.zeros((6, 6)), process_noise.full(), small, T)
    return PrismState(m, past, against, kept, jnp.zeros((6, 6)), False, key)


_shrink = jax.jit(shrink_rgbd, static_argnums=1)
_expose = jax.jit(expose)
_shift = jax.jit(recentre.shift_to_centre)


def readable(image: RGBD, config: PrismConfig) -> bool:
    """Whether so much of the image has depth that it can be aligned, or a map be started with it."""
    return float(jnp.mean(image.hit)) >= config.min_reading


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
        dt: Seconds since the last one.
        camera: Its intrinsics.
        config: Noise, solver and effort.
        control: Linear (m/s^2) and angular (rad/s^2) acceleration in the world; none for constant velocity.
        clock: Given the name and the outcome of each stage, returns the outcome; for timing.

    Returns:
        The next state and how the step went; ``info.status`` is a key of :data:`STATUS`.

    Raises:
        InputError: ``dt`` is not above 0.
    """
    if not 0.0 < dt < float("inf"):
        raise InputError("prism.step", "dt", f"seconds since the last image, above 0; found {dt!r}")
    factor = tracking_factor(camera, config)
    small, view = _shrink(image, factor), shrink_camera(camera, factor)
    key, solving, mapping = jax.random.split(state.key, 3)
    state = eqx.tree_at(lambda s: s.key, state, key)
    acceleration = jnp.zeros(6) if control is None else control
    tracked = track(state.past, acceleration, jnp.float32(dt), state.anchor, small, view, solving, config)
    tracked, status = clock("track", tracked), OK
    if not tracked.fits:
        tracked, status = _search(state, tracked, small, view, config)
        clock("recover", tracked.belief)
        if status != RECOVERED:
            past = Past(tracked.belief, tracked.laplace, tracked.unrest, state.past.image, state.past.T_world_cam)
            lost = eqx.tree_at(lambda s: (s.past, s.lost), state, (past, True))
            return lost, PrismInfo(status, drift.in_world(tracked.belief, state.drift), tracked.agreement)
    posterior, T = tracked.belief, tracked.belief.state.T_world_body
    image, small = _expose(image, tracked.gain), _expose(small, tracked.gain)
    m, dropped = state.map, 0
    shift = _shift(m, T[:3, 3], config.window_margin * min(m.shape) * m.voxel_size)
    if shift.any():
        m, fell = recentre.recentre(m, shift)
        dropped = int(fell)
    before = drift.precision(m, T, small, view)
    m = clock("map", _mapped(m, image, posterior, camera, mapping, config))
    drifted = drift.grow(state.drift, before, drift.precision(m, T, small, view), posterior, small)
    kept = keyframes.remember(state.keyframes, T, luminance(small.rgb), view)
    against = state.anchor
    if status == RECOVERED or anchor.left(against, T, config.anchor_distance, config.anchor_angle):
        against = anchor.take(m, T, small, view, config.update.max_depth, config.samples > 1)
        against = clock("anchor", against)
    past = Past(posterior, tracked.laplace, tracked.unrest, small, T)
    return PrismState(m, past, against, kept, drifted, False, key), PrismInfo(
        status, drift.in_world(posterior, drifted), tracked.agreement, dropped
    )


def _search(
    state: PrismState, tracked: Tracked, image: RGBD, camera: Camera, config: PrismConfig
) -> tuple[Tracked, int]:
    """An image that does not fit: the pose where the map explains it, or the last one with a spread that grows."""
    past, predicted = state.past, tracked.predicted
    status = LOST if readable(image, config) else NO_READING
    forgotten = partial(replace, unrest=process_noise.full())
    if status == LOST:
        similar = keyframes.similar(
            state.keyframes, luminance(image.rgb), camera, config.rotation, config.recovery.keyframes + 1
        )
        # A camera that was lost before is predicted to be where it was last: that start would be tried twice.
        *similar, fourth = similar
        starts = [tracked.T_world_turned, past.T_world_cam, *similar]
        starts.append(fourth if state.lost else predicted.state.T_world_body)
        attempt = recover(state.map, jnp.stack(starts), image, camera, config.update.max_depth, config.recovery)
        if attempt.fits:
            covariance = jnp.linalg.inv(2.0 * attempt.agreement.information + jnp.eye(6))
            belief = _at_rest(attempt.T_world_cam, covariance, config)
            found = {"belief": belief, "laplace": covariance, "gain": attempt.gain, "agreement": attempt.agreement}
            return forgotten(tracked, **found), RECOVERED
    # Once lost, the camera is believed to drift off at an unknown velocity: its spread grows with the time alone,
    # however many images are taken meanwhile.
    stays = _at_rest(past.T_world_cam, predicted.covariance[:6, :6], config)
    covariance = predicted.covariance if state.lost else stays.covariance
    belief = RigidBelief(stays.state, covariance)
    return forgotten(tracked, belief=belief, laplace=jnp.zeros((6, 6))), status
