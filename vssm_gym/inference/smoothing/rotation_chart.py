"""Map R^3 onto SO(3) so that a standard normal becomes the uniform distribution of rotations (eq. I62).

    R = exp(a(|w|) w / |w|),    a(s) - sin a(s) = pi P(chi_3 <= s),    w ~ N(0, 1)  <=>  R ~ uniform

Any density over ``w`` is thereby one over rotations, with ``|dR / dw| = 8 pi^2 N(w; 0, 1)``. A narrow Gaussian over
``w`` is a Gaussian in the tangent, since ``a(s)`` is linear near zero; the standard one knows nothing. Rotations by pi
are the far end of R^3. Beyond ``LARGEST`` the map is not one to one: a normal that is wider than the standard one, or
off the origin, has more draws there, whose density is too low.
"""

from functools import cache

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import brentq
from scipy.stats import chi

# |w| of the last entry: rotations by all but 2e-5 rad of pi. A standard normal is beyond it once in 65,000 draws
LARGEST = 5.0
ENTRIES = 256  # of the table; cubic interpolation between them is exact to float32
LOG_VOLUME = float(np.log(8.0 * np.pi**2))  # log of the volume of SO(3), rad^3


def to_rotation(w: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """Return the rotation matrices of points of R^3."""
    s = _norm(w)
    near, ratio, slope, _ = _tables()
    turn = _interpolated(jnp.minimum(s, LARGEST), near, ratio, slope) * jnp.where(s > LARGEST, LARGEST / s, 1.0)
    return jaxlie.SO3.exp(turn[..., None] * w).as_matrix()


def from_rotation(R: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3"]:
    """Return the points of R^3 of rotation matrices: the inverse of :func:`to_rotation`."""
    turned = jaxlie.SO3.from_matrix(R).log()
    near, ratio, slope, angle = _tables()
    a = _norm(turned)
    # d (s / a) / da of the inverse function, from that of a / s by s
    rise = ratio + near * slope
    inverse = (1.0 / rise - 1.0 / ratio) / np.where(angle > 0.0, angle, np.float32(1.0))
    return _interpolated(jnp.minimum(a, angle[-1]), angle, 1.0 / ratio, inverse)[..., None] * turned


def log_volume(w: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
    """``log |dR / dw| = log 8 pi^2 + log N(w; 0, 1)``: volume of rotations (rad^3) per volume of R^3."""
    return LOG_VOLUME - 0.5 * jnp.sum(w**2, axis=-1) - 1.5 * jnp.log(2.0 * jnp.pi)


def _norm(x: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
    """Return the length of vectors, with a finite gradient at zero."""
    return jnp.sqrt(jnp.sum(x**2, axis=-1) + 1e-14)


def _interpolated(x: Array, nodes: np.ndarray, value: np.ndarray, slope: np.ndarray) -> Array:
    """Return Hermite's cubic interpolation of a table with slopes."""
    at, values, slopes = (jnp.asarray(column) for column in (nodes, value, slope))
    i = jnp.clip(jnp.searchsorted(at, x, side="right") - 1, 0, len(nodes) - 2)
    width = at[i + 1] - at[i]
    t = (x - at[i]) / width
    rise = t * t * (3.0 - 2.0 * t)
    bends = t * (1.0 - t) * width * ((1.0 - t) * slopes[i] - t * slopes[i + 1])
    return values[i] + rise * (values[i + 1] - values[i]) + bends


@cache
def _tables() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return ``s``, ``a / s`` and its derivative, and ``a``, computed in float64."""
    s = np.linspace(0.0, LARGEST, ENTRIES)
    a = np.zeros_like(s)
    for i, radius in enumerate(s[1:], 1):
        left = np.pi * chi.sf(radius, 3)  # b + sin b, b = pi - a: accurate at the far end
        right = np.pi * chi.cdf(radius, 3)
        if radius < 2.0:
            a[i] = brentq(lambda x, y=right: _less_sine(x) - y, 0.0, np.pi, xtol=1e-15, rtol=1e-14)
        else:
            a[i] = np.pi - brentq(lambda x, y=left: x + np.sin(x) - y, 0.0, np.pi, xtol=1e-18, rtol=1e-14)
    ratio = np.full_like(s, (2.0 * np.sqrt(2.0 * np.pi)) ** (1.0 / 3.0))
    ratio[1:] = a[1:] / s[1:]
    rise = np.full_like(s, ratio[0])
    rise[1:] = chi.pdf(s[1:], 3) * np.pi / (2.0 * np.sin(0.5 * a[1:]) ** 2)
    slope = np.zeros_like(s)
    slope[1:] = (rise[1:] - ratio[1:]) / s[1:]
    single = lambda column: np.asarray(column, np.float32)
    return single(s), single(ratio), single(slope), single(a)


def _less_sine(x: float) -> float:
    """Return ``x - sin x`` without cancellation."""
    if x > 0.5:
        return float(x - np.sin(x))
    term, total = x**3 / 6.0, 0.0
    for k in range(2, 9):
        total += term
        term *= -(x**2) / ((2 * k) * (2 * k + 1))
    return total
