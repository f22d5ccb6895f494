"""Locate one image: track it, relocalise where it is not accepted, or else predict without it; shared by the filters.

Runs on the host between compiled calls, because acceptance decides which of them comes next.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vssm_gym.errors import InputError
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import inverse
from vssm_gym.inference.alignment import reference_view
from vssm_gym.inference.alignment.aliasing import APART, is_unique
from vssm_gym.inference.alignment.depth_scale import fits_unscaled
from vssm_gym.inference.alignment.exposure import expose
from vssm_gym.inference.alignment.residuals import AlignInfo, luminance, shrink_camera, shrink_rgbd
from vssm_gym.inference.alignment.surface_error import SurfaceErrorConfig, influence
from vssm_gym.inference.filter import Clock, Rig
from vssm_gym.inference.status import Status
from vssm_gym.inference.tracking import keyframes, process_noise
from vssm_gym.inference.tracking.camera_filter import (
    Past,
    Tracked,
    TrackingInput,
    at_rest,
    camera_pose,
    camera_twists,
    track,
)
from vssm_gym.inference.tracking.config import TrackingConfig
from vssm_gym.inference.tracking.error_covariance import Considered, estranged
from vssm_gym.inference.tracking.keyframes import Keyframes
from vssm_gym.inference.tracking.pose_update import gain, propagated
from vssm_gym.inference.tracking.recovery import Attempt, RecoveryConfig, prior_precision, recover
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import GaussianBelief
from vssm_gym.model.transition.manifold import Manifold


@dataclass(frozen=True)
class Relocalisation:
    """Hold what relocalisation compares an image with."""

    map: VoxelMap
    keyframes: Keyframes
    max_depth: float  # m, of the rendering
    config: RecoveryConfig


@dataclass(frozen=True)
class Located:
    """Hold the outcome for one image."""

    status: Status
    past: Past  # what the next image is filtered with
    gain: Float[Array, ""]  # of the image: see :mod:`exposure`
    fit_quality: AlignInfo


def localise(
    given: TrackingInput, config: TrackingConfig, relocalisation: Relocalisation | None, clock: Clock
) -> Located:
    """Locate an image: by tracking, by recovery where that fails, else by prediction.

    Args:
        given: The image and everything that it is filtered with.
        config: Solver, effort and gates.
        relocalisation: Map and keyframes for recovery; None: no recovery.
        clock: Of the stages "track" and "recover".
    """
    tracked = clock("track", track(given, config))
    past, transition, image, rig, lost = given.past, given.transition, given.image, given.rig, bool(given.lost)
    if tracked.accepted and (tracked.expected or _confirmed(tracked, given, config)):
        if config.exposure:
            image = _expose(image, tracked.gain)
        now = Past(
            tracked.belief,
            tracked.laplace,
            tracked.considered,
            tracked.correlation,
            tracked.noise_scale,
            tracked.obstructed,
            image,
            tracked.T_world_cam,
        )
        return Located(Status.OK, now, tracked.gain, tracked.fit_quality)
    has_depth = readable(image, config)
    repeated = has_depth and bool(tracked.repeated)
    if has_depth and not repeated and relocalisation is not None:
        starts = _starts(past, tracked, image, rig, lost, relocalisation)
        found = search(starts, transition.manifold, image, rig, config, relocalisation, tracked.carried)
        if found is not None:
            clock("recover", found.past.belief)
            return found
    if repeated:  # the camera goes on unseen, at its velocity
        belief = tracked.predicted
    else:
        belief = clock("recover", _without_image(past, tracked.predicted, transition, rig, config, lost))
    status = Status.REPEATED if repeated else Status.LOST if has_depth else Status.NO_READING
    considered = tracked.carried if repeated or transition.commanded else estranged(tracked.carried)
    none = jnp.zeros_like(tracked.laplace)
    now = Past(
        belief,
        none,
        considered,
        past.correlation,
        process_noise.full(),
        tracked.obstructed,
        past.image,
        past.T_world_cam,
    )
    return Located(status, now, tracked.gain, tracked.fit_quality)


def readable(image: RGBD, config: TrackingConfig) -> bool:
    """Return True if the image has enough depth readings to be aligned, or to start a map."""
    return float(jnp.mean(image.hit)) >= config.min_reading


def tracking_factor(camera: Camera, track_width: int | None) -> int:
    """Return the factor that shrinks images of ``camera`` to about ``track_width`` pixels; 1 for None."""
    return 1 if track_width is None else max(1, round(camera.width / track_width))


def shrunk(image: RGBD, rig: Rig, track_width: int | None) -> tuple[RGBD, Rig]:
    """Return an image and its rig at tracking size."""
    factor = tracking_factor(rig.camera, track_width)
    if factor == 1:
        return image, rig
    return _shrink(image, factor), Rig(shrink_camera(rig.camera, factor), rig.T_body_cam)


def seconds(dt: float) -> Float[Array, ""]:
    """Convert the length of a step, s, to the float32 scalar that the compiled functions take.

    Raises:
        InputError: ``dt`` is not above 0.
    """
    if not 0.0 < dt < float("inf"):
        raise InputError("filter.step", "dt", f"seconds since the last image, above 0; found {dt!r}")
    return jnp.float32(dt)


def search(
    T_world_starts: Float[Array, "starts 4 4"],
    manifold: Manifold,
    image: RGBD,
    rig: Rig,
    config: TrackingConfig,
    relocalisation: Relocalisation,
    considered: Considered,
) -> Located | None:
    """Relocalise an image in the map, at an unknown velocity; None where no start leads to an accepted pose (eq. I32).

    Args:
        T_world_starts: Camera poses to start from.
        manifold: Of the state.
        image: At tracking size.
        rig: The camera, at that size, and its place on the body.
        config: Of tracking.
        relocalisation: Map and keyframes that the image is compared with.
        considered: Before the image; the drift of the map stays.
    """
    basis = camera_twists(manifold, rig)
    attempt = recover(
        relocalisation.map, T_world_starts, image, rig.camera, basis, relocalisation.max_depth, relocalisation.config
    )
    return begin_at(attempt, manifold, image, rig, config, relocalisation, considered) if attempt.accepted else None


def begin_at(
    attempt: Attempt,
    manifold: Manifold,
    image: RGBD,
    rig: Rig,
    config: TrackingConfig,
    relocalisation: Relocalisation,
    considered: Considered,
) -> Located:
    """Return the past of a camera that was relocalised, at an unknown velocity; arguments as of :func:`search`."""
    basis = camera_twists(manifold, rig)
    if config.exposure:
        image = _expose(image, attempt.gain)
    at_pose = reference_view.from_map(relocalisation.map, attempt.T_world_cam, rig.camera, relocalisation.max_depth)
    T_world_body, settings = attempt.T_world_cam @ inverse(rig.T_body_cam), relocalisation.config
    around = jnp.linalg.inv(prior_precision(basis, settings))
    start = at_rest(manifold, T_world_body, around, config.start_velocity)
    errors = influence(
        jnp.eye(4), basis, at_pose, image, rig.camera, settings.align, config.surface_error or SurfaceErrorConfig()
    )
    made = gain(around, jnp.ones(()), errors.curvature)
    both, related = propagated(estranged(considered), start, jnp.zeros(basis.shape[1]), made, errors)
    now = Past(
        belief=replace(start, covariance=both.covariance),
        laplace=made.K,
        considered=related,
        correlation=jnp.ones(()),
        noise_scale=process_noise.full(),
        obstructed=jnp.zeros((), bool),
        image=image,
        T_world_cam=attempt.T_world_cam,
    )
    return Located(Status.RECOVERED, now, attempt.gain, attempt.fit_quality)


def checked(transition: Transition, control: Float[Array, "m"]) -> Float[Array, "m"]:
    """Return the control, checked against the transition.

    Raises:
        InputError: its length differs from that of the transition's controls.
    """
    if np.shape(control) != (transition.controls,):
        expected = f"the {transition.controls} numbers of {type(transition).__name__}'s controls"
        raise InputError("filter.step", "control", f"{expected}; found shape {np.shape(control)}")
    return control


def _confirmed(tracked: Tracked, given: TrackingInput, config: TrackingConfig) -> bool:
    """Return whether an image that was not expected fits at one scale of its depth and, after a jump, at one place.

    The places that a smaller step could be taken for are further from the prediction than the step itself.
    """
    reference, image = given.reference, _expose(given.image, tracked.gain)
    T = inverse(reference.T_world_cam) @ tracked.T_world_cam
    basis, camera = camera_twists(given.transition.manifold, given.rig), given.rig.camera
    if not fits_unscaled(T, basis, reference.image, image, camera, config.align, reference.seen):
        return False
    step = tracked.T_world_cam[:3, 3] - camera_pose(tracked.predicted, given.rig)[:3, 3]
    if float(jnp.linalg.norm(step)) < APART:
        return True
    return bool(is_unique(T, basis, reference.image, image, camera, config.align))


def _starts(
    past: Past, tracked: Tracked, image: RGBD, rig: Rig, lost: bool, relocalisation: Relocalisation
) -> Float[Array, "starts 4 4"]:
    """Return start poses for recovery: last pose (turned, and as it was), most similar keyframes, prediction."""
    settings, grey = relocalisation.config, luminance(image.rgb)
    alike = keyframes.similar(
        relocalisation.keyframes, grey, rig.camera, settings.rotation, settings.keyframes + 1, settings.keyframe
    )
    # The prediction of a camera that was lost before is its last pose: that start would be tried twice.
    last = alike[-1] if lost else camera_pose(tracked.predicted, rig)
    return jnp.stack([tracked.T_world_turned, past.T_world_cam, *alike[:-1], last])


def _without_image(
    past: Past, predicted: GaussianBelief, transition: Transition, rig: Rig, config: TrackingConfig, lost: bool
) -> GaussianBelief:
    """Return the belief without an image. A commanded body follows its commands.

    Any other body is believed to leave its last pose at an unknown velocity; its uncertainty grows with time, however
    many images are taken meanwhile.
    """
    if transition.commanded:
        return predicted
    p, T_world_body = len(past.laplace), past.T_world_cam @ inverse(rig.T_body_cam)
    stays = at_rest(predicted.manifold, T_world_body, predicted.covariance[:p, :p], config.start_velocity)
    return replace(stays, covariance=predicted.covariance) if lost else stays


_expose = jax.jit(expose)
_shrink = jax.jit(shrink_rgbd, static_argnums=1)
