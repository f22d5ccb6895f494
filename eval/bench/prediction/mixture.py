"""Represent a predictive distribution by samples: ``p(x) = 1/K sum_k p(x | image k)`` at each pixel."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float

from vssm_gym.geometry.camera import MAX_DEPTH
from vssm_gym.model import emission_density
from vssm_gym.model.emission import RGBD
from vssm_gym.model.emission_density import EmissionScales, ImageLogProb
from vssm_gym.model.transition.belief import Belief


class SampledImages(eqx.Module):
    """Hold samples of an image; every one is blurred by the emission (eq. M30).

    Attributes:
        images: samples ``(k, height, width)`` of the image without the camera's noise.
        scales: of the emission about each of them.
        depth_std: standard deviation of each sample's depth, m, such as the map's; 0 for none.
        rgb_std: standard deviation of each sample's channels.
        max_depth: range of the readings, m.
    """

    images: RGBD
    scales: EmissionScales
    depth_std: Float[Array, "k height width"] | float = 0.0
    rgb_std: Float[Array, "k height width 3"] | float = 0.0
    max_depth: float = MAX_DEPTH

    def image_log_prob(self, image: RGBD) -> ImageLogProb:
        """``log 1/K sum_k p(x | image k)`` by pixel, split into depth and colour given depth."""
        return _log_prob(self, image)

    def depth_cdf(self, depth: Float[Array, "*batch height width"]) -> Float[Array, "*batch height width"]:
        """Return the mean of the samples' distribution functions, weighted by their probability of a reading."""
        return _depth_cdf(self, depth)

    def rgb_cdf(self, rgb: Float[Array, "*batch height width 3"]) -> Float[Array, "*batch height width 3"]:
        """Return the mean of the samples' distribution functions, weighted likewise."""
        return _rgb_cdf(self, rgb)


class SampledPrediction(eqx.Module):
    """Hold samples of an image, and samples and a density of its pose.

    Attributes:
        images: samples ``(k, height, width)`` of the image without the camera's noise.
        scales: of the emission about each of them.
        poses: samples of the pose; they may be more than those of the image.
        belief: density of the pose.
        depth_std: standard deviation of each sample's depth, m, such as the map's; 0 for none.
        rgb_std: standard deviation of each sample's channels.
        max_depth: range of the readings, m.
    """

    images: RGBD
    scales: EmissionScales
    poses: Float[Array, "samples 3"]
    belief: Belief
    depth_std: Float[Array, "k height width"] | float = 0.0
    rgb_std: Float[Array, "k height width 3"] | float = 0.0
    max_depth: float = MAX_DEPTH

    @property
    def seen(self) -> SampledImages:
        """Return the samples of the image alone."""
        return SampledImages(self.images, self.scales, self.depth_std, self.rgb_std, self.max_depth)

    def pose_log_prob(self, planar: Float[Array, "3"]) -> Float[Array, ""]:
        """Return the log density of a pose under :attr:`belief`."""
        return self.belief.log_prob(planar)

    def image_log_prob(self, image: RGBD) -> ImageLogProb:
        """Return that of :class:`SampledImages`."""
        return self.seen.image_log_prob(image)

    def depth_cdf(self, depth: Float[Array, "*batch height width"]) -> Float[Array, "*batch height width"]:
        """Return that of :class:`SampledImages`."""
        return self.seen.depth_cdf(depth)

    def rgb_cdf(self, rgb: Float[Array, "*batch height width 3"]) -> Float[Array, "*batch height width 3"]:
        """Return that of :class:`SampledImages`."""
        return self.seen.rgb_cdf(rgb)


@jax.jit
def _log_prob(prediction: SampledImages, image: RGBD) -> ImageLogProb:
    stds = prediction.depth_std, prediction.rgb_std
    each = emission_density.log_prob(image, prediction.images, prediction.scales, prediction.max_depth, *stds)
    mean = lambda log_p: logsumexp(log_p, axis=0) - jnp.log(log_p.shape[0])
    depth = mean(each.depth)
    return ImageLogProb(depth, mean(each.total) - depth)


@jax.jit
def _depth_cdf(prediction: SampledImages, depth: Array) -> Array:
    of = lambda image, std, depth: emission_density.depth_cdf(
        depth, image, prediction.scales, prediction.max_depth, std
    )
    stds = jnp.broadcast_to(prediction.depth_std, prediction.images.depth.shape)
    return _mixed(lambda value: jax.vmap(of, (0, 0, None))(prediction.images, stds, value), prediction, depth, 2)


@jax.jit
def _rgb_cdf(prediction: SampledImages, rgb: Array) -> Array:
    of = lambda image, std, rgb: emission_density.rgb_cdf(rgb, image, prediction.scales, std)
    stds = jnp.broadcast_to(prediction.rgb_std, prediction.images.rgb.shape)
    return _mixed(lambda value: jax.vmap(of, (0, 0, None))(prediction.images, stds, value), prediction, rgb, 3)


def _mixed(cdfs: Callable[[Array], Array], prediction: SampledImages, value: Array, axes: int) -> Array:
    """Average over samples; one entry of the batch after the other, since all together need much memory."""
    weight = emission_density.reading_prob(prediction.images, prediction.scales)
    weight = (weight / weight.sum(0)).reshape(*weight.shape, *[1] * (axes - 2))
    flat = value.reshape(-1, *value.shape[value.ndim - axes :])
    return jax.lax.map(lambda one: jnp.sum(weight * cdfs(one), axis=0), flat).reshape(value.shape)
