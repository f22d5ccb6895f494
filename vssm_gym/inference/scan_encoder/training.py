"""Train an encoder of scans against a frozen model: first on the model's own scans, then by the ELBO (eq. P48).

    1  min E_p(z) E_p(x | z, M) [-log q(z | x)]                              poses and scans are the model's own
    2  max E_x E_q(z | x) [log p(x | z, M) + log p(z) - log q(z | x)]        the variational autoencoder's

No true pose takes part: the prior is what the filter of the drive has estimated. The first objective covers every place
that looks alike, and begins where the second, which is blind to a mode that it does not hold, can improve.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.inference.scan_encoder.network import PoseMixture, ScanEncoder, new_encoder
from vssm_gym.inference.scan_encoder.prior import VisitedPlaces
from vssm_gym.model.scan_model import ScanModel

SCANS_AT_ONCE = 256  # scans that the model is asked for together
UPDATES_AT_ONCE = 50  # compiled updates between two batches of random numbers


@dataclass(frozen=True)
class EncoderConfig:
    """Configure network and training.

    Args:
        components: of the mixture.
        width: of the hidden layers.
        scans: drawn from the model.
        nearest: predicted range below which a pose is not one of the robot, m.
        updates: of the first objective.
        batch: of its scans.
        rate: of Adam; it falls to zero along a cosine.
        elbo_updates: of the second objective; it has not helped on occupancy maps.
        elbo_batch: of its scans; each is rendered at one pose of each component.
        elbo_rate: of Adam there.
    """

    components: int = 8
    width: int = 256
    scans: int = 32_768
    nearest: float = 0.0125
    updates: int = 6000
    batch: int = 256
    rate: float = 1e-3
    elbo_updates: int = 0
    elbo_batch: int = 16
    elbo_rate: float = 1e-4

    def __post_init__(self) -> None:
        for name in ("components", "width", "scans", "updates", "batch", "elbo_batch"):
            if getattr(self, name) < 1:
                raise InputError("EncoderConfig", name, f"at least 1, not {getattr(self, name)!r}")


def fit_encoder(
    model: ScanModel, prior: VisitedPlaces, config: EncoderConfig | None = None, seed: int = 0
) -> tuple[ScanEncoder, Float[np.ndarray, "updates"]]:
    """Return a trained encoder, and the ELBO of each update of the second objective, nats.

    Args:
        model: of the scans, which stays as it is.
        prior: over poses.
        config: of network and training.
        seed: of all randomness.

    Raises:
        InputError: a prior under which the robot is nowhere free.
    """
    c = config or EncoderConfig()
    by_pool, by_network, by_updates, by_elbo = jax.random.split(jax.random.key(seed), 4)
    scans, states = _pool(model, prior, by_pool, c)
    angles = np.asarray(model.scanner.angles)
    encoder = new_encoder(by_network, len(angles), float(model.scanner.max_range), prior, c.width, c.components)
    optimizer = optax.adam(optax.cosine_decay_schedule(c.rate, c.updates))
    moments = optimizer.init(encoder.layers)
    for key in jax.random.split(by_updates, -(-c.updates // UPDATES_AT_ONCE)):
        encoder, moments = _learn(encoder, moments, optimizer, scans, states, key, c.batch, _circle(angles))
    optimizer = optax.apply_if_finite(
        optax.chain(optax.clip_by_global_norm(1.0), optax.adam(c.elbo_rate)), max(1, c.elbo_updates)
    )
    moments, bounds = optimizer.init(encoder.layers), []
    for key in jax.random.split(by_elbo, c.elbo_updates) if c.elbo_updates else ():
        encoder, moments, bound = _raise(encoder, moments, optimizer, model, scans, key, c.elbo_batch)
        bounds.append(float(bound))
    return encoder, np.array(bounds)


def elbo(encoder: ScanEncoder, model: ScanModel, ranges: Float[Array, "beams"], key: PRNGKeyArray) -> Float[Array, ""]:
    """Return the evidence lower bound of one scan, nats: one pose of each component, weighed by its weight."""
    q = encoder(ranges)
    z = q.mean + q.std * jax.random.normal(key, q.mean.shape)
    z = jnp.concatenate([z[:, :2], wrap_angle(z[:, 2:])], axis=-1)
    gained = model.log_prob(ranges, z) + encoder.prior.log_prob(z) - q.log_prob(z)
    return jnp.sum(jnp.exp(q.log_weight) * gained)


def _pool(model: ScanModel, prior: VisitedPlaces, key: PRNGKeyArray, c: EncoderConfig) -> tuple[Array, Array]:
    """Return scans ``(n, beams)`` of the model, and their poses ``(n, 3)``."""
    kept: list[tuple[np.ndarray, np.ndarray]] = []
    found, tried = 0, 0
    while found < c.scans:
        if tried > 10 * c.scans + 10 * SCANS_AT_ONCE:
            raise InputError("fit_encoder", "prior", f"places with {c.nearest} m of predicted ranges; found {found}")
        key, one = jax.random.split(key)
        scans, states, free = jax.device_get(_drawn(model, prior, one, c.nearest))
        kept.append((scans[free], states[free]))
        found, tried = found + int(free.sum()), tried + len(free)
    return tuple(jnp.asarray(np.concatenate([part[k] for part in kept])[: c.scans]) for k in range(2))  # type: ignore[return-value]


@eqx.filter_jit
def _drawn(model: ScanModel, prior: VisitedPlaces, key: PRNGKeyArray, nearest: float) -> tuple[Array, Array, Array]:
    by_pose, by_scan = jax.random.split(key)
    states = prior.sample(by_pose, SCANS_AT_ONCE)
    scans = model.sample(by_scan, states)
    return scans, states, jnp.min(jnp.where(scans > 0.0, scans, jnp.inf), axis=-1) >= nearest


def _circle(angles: np.ndarray) -> bool:
    """Return True for beams evenly spread over a full circle: a turn by their spacing shifts the readings."""
    return bool(np.allclose(np.diff(angles), 2.0 * np.pi / len(angles), atol=1e-4))


@eqx.filter_jit
def _learn(
    encoder: ScanEncoder,
    moments: Any,
    optimizer: optax.GradientTransformation,
    scans: Array,
    states: Array,
    key: PRNGKeyArray,
    batch: int,
    circle: bool,
) -> tuple[ScanEncoder, Any]:
    """Take several steps of the first objective; scans are turned by whole beams where that is exact."""
    beams = scans.shape[-1]

    def loss(layers: Any, x: Array, z: Array) -> Array:
        q = jax.vmap(eqx.tree_at(lambda e: e.layers, encoder, layers))(x)
        return -jnp.mean(jax.vmap(PoseMixture.log_prob)(q, z))

    def update(carry: tuple[Any, Any], key: PRNGKeyArray) -> tuple[tuple[Any, Any], None]:
        layers, moments = carry
        by_choice, by_turn = jax.random.split(key)
        chosen = jax.random.randint(by_choice, (batch,), 0, len(scans))
        x, z = scans[chosen], states[chosen]
        if circle:
            k = jax.random.randint(by_turn, (batch,), 0, beams)
            x = jax.vmap(partial(jnp.roll, axis=0))(x, -k)  # the robot turned left by k beams
            z = z.at[:, 2].set(wrap_angle(z[:, 2] + 2.0 * jnp.pi * k / beams))
        steps, moments = optimizer.update(jax.grad(loss)(layers, x, z), moments)
        return (optax.apply_updates(layers, steps), moments), None

    keys = jax.random.split(key, UPDATES_AT_ONCE)
    (layers, moments), _ = jax.lax.scan(update, (encoder.layers, moments), keys)
    return eqx.tree_at(lambda e: e.layers, encoder, layers), moments


@eqx.filter_jit
def _raise(
    encoder: ScanEncoder,
    moments: Any,
    optimizer: optax.GradientTransformation,
    model: ScanModel,
    scans: Array,
    key: PRNGKeyArray,
    batch: int,
) -> tuple[ScanEncoder, Any, Array]:
    """Take one step of the second objective; return the ELBO before it."""
    by_choice, by_pose = jax.random.split(key)
    x = scans[jax.random.randint(by_choice, (batch,), 0, len(scans))]

    def loss(layers: Any) -> Array:
        new = eqx.tree_at(lambda e: e.layers, encoder, layers)
        return -jnp.mean(jax.vmap(lambda r, k: elbo(new, model, r, k))(x, jax.random.split(by_pose, batch)))

    value, gradient = jax.value_and_grad(loss)(encoder.layers)
    steps, moments = optimizer.update(gradient, moments, encoder.layers)
    return eqx.tree_at(lambda e: e.layers, encoder, optax.apply_updates(encoder.layers, steps)), moments, -value
