"""``q_t(z_t) ~ p(z_t | x_<=t, u_<t)``, ``q_t(M) ~ p(M | x_<=t, u_<t)``: PRISM's two marginal filters.

One step, for a body that moves by any transition (constant velocity, an IMU, a robot's commands); 1 to 4 are in
:mod:`~vssm_gym.inference.tracking.camera_filter`:

1. *Prior.* The belief is pushed through the linearised transition and split, ``q(pose) q(velocity | pose)``.
2. *Pose by MAP* against the reference view: an image rendered from the map mean, with the camera image taken there.
3. *Covariance*, as errors propagate through the estimate: of the prior, of pixels, of the surfaces aligned to.
4. *Velocity* in closed form: the new pose with the old ``q(velocity | pose)``.
5. *Map* by the closed-form update; then a new reference view where the camera has left the old one.

Approximations: the pose is estimated against the map's mean and the map is updated at the pose's mean (single-sample
expectations; ``samples`` widens both), pose and map are correlated by the drift of the map's frame alone, and cells are
independent. An image that is not
accepted updates neither belief. Recovery then tries other poses (:mod:`~vssm_gym.inference.tracking.recovery`);
without recovery, the next images are compared with the map rendered where the commands have led.
"""

from dataclasses import dataclass, replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import inverse, se3_exp, se3_log
from vssm_gym.inference.alignment import reference_view
from vssm_gym.inference.alignment.exposure import expose
from vssm_gym.inference.alignment.reference_view import ReferenceView
from vssm_gym.inference.alignment.residuals import luminance
from vssm_gym.inference.filter import Clock, FilterInfo, Rig, untimed
from vssm_gym.inference.mapping import map_update, rolling_window
from vssm_gym.inference.prism import drift
from vssm_gym.inference.prism.config import HAND, HAND_HELD, PrismConfig, SensorErrors
from vssm_gym.inference.status import Status
from vssm_gym.inference.tracking import keyframes, standing_views, visual_turn
from vssm_gym.inference.tracking.camera_filter import Past, TrackingInput, begin, camera_pose, expected_pose
from vssm_gym.inference.tracking.keyframes import Keyframes
from vssm_gym.inference.tracking.localise import Located, Relocalisation, checked, localise, readable, seconds, shrunk
from vssm_gym.inference.tracking.standing_views import StandingViews
from vssm_gym.maps.pose_errors import PoseErrors
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD
from vssm_gym.model.map_samples import MeasurementNoise
from vssm_gym.model.posterior import Posterior
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import GaussianBelief

FIRST_SHARE = 0.99  # of the map in view that the first image writes; the rest keeps the pose's covariance regular


class PrismState(eqx.Module):
    """Hold the filter's state between steps."""

    map: VoxelMap  # q_t(M)
    past: Past  # q_t(z_t), of the body against the map; and the image behind it
    reference: ReferenceView
    start: Float[Array, "3"]  # m, of the body at the first image
    keyframes: Keyframes | None  # None: no recovery
    grey: Float[Array, "height width"]  # small luminance of the last image, accepted or not
    views: StandingViews | None  # seen from here; None: the body does more than to drive and turn by commands
    lost: bool  # the last image was not accepted
    known: bool  # the pose is: the last image was accepted, or the colours have shown every turn since one was
    key: PRNGKeyArray
    measurement_noise: MeasurementNoise  # of the posterior

    @property
    def belief(self) -> GaussianBelief:
        """Return ``q_t(z_t)``, of the body against the map."""
        return self.past.belief


@dataclass(frozen=True)
class Prism:
    """Filter state and map (:class:`~vssm_gym.inference.filter.Filter`) with any transition.

    Attributes:
        rig: the camera and its pose on the body.
        transition: how the body moves.
        config: effort and gates.
    """

    rig: Rig
    transition: Transition = HAND
    config: PrismConfig = HAND_HELD

    def init(self, prior: Posterior, image: RGBD, key: PRNGKeyArray, clock: Clock = untimed) -> PrismState:
        """Return the state after the first image, taken where the prior's belief has the body.

        Args:
            prior: belief over the body in the world, and the map to write into, which is consumed.
            image: the first one, at the camera's size.
            key: random key, of solvers and pose samples that draw.
            clock: called with name and outcome of each stage, returns the outcome; for timing.

        Returns:
            The state for :meth:`step`.

        Raises:
            InputError: an image without a reading (see :func:`readable`), or a prior without a map.
        """
        config = self.config
        if prior.map is None:
            raise InputError("prism.init", "prior", "a map: an empty one to begin with")
        if not readable(image, config.tracking):
            expected = f"depth at {config.tracking.min_reading:.0%} of its pixels at least: there is nothing to map"
            raise InputError("prism.init", "image", expected)
        small, view = self._shrunk(image)
        past = begin(prior.belief, small, view)
        T = past.T_world_cam
        m = map_update.update(prior.map, image.depth, image.rgb, T, self.rig.camera, config.update)
        # The map is where the first image is, to its share: what follows is known against it, not in the world.
        past = _renewed(_wrote(past, jnp.float32(FIRST_SHARE)))
        m, kept = clock("map", m), None
        if config.recovery is not None:
            settings = config.recovery.keyframe
            none = keyframes.empty(view.camera, settings)
            kept = keyframes.remember(none, T, luminance(small.rgb), view.camera, settings)
        reference = clock(
            "reference",
            reference_view.from_image(m, T, small, view.camera, config.update.max_depth, config.samples > 1),
        )
        start = past.belief.manifold.pose(past.belief.mean)[:3, 3]
        grey = visual_turn.small_grey(image, self.rig.camera)
        views = standing_views.begin(past.belief, grey) if self._turns else None
        return PrismState(m, past, reference, start, kept, grey, views, False, True, key, prior.measurement_noise)

    def step(
        self, state: PrismState, control: Float[Array, "m"], image: RGBD, dt: float, clock: Clock = untimed
    ) -> tuple[PrismState, FilterInfo]:
        """``q_t-1(z) q_t-1(M) -> q_t(z) q_t(M)``. The state passed in is consumed (the map is updated in place).

        The stages are separate compiled calls: in a single one, the compiler would fuse the renderer into each of the
        many places that read its image and compute it again there (it ignores optimization barriers on the CPU).

        Args:
            state: after the last image.
            control: of the transition since then; zeros for a hand's constant velocity.
            image: the new one, at the camera's size.
            dt: seconds since the last one.
            clock: called with name and outcome of each stage, returns the outcome; for timing.

        Returns:
            The new state, and a report: ``status``, ``belief`` in the world (the prediction where the image was not
            accepted) and ``fit_quality``.

        Raises:
            InputError: ``dt`` is not above 0, or a control of another length than the transition's.
        """
        config, control = self.config, checked(self.transition, control)
        small, view = self._shrunk(image)
        key, solving, mapping = jax.random.split(state.key, 3)
        state = eqx.tree_at(lambda s: s.key, state, key)
        reference, relocalisation = state.reference, None
        alone = state.lost and config.recovery is None  # no recovery: the image must fit at the predicted pose
        max_depth = config.update.max_depth
        if alone:
            T_expected = expected_pose(self.transition, state.past.belief, control, seconds(dt), view)
            reference = reference_view.from_map(state.map, T_expected, view.camera, max_depth)
            state = eqx.tree_at(lambda s: s.past, state, _renewed(state.past))
        if config.recovery is not None and state.keyframes is not None:
            relocalisation = Relocalisation(state.map, state.keyframes, max_depth, config.recovery)
        given = TrackingInput(
            state.past, self.transition, control, seconds(dt), reference, small, view, solving, state.lost
        )
        located = localise(given, config.tracking, relocalisation, clock)
        past, status = located.past, located.status
        grey = visual_turn.small_grey(image, self.rig.camera)
        if not status.accepted:
            if state.views is not None:
                errors = past.considered
                belief, told = visual_turn.turned(past.belief, state.past.belief, state.grey, grey, self.rig, errors)
                # From a pose that was not believed, no turn leads to one that is, but for what was seen here before.
                if not (told and state.known):
                    belief, told = standing_views.recognised(belief, state.views, grey, self.rig, errors)
                past = replace(past, belief=belief)
                if told and self._is_known(past):
                    status = Status.TURNED
            known = status.accepted
            if not (alone and state.known and self._is_new(located, past, small)):
                quality, views = None if known else located.fit_quality, state.views
                if known:
                    views = standing_views.remember(views, past.belief, grey)
                changes = (past, grey, views, True, known)
                changed = lambda s: (s.past, s.grey, s.views, s.lost, s.known)
                lost = eqx.tree_at(changed, state, changes, is_leaf=lambda leaf: leaf is None)
                in_world = _in_world(past, state.start, self.transition, config)
                return lost, FilterInfo(status, in_world, quality)
            past, status = _taken(past, small, view), Status.OK
        T, small = past.T_world_cam, past.image
        if config.tracking.exposure:
            image = _expose(image, located.gain)
        m, dropped = rolling_window.followed(state.map, T[:3, 3], config.window_margin)
        before = drift.precision(m, T, small, view.camera)
        m = clock("map", self._mapped(m, image, past, mapping))
        past = _written(past, before, drift.precision(m, T, small, view.camera), small)
        kept, reference = state.keyframes, state.reference
        if kept is not None and config.recovery is not None:
            kept = keyframes.remember(kept, T, luminance(small.rgb), view.camera, config.recovery.keyframe)
        moved_on = reference_view.has_left(reference, T, config.reference_distance, config.reference_angle)
        if alone or status is Status.RECOVERED or moved_on:
            past = _renewed(past)
            reference = clock(
                "reference", reference_view.from_image(m, T, small, view.camera, max_depth, config.samples > 1)
            )
        in_world = _in_world(past, state.start, self.transition, config)
        fit_quality = located.fit_quality if located.status.accepted else None  # nothing was aligned
        info = FilterInfo(status, in_world, fit_quality, dropped)
        views = None if state.views is None else standing_views.remember(state.views, past.belief, grey)
        noise = state.measurement_noise
        return PrismState(m, past, reference, state.start, kept, grey, views, False, True, key, noise), info

    def posterior(self, state: PrismState) -> Posterior:
        """Return ``q_t(z_t) q_t(M)``.

        Args:
            state: after an image.

        Returns:
            The belief over the body in the map's frame, without that frame's drift in the world, and the map; they
            share the state's arrays. With keyframes, the drift is stated as errors of their poses about the last.
        """
        m, kept, past = state.map, state.keyframes, _renewed(state.past)
        if kept is not None:
            reach = self.config.update.max_depth
            errors = PoseErrors.of_ring(kept.T_world_cam, kept.count, past.considered.drift, self.rig.camera, reach)
            m = replace(m, pose_errors=errors)
        return Posterior(past.belief, m, state.measurement_noise)

    @property
    def _turns(self) -> bool:
        """Return True for a body whose commands drive it and turn it about one axis."""
        return bool(self.transition.commanded and np.count_nonzero(self.transition.manifold.turns) == 1)

    def _is_new(self, located: Located, past: Past, image: RGBD) -> bool:
        """Return True where the map knows nothing of what an image shows, and the pose is known."""
        shown, covered = float(jnp.mean(image.hit)), float(located.fit_quality.coverage)
        return shown >= self.config.new_reading and covered <= self.config.new_coverage and self._is_known(past)

    def _is_known(self, past: Past) -> bool:
        """Return True where the pose is known well enough to be believed without an alignment."""
        p = len(past.laplace)
        return float(jnp.max(jnp.diagonal(past.belief.covariance)[:p])) <= self.config.known_std**2

    def _shrunk(self, image: RGBD) -> tuple[RGBD, Rig]:
        """Return the image and its rig at tracking size."""
        return shrunk(image, self.rig, self.config.track_width)

    def _mapped(self, m: VoxelMap, image: RGBD, past: Past, key: Array) -> VoxelMap:
        """Step 5, at the pose's mean or in expectation over its samples."""
        camera, config = self.rig.camera, self.config
        if config.samples == 1:
            return map_update.update(m, image.depth, image.rgb, past.T_world_cam, camera, config.update)
        poses = _draw_poses(past.belief, self.rig, key, config.samples)
        return map_update.update_expected(m, image.depth, image.rgb, poses, camera, config.update)


@jax.jit
def _taken(past: Past, image: RGBD, rig: Rig) -> Past:
    """Return the past after an image that was taken where the belief predicts."""
    return replace(past, image=image, T_world_cam=camera_pose(past.belief, rig))


@partial(jax.jit, static_argnums=3)
def _draw_poses(posterior: GaussianBelief, rig: Rig, key: Array, samples: int) -> Float[Array, "samples 4 4"]:
    """Draw camera poses from ``q(z_pose)`` with the mean among them, so that few samples do not move the map.

    The others lie in pairs on either side of the mean, scaled so that the second moment is the covariance.
    """
    twists = posterior.manifold.twists
    p = twists.shape[1]
    root = jnp.linalg.cholesky(posterior.covariance[:p, :p] + 1e-12 * jnp.eye(p))
    half = (samples / (samples - 1)) ** 0.5 * jax.random.normal(key, (samples // 2, p)) @ root.T
    errors = jnp.concatenate([jnp.zeros((1, p)), half, -half]) @ twists.T
    return posterior.manifold.pose(posterior.mean) @ se3_exp(errors) @ rig.T_body_cam


@jax.jit
def _written(past: Past, before: Array, after: Array, image: RGBD) -> Past:
    """Return the past after its pose's error has entered the map."""
    return _wrote(past, drift.share(before, after, image))


@jax.jit
def _wrote(past: Past, share: Array) -> Past:
    return eqx.tree_at(lambda p: p.considered, past, past.considered.write(past.belief, share))


@jax.jit
def _renewed(past: Past) -> Past:
    """Return the past against a new view of the map."""
    belief, considered = past.considered.renew(past.belief)
    return eqx.tree_at(lambda p: (p.belief, p.considered), past, (belief, considered))


@partial(jax.jit, static_argnums=3)
def _in_world(past: Past, start: Float[Array, "3"], transition: Transition, config: PrismConfig) -> GaussianBelief:
    """Return the belief in the world, with the errors of stamps, calibration and scale."""
    return with_sensor_errors(past.considered.in_world(past.belief), start, transition, config)


def with_sensor_errors(
    belief: GaussianBelief, start: Float[Array, "3"], transition: Transition, config: SensorErrors
) -> GaussianBelief:
    """``Sigma + v v^T + s_c^2 1 + s_d^2 l l^T``: a belief with the errors of stamps, calibration and scale (eq. I24).

    ``v = log(T^-1 T(t + s_t))`` is the motion during the stamp's error, ``l`` the displacement since the first image;
    both in the body frame.

    Args:
        belief: over a state, in the world.
        start: of the body at the first image, m.
        transition: how the body moves.
        config: standard deviations of these errors.
    """
    if not (config.stamp_std or config.calibration_std or config.scale_std):
        return belief
    manifold, mean = belief.manifold, belief.mean
    pose = manifold.pose(mean)
    later = manifold.pose(transition.mean(mean, jnp.zeros(transition.controls), config.stamp_std))
    moved = manifold.twists.T @ se3_log(inverse(pose) @ later)
    p = len(moved)
    away = manifold.twists.T @ jnp.concatenate([pose[:3, :3].T @ (pose[:3, 3] - start), jnp.zeros(3)])
    added = moved[:, None] * moved + config.scale_std**2 * away[:, None] * away + config.calibration_std**2 * jnp.eye(p)
    return eqx.tree_at(lambda q: q.covariance, belief, belief.covariance.at[:p, :p].add(added))


_expose = jax.jit(expose)
