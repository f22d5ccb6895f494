"""List the models that are compared: VSSM-LM, its map without uncertainty of the pose, and an image that persists."""

from dataclasses import dataclass, field, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.agents.base import AgentContext
from vssm_gym.agents.shared.localization import start_filter
from vssm_gym.errors import InputError
from vssm_gym.eval.bench.prediction.contract import WorldModel
from vssm_gym.eval.bench.prediction.mixture import SampledPrediction
from vssm_gym.geometry.camera import Camera
from vssm_gym.model.emission import RGBD
from vssm_gym.model.emission_density import PUBLISHED_DEPTH_SCALE, PUBLISHED_RGB_SCALE, EmissionScales
from vssm_gym.model.emission_uncertainty import image_std
from vssm_gym.model.spatial_model import SpatialModel, rollout
from vssm_gym.model.transition import GaussianBelief, planar_belief

IMAGE_SAMPLES, POSE_SAMPLES = 64, 500  # with 64, the truth lies outside of all in 3 % of pixels
# Those of VSSM-LM; colour has the standard deviation of its Laplace distribution, and shares are the fitted ones
PUBLISHED_SCALES = EmissionScales(
    depth=PUBLISHED_DEPTH_SCALE, growth=0.0, rgb=2.0**0.5 * PUBLISHED_RGB_SCALE, textured=0.0
)
# Of greatest likelihood on the train split, where the image and the pose at one time predict those 1 s and 3 s later
PERSISTING_SCALES = EmissionScales(
    depth=0.001,
    growth=0.009,
    rgb=0.03,
    textured_rgb=0.141,
    textured=0.73,
    outlier=0.67,
    outlier_depth=1.42,
    rgb_outlier=0.3,
    miss=0.097,
    empty_miss=0.18,
)
PERSISTING_STD = (0.33, 0.52)  # m along each axis, rad; a second


class TrackedBody:
    """Follow the robot with the filter ``tracker`` in the learned map."""

    def begin(self, context: AgentContext, image: RGBD) -> None:
        """Start the filter at the known pose."""
        if context.map is None:
            raise InputError("AgentContext", "map", "a learned map: this model predicts images of one")
        self.context = context
        self._filter, self._state = start_filter("tracker", context, image, context.map)

    def observe(self, command: np.ndarray, image: RGBD) -> None:
        """Run a step of the filter."""
        control = jnp.asarray(command, jnp.float32)
        self._state, _ = self._filter.step(self._state, control, image, self.context.dt)

    @property
    def belief(self) -> GaussianBelief:
        """Return ``q(z_t)`` in the map's frame."""
        belief: Any = self._filter.posterior(self._state).belief
        return belief


@dataclass
class VssmLm:
    """Propagate the tracker's belief by the transition, and render the map at samples of the pose.

    Attributes:
        name: of its rows.
        scales: of the emission.
        sampled: False: one image at the mean pose stands for all; the pose stays a distribution.
    """

    name: str = "VSSM-LM"
    scales: EmissionScales = field(default_factory=EmissionScales)
    sampled: bool = True
    _body: TrackedBody = field(default_factory=TrackedBody)

    def begin(self, context: AgentContext, image: RGBD) -> None:
        """Start the filter."""
        self._body.begin(context, image)

    def observe(self, command: np.ndarray, image: RGBD) -> None:
        """Filter an image."""
        self._body.observe(command, image)

    def predict(self, commands: Float[np.ndarray, "steps m"], camera: Camera, key: PRNGKeyArray) -> SampledPrediction:
        """Draw poses after the commands, and render the map's mean from the first of them."""
        context = self._body.context
        assert context.map is not None  # else the body would not have started
        T_body_cam = jnp.asarray(context.T_body_cam, jnp.float32)
        spatial = SpatialModel(context.transition, context.map, camera, T_body_cam, self.scales)
        controls = jnp.asarray(commands, jnp.float32)
        poses, ahead = _futures(spatial, self._body.belief, controls, context.dt, key)
        seen_from = poses[:IMAGE_SAMPLES] if self.sampled else ahead.mean[None]
        images, depth_std, rgb_std = map_images(spatial, seen_from)
        return SampledPrediction(images, self.scales, poses, ahead, depth_std, rgb_std)


@eqx.filter_jit
def _futures(
    spatial: SpatialModel, belief: GaussianBelief, controls: Array, dt: float, key: PRNGKeyArray
) -> tuple[Array, GaussianBelief]:
    """Return samples of the pose after the controls, and the Gaussian that the transition predicts."""
    poses = rollout(key, spatial, belief, controls, dt, samples=POSE_SAMPLES).states[:, -1]
    ahead, _ = jax.lax.scan(lambda q, u: (spatial.transition.predict(q, u, dt), None), belief, controls)
    return poses, ahead


@eqx.filter_jit
def map_images(spatial: SpatialModel, states: Any) -> tuple[RGBD, Array, Array]:
    """Render the map's mean from each state, with the map's standard deviations of depth (m) and colour.

    Args:
        spatial: map, camera and its place on the body.
        states: of the transition's manifold, leading axis.
    """

    def one(state: Any) -> tuple[RGBD, Array, Array]:
        image = spatial.image(spatial.m, state)
        T_world_cam = spatial.transition.manifold.pose(state) @ spatial.T_body_cam
        return image, *image_std(spatial.m, T_world_cam, spatial.camera, image, spatial.measurement_noise)

    return jax.lax.map(one, states)


@dataclass
class Persistence:
    """Predict that nothing changes: the last image and the tracker's pose, with spreads fitted on the train split."""

    name: str = "last image persists"
    scales: EmissionScales = PERSISTING_SCALES
    std: tuple[float, float] = PERSISTING_STD
    _body: TrackedBody = field(default_factory=TrackedBody)

    def begin(self, context: AgentContext, image: RGBD) -> None:
        """Start the filter, and keep the image."""
        self._body.begin(context, image)
        self._last = image

    def observe(self, command: np.ndarray, image: RGBD) -> None:
        """Filter an image, and keep it."""
        self._body.observe(command, image)
        self._last = image

    def predict(self, commands: Float[np.ndarray, "steps m"], camera: Camera, key: PRNGKeyArray) -> SampledPrediction:
        """Return the last image at the camera's pixels."""
        context = self._body.context
        own = Camera.from_matrix(context.K, *context.camera)
        seconds = context.dt * len(commands)
        std = jnp.array([self.std[0], self.std[0], self.std[1]]) * seconds
        ahead = planar_belief(self._body.belief.mean, jnp.diag(std**2))
        return SampledPrediction(shown(self._last, own, camera), self.scales, ahead.sample(key, POSE_SAMPLES), ahead)


def shown(image: RGBD, own: Camera, camera: Camera) -> RGBD:
    """Return a camera's image at the pixels of another one in its place, with a leading axis of length 1."""
    column = np.rint((np.arange(camera.width) - camera.cx) / camera.fx * own.fx + own.cx).astype(int)
    row = np.rint((np.arange(camera.height) - camera.cy) / camera.fy * own.fy + own.cy).astype(int)
    return jax.tree.map(lambda a: a[row[:, None], column[None, :]][None], image)


def models() -> tuple[WorldModel, ...]:
    """Return the models that are scored, each new."""
    return (
        VssmLm(),
        VssmLm(name="VSSM-LM, published scales", scales=PUBLISHED_SCALES),
        VssmLm(name="map at the mean pose", sampled=False),
        Persistence(),
    )


def with_map(context: AgentContext, learned: Any) -> AgentContext:
    """Return the context of a robot that has learned a map."""
    return replace(context, map=learned)
