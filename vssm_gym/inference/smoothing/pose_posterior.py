"""Fit ``q(z)`` to one image in a known map by its evidence lower bound (VSSM-LM, section 4; eqs. I65 and I66).

    log p(x | M) >= L = E_q[log p(x | z, M) + log p(z) - log q(z)]

:func:`climb` ascends ``L`` by Adam with reparameterised draws, its likelihood annealed. That suffices near the solution
only: which surface a ray hits has no gradient, and a camera that does not see an object is not drawn to it.
:func:`approach` comes before. It needs values of the likelihood alone, and keeps to all sides that explain the image.
The map is a given one: the mean of a belief, or a draw.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.errors import InputError
from vssm_gym.inference.filter import Rig
from vssm_gym.inference.smoothing.families import TrajectoryBelief
from vssm_gym.inference.smoothing.pose_flow import PoseFlow
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model import emission
from vssm_gym.model.emission import MAX_DEPTH, RGBD
from vssm_gym.model.emission_density import EmissionScales, log_prob

RENDERED_TOGETHER = 64  # poses rendered together: more take more memory, not less time
HALVINGS = 30  # of the interval of a trust region's exponent, which reaches down to LEAST_EXPONENT
NO_WEIGHT = -1e9  # nats, of a draw without a density: finite, since 0 times infinity is undefined; no part in a softmax
LEAST_EXPONENT = 1e-5  # of the posterior in a step of :func:`approach`
LAST_RATE = 0.01  # of a decaying rate, as a share of the first
CLIPPED = 100.0  # norm of a gradient, nats per unit: a pose that hits a ray's edge has a far larger one

Family = TypeVar("Family", bound=TrajectoryBelief)


@runtime_checkable
class Prior(Protocol):
    """Describe ``p(z)`` over poses; an implementation is a pytree, such as a belief."""

    def log_prob(self, state: Float[Array, "*batch 4 4"]) -> Float[Array, "*batch"]:
        """Return ``log p(z)``, nats with respect to m^3 rad^3."""


@runtime_checkable
class Likelihood(Protocol):
    """Describe ``p(x | z)`` of one image as a function of the pose; an implementation is a pytree."""

    def log_prob(self, T_world_body: Float[Array, "4 4"]) -> Float[Array, ""]:
        """Return ``log p(x | z)``, nats."""

    def widened(self, factor: Array) -> "Likelihood":
        """Return the likelihood with errors wider by a factor, so that its slope is felt from further away."""


class View(eqx.Module):
    """Hold an image with the map and the camera that explain it.

    Attributes:
        image: at the camera's size.
        m: the map.
        rig: the camera and its pose on the body.
        scales: of the emission.
        max_depth: range of the rendering, m.
    """

    image: RGBD
    m: VoxelMap
    rig: Rig
    scales: EmissionScales = EmissionScales()
    max_depth: Float[Array, ""] | float = MAX_DEPTH

    def log_prob(self, T_world_body: Float[Array, "4 4"]) -> Float[Array, ""]:
        """``log p(x | z, M)`` over all pixels, with and without readings (eq. M11)."""
        T_world_cam = T_world_body @ self.rig.T_body_cam
        predicted = emission.render_with(emission.search, self.m, T_world_cam, self.rig.camera, self.max_depth)
        return jnp.sum(log_prob(self.image, predicted, self.scales, self.max_depth).total)

    def widened(self, factor: Array) -> "View":
        """Return the likelihood whose scales of depth and colour are wider by a factor."""
        s = self.scales
        wide = replace(
            s,
            depth=factor * s.depth,
            growth=factor * s.growth,
            rgb=factor * s.rgb,
            textured_rgb=factor * s.textured_rgb,
        )
        return replace(self, scales=wide)


@dataclass(frozen=True)
class FitConfig:
    """Configure effort and annealing.

    Args:
        rounds: of :func:`approach`.
        draws: of each round.
        fits: steps of Adam in each round, on its draws.
        fit_rate: of these steps in the first half of the rounds. It then falls along a cosine, so that the noise of the
            draws averages out.
        effective: share of the draws that a round's weights must leave, which bounds how far it goes.
        steps: of :func:`climb`.
        samples: drawn in each.
        rate: of Adam at first; it falls along a cosine. A high one lets the shares of separate modes drift from those
            of the posterior.
        heat: factor by which scales are wide, and the likelihood is flat, at first.
        annealed: share of the steps after which the likelihood is the model's.
    """

    rounds: int = 120
    draws: int = 1024
    fits: int = 10
    fit_rate: float = 0.01
    effective: float = 0.5
    steps: int = 400
    samples: int = 64
    rate: float = 0.003
    heat: float = 10.0
    annealed: float = 0.6

    def __post_init__(self) -> None:
        for name in ("rounds", "draws", "fits", "steps", "samples"):
            if getattr(self, name) < 1:
                raise InputError("FitConfig", name, f"at least 1, not {getattr(self, name)}")
        for name in ("effective", "annealed"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise InputError("FitConfig", name, f"a share in (0, 1], not {getattr(self, name)}")
        if not self.heat >= 1.0:
            raise InputError("FitConfig", "heat", f"at least 1, not {self.heat}")


class Weighed(NamedTuple):
    """Hold draws of ``q`` and ``log p(x, z) - log q(z)`` of each: their mean is ``L``, their exponentials' is p(x)."""

    poses: Float[Array, "samples 4 4"]
    log_weight: Float[Array, "samples"]
    log_joint: Float[Array, "samples"]  # log p(x, z)


def fit(
    key: PRNGKeyArray, q: PoseFlow, prior: Prior, likelihood: Likelihood, config: FitConfig = FitConfig()
) -> PoseFlow:
    """``argmax_q L``: approach, then climb.

    Args:
        key: random key.
        q: to start from, about as wide as the prior.
        prior: ``p(z)``, over poses.
        likelihood: of the image.
        config: effort and annealing.

    Raises:
        InputError: none of the draws has a density, from which nothing can be learned.
    """
    of_approach, of_climb, of_check = jax.random.split(key, 3)
    found = approach(of_approach, q, prior, likelihood, config)
    if not jnp.any(weigh(of_check, found, prior, likelihood, config.draws).log_weight > NO_WEIGHT):
        expected = f"a density at one of {config.draws} poses of q at least; none has one"
        raise InputError("fit", "likelihood", expected)
    return climb(of_climb, found, prior, likelihood, config)


@partial(jax.jit, static_argnames="samples")
def weigh(key: PRNGKeyArray, q: PoseFlow, prior: Prior, likelihood: Likelihood, samples: int) -> Weighed:
    """Draw from ``q`` and compare with the posterior.

    Where a density is zero or undefined, both logarithms are ``NO_WEIGHT``. The pose is then the nominal one, so that a
    sum of weighted poses stays defined.

    Args:
        key: random key.
        q: the approximation.
        prior: ``p(z)``.
        likelihood: of the image.
        samples: drawn.
    """
    drawn = q.sample_with_log_prob(key, samples)
    of_image = jax.lax.map(likelihood.log_prob, drawn.poses, batch_size=RENDERED_TOGETHER)
    log_joint = of_image + prior.log_prob(drawn.poses)
    log_weight = log_joint - drawn.log_prob
    defined = jnp.isfinite(log_weight) & jnp.all(jnp.isfinite(drawn.poses), axis=(1, 2))
    poses = jnp.where(defined[:, None, None], drawn.poses, q.nominal)
    return Weighed(poses, *(jnp.where(defined, value, NO_WEIGHT) for value in (log_weight, log_joint)))


@partial(jax.jit, static_argnames="config")
def approach(
    key: PRNGKeyArray, q: PoseFlow, prior: Prior, likelihood: Likelihood, config: FitConfig = FitConfig()
) -> PoseFlow:
    """``q <- argmax_q' E_r[log q'],  r ~ q^(1 - g) [p(x | z) p(z)]^g``: ascend ``L`` in trust regions (eq. I65).

    ``r`` is the maximum of ``g L - (1 - g) KL(r || q)`` over all densities: a step of mirror ascent. Its exponent ``g``
    is the largest whose weights leave ``config.effective`` of the draws. A round in which no draw has a density changes
    nothing.

    Args:
        key: random key.
        q: to start from.
        prior: ``p(z)``.
        likelihood: of the image; its gradient is not used.
        config: effort.
    """
    half = config.rounds * config.fits // 2
    falling = optax.cosine_decay_schedule(config.fit_rate, max(half, 1), LAST_RATE)
    rate = optax.join_schedules([optax.constant_schedule(config.fit_rate), falling], [half])
    optimiser = optax.chain(optax.clip_by_global_norm(10.0), optax.adam(rate))

    def once(carry: tuple[PoseFlow, Any], key: PRNGKeyArray) -> tuple[tuple[PoseFlow, Any], None]:
        poses, log_weight, _ = weigh(key, carry[0], prior, likelihood, config.draws)
        weights = jax.nn.softmax(_exponent(log_weight, config.effective) * log_weight)
        cost = lambda q: -jnp.sum(weights * q.log_prob(poses))
        step = lambda carry, _: (_descended(carry, jax.grad(cost)(carry[0]), optimiser), None)
        fitted = jax.lax.scan(step, carry, None, length=config.fits)[0]
        return _chosen(jnp.any(log_weight > NO_WEIGHT), fitted, carry), None

    (q, _), _ = jax.lax.scan(once, (q, optimiser.init(q)), jax.random.split(key, config.rounds))
    return q


@partial(jax.jit, static_argnames="config")
def climb(
    key: PRNGKeyArray, q: Family, prior: Prior, likelihood: Likelihood, config: FitConfig = FitConfig()
) -> Family:
    """Ascend the annealed bound by Adam, with reparameterised draws (eq. I66).

    Args:
        key: random key.
        q: to start from: any family of trajectories of one step, whose states are poses.
        prior: ``p(z)``.
        likelihood: of the image.
        config: effort and annealing.
    """
    rate = optax.cosine_decay_schedule(config.rate, config.steps, LAST_RATE)
    optimiser = optax.chain(optax.clip_by_global_norm(CLIPPED), optax.adam(rate))

    def step(carry: tuple[Family, Any], now: tuple[Array, Array]) -> tuple[tuple[Family, Any], None]:
        key, progress = now
        heat = config.heat ** jnp.maximum(1.0 - progress / config.annealed, 0.0)
        cost = lambda q: -bound(key, q, prior, likelihood, config.samples, heat)
        return _descended(carry, jax.grad(cost)(carry[0]), optimiser), None

    now = (jax.random.split(key, config.steps), jnp.arange(config.steps) / config.steps)
    (q, _), _ = jax.lax.scan(step, (q, optimiser.init(q)), now)
    return q


@partial(jax.jit, static_argnames="samples")
def bound(
    key: PRNGKeyArray,
    q: TrajectoryBelief,
    prior: Prior,
    likelihood: Likelihood,
    samples: int,
    heat: float | Array = 1.0,
) -> Float[Array, ""]:
    """Estimate ``L`` without bias; differentiable in the parameters of ``q`` where the likelihood is.

    Args:
        key: of the draws.
        q: a family of trajectories of one step, whose states are poses.
        prior: ``p(z)``.
        likelihood: of the image.
        samples: drawn.
        heat: of the annealed bound, which has ``log p / heat`` with errors ``heat`` times as wide; 1 for ``L``.
    """
    drawn = q.draw(key, samples)
    poses = drawn.states[:, 0]
    images = jax.vmap(likelihood.widened(jnp.asarray(heat)).log_prob)(poses)
    return jnp.mean(images / heat + prior.log_prob(poses) + drawn.entropy[:, 0])


def effective_share(log_weight: Float[Array, "samples"]) -> Float[Array, ""]:
    """``(sum w)^2 / (n sum w^2)``: the share of draws that count after weighting, in (0, 1]."""
    return 1.0 / (len(log_weight) * jnp.sum(jax.nn.softmax(log_weight) ** 2))


def _exponent(log_weight: Array, least: float) -> Float[Array, ""]:
    """Return the largest exponent up to 1 of the weights that leaves a share of the draws; bisected by its log."""

    def halve(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = jnp.sqrt(low * high)
        enough = effective_share(middle * log_weight) >= least
        return jnp.where(enough, middle, low), jnp.where(enough, high, middle)

    low, _ = jax.lax.fori_loop(0, HALVINGS, halve, (jnp.float32(LEAST_EXPONENT), jnp.float32(1.0)))
    return jnp.where(effective_share(log_weight) >= least, 1.0, low)


def _descended(carry: tuple[Any, Any], gradient: Any, optimiser: optax.GradientTransformation) -> tuple[Any, Any]:
    """Make a step of the optimiser; none along a gradient that overflows at one of its draws."""
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(gradient)]))
    change, moments = optimiser.update(gradient, carry[1])
    return _chosen(finite, (optax.apply_updates(carry[0], change), moments), carry)


def _chosen(first: Array, a: Any, b: Any) -> Any:
    """Return ``a`` where ``first`` is true, else ``b``."""
    return jax.tree.map(lambda x, y: jnp.where(first, x, y), a, b)
