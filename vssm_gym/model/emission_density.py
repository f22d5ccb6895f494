"""``p(x | z, M)``: the density of an RGB-D image about the image that the map predicts from a pose (VSSM-LM).

A pixel has either no reading, or a depth ``d`` in ``(0, D]`` with a colour ``c`` in ``[0, 1]^3``. What the map predicts
there decides the shares: a surface that was observed, a surface that follows from the prior mean, or none.

    p(no reading) = m,    p(d, c) = (1 - m) p(d) p(c),    s(d*)^2 = (s_0 + s_2 d*^2)^2 + var(d*) / 2
    p(d) = (1 - o) Laplace(d; d*, s(d*)) + o p_o(d),    p_o(d) ~ (d / d_o)^2 / (1 + (d / d_o)^3)^2
    p(c) = (1 - o_c) [(1 - w) prod N(c; c*, s_c^2) + w prod N(c; c*, s_w^2)] + o_c

The cores are truncated to ``(0, D)`` and ``[0, 1]``, and so is ``p_o``, a log-logistic distribution of median ``d_o``:
what is not predicted is some surface of a room, seldom at the lens and seldom at the end of the range. Colour has two
scales, that of plain surfaces and that of surfaces whose texture is finer than the map's cells. Where no surface is
predicted ``o = o_c = 1``. The density integrates to one over {no reading} and all readings, so that poses and maps that
predict surfaces at different pixels can be compared: a pose that sees nothing pays the price of every reading there. It
is stated in nats with respect to metres of depth and to units of colour.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.stats import norm
from jaxtyping import Array, Float

from vssm_gym.geometry.camera import MAX_DEPTH
from vssm_gym.model.emission import RGBD

PUBLISHED_DEPTH_SCALE, PUBLISHED_RGB_SCALE = 0.1, 0.01  # Laplace scales of VSSM-LM: m, and a tenth of it
TINY = 1e-30  # keeps the logarithm of a share of 0 and its gradient finite


class EmissionScales(eqx.Module):
    """Hold ``sigma_E``: scales of the emission, and the shares of outliers and of pixels without a reading.

    The defaults have the greatest likelihood on images of a simulated Kinect in learned maps (5 cm cells) of the
    apartments that filters are tuned on.

    Attributes:
        depth: ``s_0``, scale of depth at the camera, m.
        growth: ``s_2``, by which it grows with the square of depth, 1/m.
        rgb: ``s_c``, standard deviation of a colour channel of a plain surface, in [0, 1].
        textured_rgb: ``s_w``, the same of a textured surface.
        textured: ``w``, share of the textured surfaces.
        outlier: share of the readings of an observed surface whose depth is that of any surface.
        guess_outlier: the same for a surface that was not observed.
        outlier_depth: ``d_o``, median depth of an outlier, m.
        rgb_outlier: share of the readings of an observed surface whose colour is any colour.
        guess_rgb_outlier: the same for a surface that was not observed.
        miss: probability of no reading where an observed surface is predicted.
        guess_miss: the same for a surface that was not observed.
        empty_miss: probability of no reading where no surface is predicted.
    """

    depth: Float[Array, ""] | float = 0.006
    growth: Float[Array, ""] | float = 0.0008
    rgb: Float[Array, ""] | float = 0.02
    textured_rgb: Float[Array, ""] | float = 0.078
    textured: Float[Array, ""] | float = 0.53
    outlier: Float[Array, ""] | float = 0.025
    guess_outlier: Float[Array, ""] | float = 0.89
    outlier_depth: Float[Array, ""] | float = 0.9
    rgb_outlier: Float[Array, ""] | float = 0.03
    guess_rgb_outlier: Float[Array, ""] | float = 0.9
    miss: Float[Array, ""] | float = 0.11
    guess_miss: Float[Array, ""] | float = 0.2
    empty_miss: Float[Array, ""] | float = 0.09

    def depth_at(self, depth: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """``s_0 + s_2 d^2``: the scale of depth by the predicted depth, m."""
        return self.depth + self.growth * depth**2

    @property
    def rgb_variance(self) -> Array:
        """Return the variance of a colour channel without outliers: that of both scales, by their shares."""
        return (1.0 - self.textured) * jnp.square(self.rgb) + self.textured * jnp.square(self.textured_rgb)


class ImageLogProb(NamedTuple):
    """Hold the parts of ``log p(x | z, M)`` by pixel, nats; their sum is the density of the pixel."""

    depth: Float[Array, "*batch"]  # of the reading's presence and depth, in 1/m, or of its absence
    rgb: Float[Array, "*batch"]  # of the three channels given a reading, with respect to [0, 1]^3; 0 without one

    @property
    def total(self) -> Float[Array, "*batch"]:
        """Return the log density of each pixel."""
        return self.depth + self.rgb


class _Shares(NamedTuple):
    """Hold the shares that apply to each pixel."""

    miss: Array
    outlier: Array
    rgb_outlier: Array

    @classmethod
    def of(cls, predicted: RGBD, scales: EmissionScales) -> "_Shares":
        pick = lambda known, guess, empty: jnp.where(predicted.hit, jnp.where(predicted.known, known, guess), empty)
        return cls(
            pick(scales.miss, scales.guess_miss, scales.empty_miss),
            pick(scales.outlier, scales.guess_outlier, 1.0),
            pick(scales.rgb_outlier, scales.guess_rgb_outlier, 1.0),
        )


def has_reading(image: RGBD, max_depth: float | Array = MAX_DEPTH) -> Array:
    """Return which pixels have a reading within the range; farther readings count as none."""
    return image.hit & (image.depth > 0.0) & (image.depth <= max_depth)


def log_prob(
    image: RGBD,
    predicted: RGBD,
    scales: EmissionScales,
    max_depth: float | Array = MAX_DEPTH,
    depth_std: Array | float = 0.0,
    rgb_std: Array | float = 0.0,
) -> ImageLogProb:
    """``log p(x | z, M)`` by pixel (eq. M11); differentiable in the prediction and the scales.

    Args:
        image: What the camera delivered; any shape of pixels.
        predicted: What :func:`vssm_gym.model.emission.render` predicts, of the same or a broadcast shape.
        scales: Of the emission.
        max_depth: ``D``, the range, m; the one that the prediction was rendered with.
        depth_std: Standard deviation of the predicted depth, m, such as the map's; read where a surface was observed.
        rgb_std: Standard deviation of the predicted channels, likewise.

    Returns:
        The parts of depth and of colour.
    """
    shares, read = _Shares.of(predicted, scales), has_reading(image, max_depth)
    location, scale = _depth_core(predicted, scales, max_depth, depth_std)
    core = _log_laplace(jnp.where(read, image.depth, location), location, scale, max_depth)
    other = _log_any_depth(jnp.where(read, image.depth, 1.0), scales.outlier_depth, max_depth)
    given = _log_mixture(core, other, shares.outlier)
    depth = jnp.where(read, _log(1.0 - shares.miss) + given, _log(shares.miss))
    location, plain, textured = _rgb_cores(predicted, scales, rgb_std)
    plain, textured = (_log_normal(image.rgb, location, std).sum(-1) for std in (plain, textured))
    rgb = _log_mixture(_log_mixture(plain, textured, scales.textured), 0.0, shares.rgb_outlier)
    return ImageLogProb(depth, jnp.where(read, rgb, 0.0))


def reading_prob(predicted: RGBD, scales: EmissionScales) -> Array:
    """Return ``1 - m``, the probability of a reading at each pixel."""
    return 1.0 - _Shares.of(predicted, scales).miss


def depth_cdf(
    depth: Float[Array, "*batch"],
    predicted: RGBD,
    scales: EmissionScales,
    max_depth: float | Array = MAX_DEPTH,
    depth_std: Array | float = 0.0,
) -> Array:
    """``P(d <= depth | a reading)`` by pixel; arguments as in :func:`log_prob`."""
    outlier = _Shares.of(predicted, scales).outlier
    location, scale = _depth_core(predicted, scales, max_depth, depth_std)
    depth = jnp.clip(depth, 0.0, max_depth)
    any_depth = _any_depth_cdf(depth, scales.outlier_depth, max_depth)
    return (1.0 - outlier) * _laplace_cdf(depth, location, scale, max_depth) + outlier * any_depth


def rgb_cdf(
    rgb: Float[Array, "*batch 3"],
    predicted: RGBD,
    scales: EmissionScales,
    rgb_std: Array | float = 0.0,
) -> Array:
    """``P(channel <= value | a reading)`` by pixel and channel; arguments as in :func:`log_prob`."""
    outlier = _Shares.of(predicted, scales).rgb_outlier[..., None]
    location, *both = _rgb_cores(predicted, scales, rgb_std)
    rgb = jnp.clip(rgb, 0.0, 1.0)
    plain, textured = (_normal_cdf(rgb, location, std) for std in both)
    core = (1.0 - scales.textured) * plain + scales.textured * textured
    return (1.0 - outlier) * core + outlier * rgb


def _depth_core(
    predicted: RGBD, scales: EmissionScales, max_depth: float | Array, depth_std: Array | float
) -> tuple[Array, Array]:
    """Return location and scale of the core; a std is a Laplace scale times sqrt(2)."""
    location = jnp.clip(predicted.depth, 0.0, max_depth)
    std = jnp.where(predicted.known, depth_std, 0.0)  # infinite elsewhere
    return location, jnp.sqrt(scales.depth_at(location) ** 2 + 0.5 * std**2)


def _rgb_cores(predicted: RGBD, scales: EmissionScales, rgb_std: Array | float) -> tuple[Array, Array, Array]:
    """Return the location and both standard deviations."""
    std = jnp.where(predicted.known[..., None], rgb_std, 0.0)
    plain, textured = (jnp.sqrt(jnp.square(scale) + std**2) for scale in (scales.rgb, scales.textured_rgb))
    return jnp.clip(predicted.rgb, 0.0, 1.0), plain, textured


def _log_laplace(x: Array, location: Array, scale: Array, end: float | Array) -> Array:
    """Return the log density of a Laplace distribution truncated to ``(0, end)``, which holds its location."""
    inside = 1.0 - 0.5 * jnp.exp(-location / scale) - 0.5 * jnp.exp(-(end - location) / scale)
    return -jnp.abs(x - location) / scale - jnp.log(2.0 * scale) - jnp.log(jnp.maximum(inside, TINY))


def _laplace_cdf(x: Array, location: Array, scale: Array, end: float | Array) -> Array:
    """Return the distribution function of the density of :func:`_log_laplace`."""
    below = lambda t: 0.5 - 0.5 * jnp.sign(location - t) * (1.0 - jnp.exp(-jnp.abs(location - t) / scale))
    low, high = below(jnp.zeros_like(location)), below(jnp.full_like(location, end))
    return (below(x) - low) / jnp.maximum(high - low, TINY)


def _log_any_depth(x: Array, median: float | Array, end: float | Array) -> Array:
    """Return the log density of a log-logistic distribution of exponent 3, truncated to ``(0, end)``."""
    ratio, last = x / median, end / median
    inside = last**3 / (1.0 + last**3)
    return jnp.log(3.0 * ratio**2 / median) - 2.0 * jnp.log1p(ratio**3) - jnp.log(inside)


def _any_depth_cdf(x: Array, median: float | Array, end: float | Array) -> Array:
    """Return the distribution function of the density of :func:`_log_any_depth`."""
    share = lambda ratio: ratio**3 / (1.0 + ratio**3)
    return share(x / median) / share(end / median)


def _log_normal(x: Array, mean: Array, std: Array) -> Array:
    """Return the log density of a normal distribution truncated to ``[0, 1]``, which holds its mean."""
    return norm.logpdf(x, mean, std) - jnp.log(norm.cdf(1.0, mean, std) - norm.cdf(0.0, mean, std))


def _normal_cdf(x: Array, mean: Array, std: Array) -> Array:
    """Return the distribution function of the density of :func:`_log_normal`."""
    low, high = norm.cdf(0.0, mean, std), norm.cdf(1.0, mean, std)
    return (norm.cdf(x, mean, std) - low) / (high - low)


def _log_mixture(core: Array, other: float | Array, share: float | Array) -> Array:
    """Return ``log [(1 - share) exp(core) + share exp(other)]``."""
    return jnp.logaddexp(_log(1.0 - share) + core, _log(share) + other)


def _log(share: float | Array) -> Array:
    return jnp.log(jnp.maximum(share, TINY))
