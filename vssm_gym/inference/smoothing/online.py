"""Smooth on-line, from nothing: time steps are unlocked one after the other, and the newest ones move together.

No map is needed to find a pose. A new image is aligned to the last one; then the states of the newest steps are found
together, with all their images and with earlier ones that see the same surfaces
(:mod:`~vssm_gym.inference.smoothing.window`). Earlier steps stay: drift is corrected where places are seen again, and
in the whole trajectory by smoothing all steps at the end. An image enters the map when its step leaves the window.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import inverse, se3_log
from vssm_gym.inference.alignment import gauss_newton, reference_view
from vssm_gym.inference.alignment.reference_view import ReferenceView
from vssm_gym.inference.alignment.residuals import AlignInfo
from vssm_gym.inference.filter import Clock, FilterInfo, Rig, untimed
from vssm_gym.inference.mapping import map_update, rolling_window
from vssm_gym.inference.mapping.map_update import MapUpdateConfig
from vssm_gym.inference.prism.config import PrismConfig
from vssm_gym.inference.prism.filter import with_sensor_errors
from vssm_gym.inference.smoothing.gauss_newton import SmoothingConfig
from vssm_gym.inference.smoothing.online_state import (
    OF_POSE,
    Earlier,
    Frame,
    OnlineState,
    Placed,
    apart,
    carried,
    frame_of,
    in_world,
    newest_belief,
    seen_from_itself,
)
from vssm_gym.inference.smoothing.window import Step, smooth_window, view_of, without_image
from vssm_gym.inference.status import Status
from vssm_gym.inference.tracking import start_poses
from vssm_gym.inference.tracking.camera_filter import begin, camera_pose, camera_twists
from vssm_gym.inference.tracking.config import TrackingConfig
from vssm_gym.inference.tracking.localise import checked, readable, seconds, shrunk
from vssm_gym.model.emission import RGBD
from vssm_gym.model.posterior import Posterior
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import GaussianBelief
from vssm_gym.model.transition.manifold import RIGID, RigidState

WINDOW_GATES = (0.1, 0.05, 0.05)  # m, of the iterations
HELD_STD = 1e-3  # m, rad: std of the first pose of the window, which the step before has left to it


@dataclass(frozen=True)
class OnlineConfig:
    """Configure the window and its effort.

    Args:
        smoothing: of the window; an iteration for each gate.
        tracking: of the alignment to the last image.
        update: of the map.
        free: newest steps, whose states move.
        held: earlier images at most, which stay and are compared with the newest.
        spacing: m between the views of earlier images that are kept; half a radian counts as much as a metre.
        least_shared: of the drawn elements, that an image must see to be accepted.
        most_kept: earlier images; beyond it every second one is forgotten.
        track_width: pixels to which images are shrunk, about.
        window_margin: share of the map's edge, as of PRISM.
        stamp_std: s, of the errors of time stamps, as of PRISM; so are the other two.
        calibration_std: m and rad, of the pose by intrinsics and mounting.
        scale_std: of the depth's scale.
    """

    smoothing: SmoothingConfig = field(default_factory=lambda: SmoothingConfig(elements=3000, gates=WINDOW_GATES))
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    update: MapUpdateConfig = field(default_factory=MapUpdateConfig)
    free: int = 8
    held: int = 8
    spacing: float = 0.35
    least_shared: float = 0.1
    most_kept: int = 600
    track_width: int | None = 160
    window_margin: float | None = PrismConfig.window_margin
    stamp_std: float = PrismConfig.stamp_std
    calibration_std: float = PrismConfig.calibration_std
    scale_std: float = PrismConfig.scale_std

    def __post_init__(self) -> None:
        if self.free < 2:
            raise InputError("OnlineConfig", "free", f"two steps or more, not {self.free}")


@dataclass(frozen=True)
class OnlineSmoother:
    """Smooth the newest steps together (:class:`~vssm_gym.inference.filter.Filter`), from nothing (eq. I60).

    Attributes:
        rig: the camera and its pose on the body.
        transition: how the body moves.
        config: window and effort.
    """

    rig: Rig
    transition: Transition
    config: OnlineConfig = OnlineConfig()

    def __post_init__(self) -> None:
        if self.transition.manifold is not RIGID:
            found = type(self.transition).__name__
            raise InputError("OnlineSmoother", "transition", f"one of a rigid body in space; found {found}")

    def init(self, prior: Posterior, image: RGBD, key: PRNGKeyArray) -> OnlineState:
        """Return the state after the first image, taken where the prior has the body; the map is consumed.

        Raises:
            InputError: no map in the prior, no Gaussian belief, or an image without depth.
        """
        if prior.map is None:
            raise InputError("smoother.init", "prior", "a map: an empty one to begin with")
        if not readable(image, self.config.tracking):
            expected = f"depth at {self.config.tracking.min_reading:.0%} of its pixels at least"
            raise InputError("smoother.init", "image", expected)
        small, rig = shrunk(image, self.rig, self.config.track_width)
        belief = begin(prior.belief, small, rig).belief
        view = view_of(small, rig.camera, self.config.smoothing.align)
        step = Step(belief.mean, view, jnp.zeros(self.transition.controls), 0.0)
        first = Placed(step, image, np.asarray(belief.covariance, np.float64))
        last, known = reference_view.of_image(camera_pose(belief, rig), small), seen_from_itself(first)
        world = Frame(np.eye(4), np.zeros((OF_POSE, OF_POSE)))
        noise, start = prior.measurement_noise, RIGID.pose(belief.mean)[:3, 3]
        return OnlineState(
            prior.map, (first,), belief, world, frame_of(first), (), known, last, start, False, key, noise
        )

    def step(
        self, state: OnlineState, control: Float[Array, "m"], image: RGBD, dt: float, clock: Clock = untimed
    ) -> tuple[OnlineState, FilterInfo]:
        """Unlock one more time step: align its image to the last one, then smooth the window.

        Args:
            state: after the last image; its map is consumed.
            control: of the transition since then; zeros for a hand's constant velocity.
            image: the new one, at the camera's size.
            dt: seconds since the last one.
            clock: called with name and outcome of each stage, returns the outcome; for timing.

        Raises:
            InputError: ``dt`` is not above 0, or a control of another length than the transition's.
        """
        h, control, config = seconds(dt), checked(self.transition, control), self.config
        small, rig = shrunk(image, self.rig, config.track_width)
        key, drawing = jax.random.split(state.key)
        state, dropped = self._moved_on(replace(state, key=key), clock)
        aligned = clock(
            "track", _aligned(state.belief, self.transition, control, h, state.last, small, rig, config.tracking)
        )
        predicted, quality = aligned.predicted, aligned.quality
        # Relative to the last accepted pose, whose own error comes on top
        covariance = in_world(predicted.mean, np.asarray(predicted.covariance), state.accepted)
        step = Step(predicted.mean, without_image(rig.camera), control, dt)
        unseen = replace(state, window=(*state.window, Placed(step, None, covariance)), belief=predicted, lost=True)
        status = Status.LOST if readable(small, config.tracking) else Status.NO_READING
        view = view_of(small, rig.camera, config.smoothing.align)
        fits = float(quality.inlier_share) >= config.tracking.min_score
        if status is Status.NO_READING or not fits or not len(view.pixels):
            return unseen, FilterInfo(status, self._in_report(unseen), quality, dropped)
        newest = Placed(step._replace(state=aligned.mean, view=view), image, covariance)
        seen, share = clock("smooth", self._smoothed(replace(state, window=(*state.window, newest)), rig, drawing))
        if share < config.least_shared:
            return unseen, FilterInfo(status, self._in_report(unseen), quality, dropped)
        newest = seen.window[-1]
        known = seen_from_itself(newest)
        last = reference_view.of_image(camera_pose(known, rig), small)
        state = replace(seen, belief=known, accepted=frame_of(newest), last=last, lost=False)
        return state, FilterInfo(Status.OK, self._in_report(state), quality, dropped)

    def posterior(self, state: OnlineState) -> Posterior:
        """Return ``q(z_t)``, and ``q(M)`` of the images whose steps have left the window.

        Args:
            state: after an image.
        """
        return Posterior(newest_belief(state), state.map, state.measurement_noise)

    def _in_report(self, state: OnlineState) -> GaussianBelief:
        """Return the belief over the newest state with the errors that all images share."""
        return _reported(newest_belief(state), state.start, self.transition, self.config)

    def _moved_on(self, state: OnlineState, clock: Clock) -> tuple[OnlineState, int]:
        """Make room for one more step: the oldest enters the map, and stays as an earlier image where it is new.

        Returns:
            The state, and how many blocks of the map its window lost.
        """
        if len(state.window) < self.config.free:
            return state, 0
        (oldest, second, *_), config, dropped = state.window, self.config, 0
        m, T = state.map, camera_pose(seen_from_itself(oldest), self.rig)
        if oldest.image is not None:
            m, dropped = rolling_window.followed(m, T[:3, 3], config.window_margin)
            updated = map_update.update(m, oldest.image.depth, oldest.image.rgb, T, self.rig.camera, config.update)
            m = clock("map", updated)
        earlier, now = state.earlier, Earlier(oldest.step.view, np.asarray(T, np.float64), frame_of(oldest))
        if len(now.view.pixels) and (not earlier or apart(now, earlier[-1].T_world_cam) > config.spacing):
            earlier = (*earlier, now) if len(earlier) < config.most_kept else (*earlier[::2], now)
        before, frame = seen_from_itself(second), frame_of(second)
        if second.image is not None:
            held = before.covariance.at[:OF_POSE, :OF_POSE].set(HELD_STD**2 * jnp.eye(OF_POSE))
        else:  # nothing has shown where it is
            held, frame = jnp.asarray(second.covariance, jnp.float32), Frame(np.eye(4), np.zeros((OF_POSE, OF_POSE)))
        before = replace(before, covariance=held)
        return replace(state, map=m, window=state.window[1:], before=before, frame=frame, earlier=earlier), dropped

    def _smoothed(self, state: OnlineState, rig: Rig, key: PRNGKeyArray) -> tuple[OnlineState, float]:
        """Return the state with the window smoothed, and the share of the drawn elements that its newest image sees."""
        config = self.config
        T = np.asarray(camera_pose(seen_from_itself(state.window[-1]), rig), np.float64)
        near = sorted(state.earlier, key=lambda one: apart(one, T))[: config.held]
        found = smooth_window(
            np.random.default_rng(np.asarray(jax.random.key_data(key))),
            [placed.step for placed in state.window],
            config.free,
            [(one.view, one.T_world_cam) for one in near],
            config.held,
            rig,
            self.transition,
            state.before,
            config.smoothing,
        )
        # The window errs as the frame that it began in, or as an earlier image that holds it, if that errs less.
        holding = [one.frame for one, share in zip(near, found.held_shares, strict=True) if share > config.least_shared]
        frame = min([state.frame, *holding], key=lambda frame: np.trace(carried(found.states[-1], frame)))
        window = tuple(
            placed._replace(step=placed.step._replace(state=mean), covariance=in_world(mean, covariance, frame))
            for placed, mean, covariance in zip(state.window, found.states, found.covariance, strict=True)
        )
        return replace(state, window=window), found.shared


class _Aligned(NamedTuple):
    """Hold an image that was aligned to the last accepted one."""

    mean: RigidState  # of the state
    predicted: GaussianBelief  # before the image was seen
    quality: AlignInfo


@partial(jax.jit, static_argnums=7)
def _aligned(
    belief: GaussianBelief,
    transition: Transition,
    control: Array,
    dt: Array,
    last: ReferenceView,
    image: RGBD,
    rig: Rig,
    config: TrackingConfig,
) -> _Aligned:
    """Align an image to the last accepted one; the rest of the state follows the pose as predicted."""
    predicted = transition.predict(belief, control, dt)
    basis = camera_twists(RIGID, rig)
    T_prior = inverse(last.T_world_cam) @ camera_pose(predicted, rig)
    begun = start_poses.first(T_prior, last, last.T_world_cam, last.image, image, rig.camera, config)
    precision = jnp.linalg.inv(predicted.covariance[:OF_POSE, :OF_POSE])
    T, quality = gauss_newton.align(
        T_prior, precision, begun.poses[0], basis, last.image, begun.image, rig.camera, config.align
    )
    moved = jnp.linalg.pinv(basis) @ se3_log(inverse(T_prior) @ T)
    mean = RIGID.perturb(predicted.mean, predicted.covariance[:, :OF_POSE] @ precision @ moved)
    return _Aligned(mean, predicted, quality)


_reported = jax.jit(with_sensor_errors, static_argnums=3)
