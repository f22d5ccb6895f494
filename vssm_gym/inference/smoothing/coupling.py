"""Transform points of R^n by layers of a normalising flow, one coordinate at a time (eq. I63).

    y = (x_2, ..., x_n, exp(a) f(x_1) + b),    |a| < 3,    a, b, f by a network of x_2, ..., x_n and a context

``f`` is a monotonic rational-quadratic spline on ``[-4, 4]`` and the identity outside (Durkan et al., NeurIPS 2019).
Each layer transforms the first coordinate and makes it the last, so that all layers are alike and stacked. Both
directions are in closed form, and the Jacobian is triangular but for the order, so that a density is followed exactly.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

SPLINE_REACH = 4.0  # standard deviations of a standard normal; what lies beyond is moved and scaled, but not bent
SPLINE_BINS = 8  # of the spline
LEAST_SHARE = 1e-3  # share of a bin, and slope, at least: the inverse stays well conditioned
TURNS = 2  # times that each coordinate is transformed
HIDDEN_UNITS = 32  # units of each of the two hidden layers of the network
MOST_SCALE = (
    3.0  # nats, of a layer: unbounded, an exponential of what the last layer has scaled overflows for some draws
)
SLOPE_SHIFT = 0.541325  # log(e - 1): softplus of it is 1, so that the layer starts as the identity


class Couplings(eqx.Module):
    """Transform points of R^n by a stack of layers; a new stack is the identity.

    Attributes:
        network: of each layer, from the other coordinates and the context to the transformation's parameters.
    """

    network: tuple[eqx.nn.Linear, ...]  # leaves have a leading axis of layers

    @classmethod
    def of(cls, key: PRNGKeyArray, dim: int, context: int) -> "Couplings":
        """Return layers that are the identity until they are trained; each coordinate is transformed ``TURNS`` times.

        Args:
            key: of the networks' first layers.
            dim: coordinates of a point.
            context: length of the context; 0 for none.
        """
        sizes = (dim - 1 + context, HIDDEN_UNITS, HIDDEN_UNITS, 3 * SPLINE_BINS + 1)

        def network(key: PRNGKeyArray) -> tuple[eqx.nn.Linear, ...]:
            keys = jax.random.split(key, len(sizes) - 1)
            *hidden, last = (eqx.nn.Linear(n, m, key=k) for n, m, k in zip(sizes[:-1], sizes[1:], keys, strict=True))
            return (*hidden, jax.tree.map(jnp.zeros_like, last))

        return cls(jax.vmap(network)(jax.random.split(key, TURNS * dim)))

    def forward(self, x: Float[Array, "n"], context: Float[Array, "c"]) -> tuple[Float[Array, "n"], Float[Array, ""]]:
        """Return ``y`` and ``log |dy / dx|``."""

        def layer(x: Array, network: tuple[eqx.nn.Linear, ...]) -> tuple[Array, Array]:
            log_scale, shift, knots = _parameters(network, x[1:], context)
            bent, log_slope = spline(x[0], knots)
            return jnp.append(x[1:], jnp.exp(log_scale) * bent + shift), log_scale + log_slope

        y, log_det = jax.lax.scan(layer, x, self.network)
        return y, jnp.sum(log_det)

    def inverse(self, y: Float[Array, "n"], context: Float[Array, "c"]) -> tuple[Float[Array, "n"], Float[Array, ""]]:
        """Return ``x`` and ``log |dy / dx|`` there."""

        def layer(y: Array, network: tuple[eqx.nn.Linear, ...]) -> tuple[Array, Array]:
            log_scale, shift, knots = _parameters(network, y[:-1], context)
            straight = spline_inverse((y[-1] - shift) * jnp.exp(-log_scale), knots)
            return jnp.insert(y[:-1], 0, straight), log_scale + spline(straight, knots)[1]

        x, log_det = jax.lax.scan(layer, y, self.network, reverse=True)
        return x, jnp.sum(log_det)


def _parameters(network: tuple[eqx.nn.Linear, ...], others: Array, context: Array) -> tuple[Array, Array, "Knots"]:
    *hidden, last = network
    out = jnp.concatenate([others, context])
    for layer in hidden:
        out = jax.nn.silu(layer(out))
    out = last(out)
    return (
        MOST_SCALE * jnp.tanh(out[0] / MOST_SCALE),
        out[1],
        Knots.of(out[2 : 2 + SPLINE_BINS], out[2 + SPLINE_BINS : 2 + 2 * SPLINE_BINS], out[2 + 2 * SPLINE_BINS :]),
    )


class Knots(eqx.Module):
    """Hold a spline: the bins' edges on both axes, and the slopes at them, one at both ends."""

    x: Float[Array, "edges"]
    y: Float[Array, "edges"]
    slope: Float[Array, "edges"]

    @classmethod
    def of(cls, widths: Float[Array, "bins"], heights: Float[Array, "bins"], slopes: Float[Array, "inner"]) -> "Knots":
        """Return the spline of unconstrained numbers; that of zeros is the identity."""
        share = lambda free: LEAST_SHARE + (1.0 - LEAST_SHARE * SPLINE_BINS) * jax.nn.softmax(free)
        edges = lambda free: (
            SPLINE_REACH * jnp.concatenate([-jnp.ones(1), 2.0 * jnp.cumsum(share(free))[:-1] - 1.0, jnp.ones(1)])
        )
        inner = LEAST_SHARE + (1.0 - LEAST_SHARE) * jax.nn.softplus(slopes + SLOPE_SHIFT)
        return cls(edges(widths), edges(heights), jnp.concatenate([jnp.ones(1), inner, jnp.ones(1)]))


def spline(x: Float[Array, ""], knots: Knots) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return ``f(x)`` and ``log f'(x)``."""
    inside = jnp.abs(x) < SPLINE_REACH
    at = jnp.where(inside, x, 0.0)
    x0, y0, width, height, left, right = _bin(at, knots.x, knots)
    t, mean = (at - x0) / width, height / width
    both = t * (1.0 - t)
    below = mean + (left + right - 2.0 * mean) * both
    y = y0 + height * (mean * t**2 + left * both) / below
    slope = mean**2 * (right * t**2 + 2.0 * mean * both + left * (1.0 - t) ** 2) / below**2
    return jnp.where(inside, y, x), jnp.where(inside, jnp.log(slope), 0.0)


def spline_inverse(y: Float[Array, ""], knots: Knots) -> Float[Array, ""]:
    """Return ``x`` with ``f(x) = y``: the root of a quadratic in its bin, by the stable formula."""
    inside = jnp.abs(y) < SPLINE_REACH
    at = jnp.where(inside, y, 0.0)
    x0, y0, width, height, left, right = _bin(at, knots.y, knots)
    mean, off = height / width, at - y0
    bend = left + right - 2.0 * mean
    a, b, c = height * (mean - left) + off * bend, height * left - off * bend, -mean * off
    t = 2.0 * c / (-b - jnp.sqrt(jnp.maximum(b**2 - 4.0 * a * c, 1e-12)))
    return jnp.where(inside, x0 + t * width, y)


def _bin(at: Array, edges: Array, knots: Knots) -> tuple[Array, ...]:
    """Return the bin of a point by one axis' edges: its corner, width, height, and slopes at its ends."""
    k = jnp.clip(jnp.searchsorted(edges, at, side="right") - 1, 0, SPLINE_BINS - 1)
    x, y, slope = knots.x, knots.y, knots.slope
    return x[k], y[k], x[k + 1] - x[k], y[k + 1] - y[k], slope[k], slope[k + 1]
