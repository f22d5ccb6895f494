"""Filter the state alone: in a fixed map, against the previous image, or from the commands (TNP-SM).

Each step predicts the state from the control, takes a reference view, and aligns the camera image to it.
:class:`MapTracker` renders the reference from the map at the predicted pose. :class:`FrameTracker` takes the previous
camera image (the published "no map" baseline, whose errors add up). :class:`DeadReckoning` uses no image. Loss of
track is detected and reported; the belief then follows the transition until images are accepted again.
"""

from dataclasses import dataclass, replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.errors import InputError
from vssm_gym.inference.alignment import reference_view
from vssm_gym.inference.alignment.residuals import AlignConfig, luminance
from vssm_gym.inference.filter import Clock, FilterInfo, Rig, untimed
from vssm_gym.inference.status import Status
from vssm_gym.inference.tracking import keyframes
from vssm_gym.inference.tracking.camera_filter import (
    Past,
    Tracked,
    TrackingInput,
    begin,
    camera_pose,
    expected_pose,
    track,
)
from vssm_gym.inference.tracking.config import COMMANDED, TrackingConfig
from vssm_gym.inference.tracking.error_covariance import nothing
from vssm_gym.inference.tracking.keyframes import Keyframes
from vssm_gym.inference.tracking.localise import Relocalisation, checked, localise, readable, search, seconds, shrunk
from vssm_gym.inference.tracking.recovery import RecoveryConfig
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import MAX_DEPTH, RGBD
from vssm_gym.model.map_samples import MeasurementNoise
from vssm_gym.model.posterior import Posterior
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import GaussianBelief

# The scale of the geometry matches the roughness of a map with cells of 5 cm.
ROBOT_TRACKING = replace(COMMANDED, align=AlignConfig(geo_sigma=0.012))


class TrackerState(eqx.Module):
    """Hold a tracker's state between steps."""

    past: Past
    map: VoxelMap | None  # fixed; None: the reference is the previous image
    keyframes: Keyframes | None  # None: no recovery
    lost: bool  # the last image was not accepted
    key: PRNGKeyArray  # of a solver that draws; the same at every step
    measurement_noise: MeasurementNoise  # of the posterior

    @property
    def belief(self) -> GaussianBelief:
        """Return ``q(z_t)``."""
        return self.past.belief


@dataclass(frozen=True)
class MapTracker:
    """``argmax_z log p(x_t | z, M) + log p(z | z_t-1, u_t-1)`` in a fixed map, the reference rendered at every step.

    Attributes:
        rig: the camera and its pose on the body.
        transition: how the body moves.
        config: effort and gates; the default is that of a robot whose commands are known.
        recovery: of a lost camera; None: retry at the predicted pose only.
        max_depth: z-depth up to which the map is rendered, m.
        track_width: pixels to about which images are shrunk; None: not.
    """

    rig: Rig
    transition: Transition
    config: TrackingConfig = ROBOT_TRACKING
    recovery: RecoveryConfig | None = None
    max_depth: float = MAX_DEPTH
    track_width: int | None = None

    def init(self, prior: Posterior, image: RGBD, key: PRNGKeyArray) -> TrackerState:
        """Return the state after the first image, taken about where the prior's belief has the body.

        Args:
            prior: belief over the body in the map's frame, and the map, which is shared and not consumed.
            image: the first one, at the camera's size.
            key: random key, of a solver that draws.

        Returns:
            The state for :meth:`step`; with recovery, the first image is aligned to the map.

        Raises:
            InputError: a prior without a map.
        """
        if prior.map is None:
            raise InputError("MapTracker.init", "prior", "a learned map to track in")
        image, rig = shrunk(image, self.rig, self.track_width)
        past, kept, lost = begin(prior.belief, image, rig), None, False
        if self.recovery is not None:
            # The start may be known only roughly: align the first image to the map around it.
            kept, camera = keyframes.empty(rig.camera, self.recovery.keyframe), rig.camera
            relocalisation = Relocalisation(prior.map, kept, self.max_depth, self.recovery)
            starts = past.T_world_cam[None]
            found = search(starts, self.transition.manifold, image, rig, self.config, relocalisation, past.considered)
            lost = found is None
            if found is not None:
                past = found.past
                kept = keyframes.remember(kept, past.T_world_cam, luminance(image.rgb), camera, self.recovery.keyframe)
        return TrackerState(past, prior.map, kept, lost, key, prior.measurement_noise)

    def step(
        self, state: TrackerState, control: Float[Array, "m"], image: RGBD, dt: float, clock: Clock = untimed
    ) -> tuple[TrackerState, FilterInfo]:
        """Align the image to one rendered from the map at the predicted pose (eq. I34).

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
        # The rendering is a separate compiled call: with the alignment in one call, the compiler would fuse the
        # renderer into each of the many places that read its image and compute it again there.
        assert state.map is not None
        h, control, kept = seconds(dt), checked(self.transition, control), state.keyframes
        image, rig = shrunk(image, self.rig, self.track_width)
        camera = rig.camera
        T_expected = expected_pose(self.transition, state.past.belief, control, h, rig)
        reference = reference_view.from_map(state.map, T_expected, camera, self.max_depth)
        relocalisation = None
        if kept is not None and self.recovery is not None:
            relocalisation = Relocalisation(state.map, kept, self.max_depth, self.recovery)
        given = TrackingInput(state.past, self.transition, control, h, reference, image, rig, state.key, state.lost)
        located = localise(given, self.config, relocalisation, clock)
        past, status = located.past, located.status
        if relocalisation is not None and status.accepted:
            settings = relocalisation.config.keyframe
            kept = keyframes.remember(
                relocalisation.keyframes, past.T_world_cam, luminance(image.rgb), camera, settings
            )
        return TrackerState(past, state.map, kept, not status.accepted, state.key, state.measurement_noise), FilterInfo(
            status, past.belief, located.fit_quality
        )

    def posterior(self, state: TrackerState) -> Posterior:
        """Return ``q(z_t)`` with the fixed map.

        Args:
            state: after an image.

        Returns:
            The belief over the body in the map's frame, and the map as it was given.
        """
        return Posterior(state.past.belief, state.map, state.measurement_noise)


@dataclass(frozen=True)
class FrameTracker:
    """Track as :class:`MapTracker`, but against the previous camera image at its estimated pose (TNP-SM, "no map").

    For transitions whose state is a pose. An image determines only the motion since the previous one: earlier
    uncertainty remains, and covariances add up.
    """

    rig: Rig
    transition: Transition
    config: TrackingConfig = ROBOT_TRACKING

    def __post_init__(self) -> None:
        manifold = self.transition.manifold
        if manifold.twists.shape[1] != len(manifold.turns):
            raise InputError("FrameTracker", "transition", "one whose state is a pose: planar, bicycle, differential")

    def init(self, prior: Posterior, image: RGBD, key: PRNGKeyArray) -> TrackerState:
        """Return the prior's belief with its first image; a map is not used."""
        return TrackerState(begin(prior.belief, image, self.rig), None, None, False, key, prior.measurement_noise)

    def step(
        self, state: TrackerState, control: Float[Array, "m"], image: RGBD, dt: float, clock: Clock = untimed
    ) -> tuple[TrackerState, FilterInfo]:
        """Align the image to the one before (eq. I35); see :class:`Filter`."""
        h, control = seconds(dt), checked(self.transition, control)
        tracked, belief = clock(
            "track",
            _track_from_frame(state.past, self.transition, control, h, image, self.rig, state.key, self.config),
        )
        accepted = bool(tracked.accepted)
        both = readable(image, self.config) and bool(jnp.any(image.hit)) and bool(jnp.any(state.past.image.hit))
        status = Status.OK if accepted else Status.LOST if both else Status.NO_READING
        T_world_cam = tracked.T_world_cam if accepted else camera_pose(belief, self.rig)
        past = replace(
            state.past,
            belief=belief,
            correlation=tracked.correlation if accepted else state.past.correlation,
            obstructed=tracked.obstructed,
            image=image,
            T_world_cam=T_world_cam,
        )
        info = FilterInfo(status, belief, tracked.fit_quality)
        return TrackerState(past, None, None, not accepted, state.key, state.measurement_noise), info

    def posterior(self, state: TrackerState) -> Posterior:
        """Return ``q(z_t)``; there is no map."""
        return Posterior(state.past.belief, None)


@dataclass(frozen=True)
class DeadReckoning:
    """``q(z_t) = int p(z_t | z_t-1, u_t-1) q(z_t-1)``: the controls alone, never corrected."""

    transition: Transition

    def init(self, prior: Posterior, image: RGBD | None, key: PRNGKeyArray) -> GaussianBelief:
        """Return the prior's belief; neither image nor map is used.

        Raises:
            InputError: a prior that is no Gaussian.
        """
        if not isinstance(prior.belief, GaussianBelief):
            raise InputError("filter.init", "prior", "a GaussianBelief over the state")
        return prior.belief

    def step(
        self, state: GaussianBelief, control: Float[Array, "m"], image: RGBD | None, dt: float, clock: Clock = untimed
    ) -> tuple[GaussianBelief, FilterInfo]:
        """Predict without an image (eq. I36); see :class:`Filter`."""
        belief = clock("track", _predicted(self.transition, state, checked(self.transition, control), seconds(dt)))
        return belief, FilterInfo(Status.OK, belief)

    def posterior(self, state: GaussianBelief) -> Posterior:
        """Return ``q(z_t)``; there is no map."""
        return Posterior(state, None)


@partial(jax.jit, static_argnums=7)
def _track_from_frame(
    past: Past,
    transition: Transition,
    control: Array,
    dt: Array,
    image: RGBD,
    rig: Rig,
    key: Array,
    config: TrackingConfig,
) -> tuple[Tracked, GaussianBelief]:
    """Track as if the pose before were known; return the belief, without an accepted image the prediction, of both."""
    belief = past.belief
    known = replace(
        past,
        belief=replace(belief, covariance=jnp.zeros_like(belief.covariance)),
        considered=nothing(len(belief.covariance)),
    )
    reference = reference_view.of_image(belief.manifold.pose(belief.mean) @ rig.T_body_cam, past.image)
    tracked = track(TrackingInput(known, transition, control, dt, reference, image, rig, key, False), config)
    kept = jax.tree.map(partial(jnp.where, tracked.accepted), tracked.belief, tracked.predicted)
    carried = transition.predict(belief, control, dt, 0.0).covariance
    return tracked, replace(kept, covariance=carried + kept.covariance)


_predicted = jax.jit(lambda transition, belief, control, dt: transition.predict(belief, control, dt))
