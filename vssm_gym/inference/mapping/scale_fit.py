"""Find the emission scales of greatest likelihood for pairs of images and predictions: ``max sum log p(x | z, M)``."""

from collections.abc import Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float
from scipy.optimize import minimize

from vssm_gym.geometry.camera import MAX_DEPTH
from vssm_gym.model.emission import RGBD
from vssm_gym.model.emission_density import EmissionScales, log_prob

FITTED_PIXELS = 60_000  # drawn from all pairs; more change no scale by a per cent
SMALLEST_SCALE = 1e-3  # m and colour: lower bound for maps that predict some pixels exactly
LARGEST_SCALE = 1.0  # m and colour
OUTLIER_DEPTHS = (0.1, 10.0)  # m, least and greatest median
LARGEST_GROWTH = 1.0  # 1/m
SMALLEST_SHARE = 1e-3  # of outliers and misses: what was never seen in a fit stays possible
SCALED = ("depth", "outlier_depth", "rgb", "textured_rgb")  # positive, fitted by their logarithms
GROWTH_UNIT = 1e-3  # 1/m, so that all coordinates of the search are of order one
FIT_STEPS = 200  # of L-BFGS at most; some dozens suffice


class PixelPairs(eqx.Module):
    """Hold pixels of images beside their predictions; axes are flat."""

    image: RGBD
    predicted: RGBD
    depth_std: Float[Array, "pixels"]  # m, of the prediction; 0 for a prediction that states none
    rgb_std: Float[Array, "pixels 3"]

    @classmethod
    def of(
        cls, image: RGBD, predicted: RGBD, depth_std: Array | None = None, rgb_std: Array | None = None
    ) -> "PixelPairs":
        """Flatten an image and its prediction."""
        flat = lambda a: jax.tree.map(lambda x: x.reshape(-1, *x.shape[image.depth.ndim :]), a)
        zero = jnp.zeros_like(predicted.depth), jnp.zeros_like(predicted.rgb)
        stds = tuple(z if std is None else std for z, std in zip(zero, (depth_std, rgb_std), strict=True))
        return cls(flat(image), flat(predicted), flat(stds[0]), flat(stds[1]))

    @classmethod
    def drawn(cls, pairs: Iterable["PixelPairs"], count: int = FITTED_PIXELS) -> "PixelPairs":
        """Draw at most ``count`` pixels from all pairs together, always the same ones."""
        every = jax.tree.map(lambda *arrays: np.concatenate([np.asarray(a) for a in arrays]), *pairs)
        n = len(every.image.depth)
        chosen = np.sort(np.random.default_rng(0).choice(n, min(n, count), replace=False))
        return jax.tree.map(lambda a: jnp.asarray(a[chosen]), every)


def fit(pairs: PixelPairs, max_depth: float = MAX_DEPTH, start: EmissionScales | None = None) -> EmissionScales:
    """Maximise the mean log density of the pixels over all scales and shares, by L-BFGS within bounds (eq. I42).

    Args:
        pairs: Pixels and their predictions.
        max_depth: Range of the readings, m.
        start: Scales at the start; what no pixel tells about stays as it is there, by default as published here.

    Returns:
        The scales; finite, whatever the pixels are.
    """
    theta, unravel = ravel_pytree(_free(start or EmissionScales()))
    low, high = (ravel_pytree(bound)[0] for bound in _bounds())

    @jax.jit
    def loss(theta: Array, pairs: PixelPairs) -> tuple[Array, Array]:
        def nats(theta: Array) -> Array:
            stds = pairs.depth_std, pairs.rgb_std
            return -log_prob(pairs.image, pairs.predicted, _scales(unravel(theta)), max_depth, *stds).total.mean()

        return jax.value_and_grad(nats)(theta)

    def evaluated(x: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = loss(jnp.asarray(x, jnp.float32), pairs)
        return float(value), np.asarray(slope, np.float64)

    box = np.stack([low, high], axis=1).astype(np.float64)
    x0 = np.clip(np.asarray(theta, np.float64), *box.T)
    found = minimize(evaluated, x0, jac=True, method="L-BFGS-B", bounds=box, options={"maxiter": FIT_STEPS})
    return _scales(unravel(jnp.asarray(found.x, jnp.float32)))


def _free(scales: EmissionScales) -> dict[str, Array]:
    """Return the coordinates of the search: logarithms of scales, logits of shares, growth in its unit."""
    return {name: _coordinate(name, jnp.asarray(value, jnp.float32)) for name, value in vars(scales).items()}


def _coordinate(name: str, value: Array) -> Array:
    if name == "growth":
        return value / GROWTH_UNIT
    return jnp.log(value) if name in SCALED else jnp.log(value) - jnp.log1p(-value)


def _scales(free: dict[str, Array]) -> EmissionScales:
    """Invert :func:`_free`."""
    back = lambda name, x: x * GROWTH_UNIT if name == "growth" else jnp.exp(x) if name in SCALED else jax.nn.sigmoid(x)
    return EmissionScales(**{name: back(name, x) for name, x in free.items()})


def _bounds() -> tuple[dict[str, Array], dict[str, Array]]:
    """Return the least and greatest coordinates."""
    shares = dict.fromkeys(vars(EmissionScales()), (SMALLEST_SHARE, 1.0 - SMALLEST_SHARE))
    ends = shares | dict.fromkeys(SCALED, (SMALLEST_SCALE, LARGEST_SCALE))
    ends |= {"growth": (0.0, LARGEST_GROWTH), "outlier_depth": OUTLIER_DEPTHS}
    low, high = ({name: _coordinate(name, jnp.float32(end[i])) for name, end in ends.items()} for i in (0, 1))
    return low, high
