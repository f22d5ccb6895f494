"""``argmax_z log p(x_t | z, M) + log p(z | z_t-1, u_t-1)`` by Adam through the renderer (TNP-SM, emission-based).

This tracker is a baseline. :mod:`vssm_gym.inference.tracking.map_tracker` aligns an image to one rendered reference;
this one renders the sampled pixels again at every step and follows the gradient of ``log p`` in the pose, which comes
from the interpolation at the hit alone. Each step searches along 200 rays; the ray itself is the association.
"""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import inverse, se3_exp, se3_log
from vssm_gym.inference.alignment.adam import AdamConfig, minimise
from vssm_gym.inference.alignment.residuals import AlignInfo, fit_quality, make_observed, make_reference, score, stride
from vssm_gym.inference.filter import Clock, FilterInfo, Rig, untimed
from vssm_gym.inference.status import Status
from vssm_gym.inference.tracking.camera_filter import begin, camera_twists
from vssm_gym.inference.tracking.config import TrackingConfig
from vssm_gym.inference.tracking.localise import checked, seconds
from vssm_gym.inference.tracking.map_tracker import ROBOT_TRACKING, TrackerState
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model import emission
from vssm_gym.model.emission import RGBD
from vssm_gym.model.emission_density import EmissionScales, log_prob
from vssm_gym.model.posterior import Posterior
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import GaussianBelief

TRACKER_SCALES = EmissionScales(depth=0.02, growth=0.0, rgb=0.14, textured=0.0)  # m, a channel: as the aligners
TRACKER_ADAM = AdamConfig(steps=100, translation_step=0.003, rotation_step=0.003)  # 100 steps: TNP-SM; sizes: ours


@dataclass(frozen=True)
class EmissionTrackerConfig:
    """Configure search, emission, and the test for loss of track, which is that of the other trackers."""

    adam: AdamConfig = TRACKER_ADAM  # pixels and step sizes; outliers have their share of the density, and no gate
    scales: EmissionScales = TRACKER_SCALES
    max_depth: float = emission.MAX_DEPTH
    tracker: TrackingConfig = ROBOT_TRACKING


@dataclass(frozen=True)
class EmissionTracker:
    """Track in a map with transitions whose state is a pose."""

    rig: Rig
    transition: Transition
    config: EmissionTrackerConfig = EmissionTrackerConfig()

    def init(self, prior: Posterior, image: RGBD, key: PRNGKeyArray) -> TrackerState:
        """Return the prior's belief; its map is shared, not consumed.

        Raises:
            InputError: a prior without a map, or a transition whose state is more than a pose.
        """
        manifold = self.transition.manifold
        if prior.map is None:
            raise InputError("EmissionTracker.init", "prior", "a learned map to track in")
        if manifold.twists.shape[1] != len(manifold.turns):
            raise InputError(
                "EmissionTracker", "transition", "one whose state is a pose: planar, bicycle, differential"
            )
        return TrackerState(begin(prior.belief, image, self.rig), prior.map, None, False, key, prior.measurement_noise)

    def step(
        self, state: TrackerState, control: Float[Array, "m"], image: RGBD, dt: float, clock: Clock = untimed
    ) -> tuple[TrackerState, FilterInfo]:
        """Follow the gradient through the renderer (eq. I37); see :class:`Filter`."""
        assert state.map is not None
        control, h = checked(self.transition, control), seconds(dt)
        predicted = _predict(self.transition, state.past.belief, control, h)
        T_world_cam = _descend(predicted, image, state.map, self.rig, state.key, self.config)
        rendered = emission.render(state.map, T_world_cam, self.rig.camera)
        belief, accepted, fit_quality = clock(
            "track", _evaluate(predicted, rendered, T_world_cam, image, self.rig, self.config)
        )
        past = replace(state.past, belief=belief, image=image, T_world_cam=T_world_cam)
        status = Status.OK if accepted else Status.LOST
        return replace(state, past=past, lost=not accepted), FilterInfo(status, belief, fit_quality)

    def posterior(self, state: TrackerState) -> Posterior:
        """Return ``q(z_t)`` with the fixed map."""
        return Posterior(state.past.belief, state.map, state.measurement_noise)


@partial(jax.jit, static_argnums=5)
def _descend(
    predicted: GaussianBelief, image: RGBD, m: VoxelMap, rig: Rig, key: Array, config: EmissionTrackerConfig
) -> Float[Array, "4 4"]:
    """Find T_world_cam by MAP, ``T_world_pred exp(B xi)``; pixels are sampled and rendered again at every step."""
    camera, basis = rig.camera, camera_twists(predicted.manifold, rig)
    T_world_pred = predicted.manifold.pose(predicted.mean) @ rig.T_body_cam
    precision = jnp.linalg.inv(predicted.covariance)
    width = camera.width
    depth, rgb = image.depth.reshape(-1), image.rgb.reshape(-1, 3)
    (usable,) = jnp.nonzero(image.hit.reshape(-1), size=depth.shape[0], fill_value=0)
    count = jnp.sum(image.hit)
    draws = jax.random.randint(key, (config.adam.steps, config.adam.pixels), 0, jnp.maximum(count, 1))

    def rays(T, pixel):
        x, y = (pixel % width - camera.cx) / camera.fx, (pixel // width - camera.cy) / camera.fy
        return T[:3, 3], jnp.stack([T[a, 0] * x + T[a, 1] * y + T[a, 2] for a in range(3)], axis=-1)

    def loss(xi, i):
        pixel = usable.at[draws[i]].get(mode="promise_in_bounds")
        T = T_world_pred @ se3_exp(basis @ xi)
        centre, directions = rays(T, pixel)
        k, hit = emission.search(*jax.lax.stop_gradient((m, centre, directions)), config.max_depth)
        d = emission.intersect(m, centre, directions, jnp.where(hit, k, 2))
        surface = centre + directions * d[:, None]
        known = m.observed_at(jax.lax.stop_gradient(surface)) >= emission.KNOWN_SHARE
        read = depth[pixel] > 0.0  # nowhere in an image without a reading
        row = lambda *values: RGBD(*(value[None] for value in values))
        predicted = row(d, m.colour_at(surface), hit, hit & known)
        seen = row(depth[pixel], rgb[pixel], read, read)
        return 0.5 * xi @ precision @ xi - log_prob(seen, predicted, config.scales, config.max_depth).total.sum()

    xi = minimise(loss, jnp.zeros(basis.shape[1]), basis, config.adam)
    return T_world_pred @ se3_exp(basis @ xi)


@partial(jax.jit, static_argnums=5)
def _evaluate(
    predicted: GaussianBelief,
    rendered: RGBD,
    T_world_cam: Float[Array, "4 4"],
    image: RGBD,
    rig: Rig,
    config: EmissionTrackerConfig,
) -> tuple[GaussianBelief, Array, AlignInfo]:
    """Evaluate the fit quality of the image against the map rendered at the estimate; return the resulting belief."""
    manifold, tracker, basis = predicted.manifold, config.tracker, camera_twists(predicted.manifold, rig)
    reference = make_reference(rendered, rig.camera, tracker.align)
    observed = make_observed(image, rig.camera, every=stride(rig.camera, 1, tracker.align))
    quality = fit_quality(jnp.eye(4), basis, reference, observed, rig.camera, tracker.align, 0)
    accepted = (score(quality) >= tracker.min_score) & (quality.photometric <= tracker.max_photometric)
    T_world_pred = manifold.pose(predicted.mean) @ rig.T_body_cam
    moved = jnp.linalg.pinv(basis) @ se3_log(inverse(T_world_pred) @ T_world_cam)
    laplace = jnp.linalg.inv(2.0 * quality.information + jnp.linalg.inv(predicted.covariance))
    corrected = GaussianBelief(manifold.perturb(predicted.mean, moved), laplace, manifold)
    return jax.tree.map(lambda a, b: jnp.where(accepted, a, b), corrected, predicted), accepted, quality


_predict = jax.jit(lambda transition, belief, control, dt: transition.predict(belief, control, dt))
