"""Train a learned transition: several networks at once, each without another part of the data.

Adam on random windows whose length grows. Each network is judged, and its noise calibrated, on the part of the data
that it has not seen; together they have seen all of it, and the transition is all of them.
"""

import time
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from vssm_gym.errors import InputError
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.body_axes import body_axes
from vssm_gym.model.transition.learned import LearnedTransition, Scales, untrained
from vssm_gym.model.transition.manifold import RIGID
from vssm_gym.progress import OnProgress
from vssm_gym.training.dynamics.calibration import calibrate, calibrate_together
from vssm_gym.training.dynamics.inverse_emission import new_inverse_emission
from vssm_gym.training.dynamics.objective import ELBO_WEIGHT, Model, Predictions, elbo, predictions
from vssm_gym.training.dynamics.windows import Windows, evenly_spread, measure_scales

FIRST_LOG_STD = -5.0  # of measured poses: 7 mm and 7 mrad, as of motion capture
# Shares of the horizon and of the updates: short windows first, since the gradient of a long path through a bad model
# points nowhere
HORIZON_STAGES = ((0.1, 0.1), (0.3, 0.3), (1.0, 0.6))
LARGEST_GRADIENT = 1.0  # its norm; a longer one is shortened
EVIDENCE_STEPS = 20  # steps over which the evidence is taken, of a window
# Biases of an IMU change from flight to flight, more than they do within the one that is trained on
BIAS_STDS = (0.05, 0.005)  # m/s^2, rad/s
BIAS_SHARE = 0.02  # of the spread of a further control
JUDGED_EVERY = 50  # updates between two looks at the held-out windows
NETWORKS = 4  # networks: the more of them, the less data each misses, and the longer the training
HELD_WINDOWS = 32  # held-out windows of each network at most


@dataclass(frozen=True)
class FitConfig:
    """Configure a training.

    Attributes:
        updates: gradient steps.
        minutes: after which it ends even so.
        batch: windows a gradient step, of each network.
        members: networks, each trained without another part of the data.
        rate: of Adam at first; it falls to zero as a cosine.
        decay: of the weights, in units of the rate.
        seed: of weights and draws.
    """

    updates: int = 1200
    minutes: float = 9.0
    batch: int = 12
    members: int = NETWORKS
    rate: float = 2e-3
    decay: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.members < 2:
            raise InputError("FitConfig", "members", f"two networks or more, not {self.members}")


class Folds(NamedTuple):
    """Hold which windows each network is trained on, and which it has not seen.

    Attributes:
        data: all windows; their length is the longest horizon.
        seen: of each network, windows that it is trained on.
        held: of each network, windows that share no step with those.
    """

    data: Windows
    seen: Int[np.ndarray, "members n"]
    held: list[Int[np.ndarray, "_"]]


@dataclass(frozen=True)
class Fitted:
    """Hold what a training has found.

    Attributes:
        transition: all networks together, with calibrated noise.
        members: each network alone, likewise, in the order of the folds.
        updates: that were done.
        seconds: that they took, compilation included.
        interrupted: whether it was ended before its time.
        score: of the best, on windows that its networks have not seen, their mean: m.
        improved: whether any update was better there than the nominal step.
        gain: by which calibration multiplied the noise of each network.
        factor: by which it multiplied the spread of all of them together after that.
        noise: standard deviations of measured positions (m) and rotations (rad), as learned.
        history: a row each time the held-out windows were looked at.
    """

    transition: LearnedTransition
    members: list[LearnedTransition]
    updates: int
    seconds: float
    interrupted: bool
    score: float
    improved: bool
    gain: float
    factor: float
    noise: tuple[float, float]
    history: list[dict[str, float]]


def fit(
    nominal: Transition,
    folds: Folds,
    dt: float,
    config: FitConfig | None = None,
    on_progress: OnProgress | None = None,
) -> Fitted:
    """Train a correction of a nominal transition.

    Args:
        nominal: whose steps are corrected.
        folds: windows, and which of them each network learns from; their number is that of the networks.
        dt: length of a step, s.
        config: effort, rates and seed.
        on_progress: called with ("training", updates, total).
    """
    config, began = config or FitConfig(), time.monotonic()
    key, data = jax.random.key(config.seed), folds.data
    scales = measure_scales(nominal, data.take(folds.seen[0]), dt)
    models = [_new_model(jax.random.fold_in(key, k), nominal, scales, data) for k in range(len(folds.seen))]
    form, trained = models[0], jax.tree.map(lambda *a: jnp.stack(a), *map(_trained, models))
    seen = jnp.asarray(folds.seen)
    some = [held[evenly_spread(len(held), HELD_WINDOWS)] for held in folds.held]
    most = max(map(len, some))
    judged = data.take(np.stack([np.resize(held, most) for held in some]))
    stds = _bias_stds(nominal, scales)
    horizon = data.controls.shape[1]
    optimizer = optimizer_for(config)
    moments, history = jax.vmap(optimizer.init)(trained), list[dict[str, float]]()
    first = float(_judge(form, trained, judged, dt))
    best, score, done, interrupted = trained, first, 0, False
    try:
        for done in range(1, config.updates + 1):
            steps = max(2, round(_share(done / config.updates) * horizon))
            drawn = jax.random.fold_in(key, done)
            of = (form, trained, data, seen, drawn, dt, config.batch)
            bound, of_evidence = _evidence(*of, min(EVIDENCE_STEPS, horizon), stds)
            terms, of_prediction = _prediction(*of, steps, stds)
            trained, moments = _step(trained, of_evidence, of_prediction, moments, optimizer)
            if done % JUDGED_EVERY == 0 or done == config.updates:
                now = float(_judge(form, trained, judged, dt))
                row = {"updates": done, "held": now, "elbo": float(bound.mean())}
                history.append(row | {"score": float(terms.score.mean()), "path": float(terms.path.mean())})
                if now < score:
                    best, score = trained, now
            if on_progress and (done % 10 == 0 or done == config.updates):
                on_progress("training", done, config.updates)
            if time.monotonic() - began > 60.0 * config.minutes:
                break
    except KeyboardInterrupt:
        interrupted = True
    # Compiled updates return the plain numbers of the nominal step as arrays: those that were given are kept.
    members = [
        eqx.tree_at(lambda t: t.network, form.transition, jax.tree.map(lambda a, k=k: a[k], best[0]))
        for k in range(len(models))
    ]
    position, rotation = (float(std) for std in jnp.exp(best[2]).mean(axis=0))
    noise = (position, rotation)
    keys = jax.random.split(jax.random.fold_in(key, config.updates + 1), len(members))
    unseen = [data.take(held).with_biases(k, stds) for k, held in zip(keys, folds.held, strict=True)]
    members, gain = calibrate(members, unseen, dt, noise)
    of_seen = jax.random.fold_in(key, config.updates + 2)
    transition, factor = calibrate_together(members, data.with_biases(of_seen, stds), dt, noise)
    seconds = time.monotonic() - began
    return Fitted(transition, members, done, seconds, interrupted, score, score < first, gain, factor, noise, history)


def optimizer_for(config: FitConfig) -> optax.GradientTransformation:
    """Return Adam with decoupled weight decay, a rate that falls as a cosine, and bounded gradients.

    A gradient that is not finite changes nothing, however many there are.
    """
    rate = optax.cosine_decay_schedule(config.rate, config.updates)
    bounded = optax.chain(optax.clip_by_global_norm(LARGEST_GRADIENT), optax.adamw(rate, weight_decay=config.decay))
    return optax.apply_if_finite(bounded, max_consecutive_errors=config.updates)


def _bias_stds(nominal: Transition, scales: Scales) -> Float[Array, "m"]:
    """Return standard deviations of the biases that windows are trained with: those of an IMU; commands are exact."""
    spread = scales.spread[body_axes(nominal.manifold).features :]
    if nominal.manifold != RIGID:
        return jnp.zeros(len(spread))
    return (BIAS_SHARE * spread).at[:6].set(jnp.repeat(jnp.asarray(BIAS_STDS), 3))


def _new_model(key: PRNGKeyArray, nominal: Transition, scales: Scales, data: Windows) -> Model:
    by_network, by_inverse = jax.random.split(key)
    transition = untrained(by_network, nominal, scales, further=data.controls.shape[-1] - nominal.controls)
    return Model(transition, new_inverse_emission(by_inverse, transition), jnp.full(2, FIRST_LOG_STD))


def _trained(model: Model) -> Any:
    """Return what Adam changes: not the nominal transition, and not the units."""
    return model.transition.network, eqx.filter(model.inverse, eqx.is_inexact_array), model.log_stds


@partial(jax.jit, static_argnames=("batch", "steps"))
def _evidence(
    form: Model, trained: Any, data: Windows, seen: Array, key: PRNGKeyArray, dt: float, batch: int, steps: int,
    bias_stds: Array,
) -> tuple[Array, Any]:  # fmt: skip
    """Return the ELBO of each network on the beginnings of some windows, and the gradient of its negative."""

    def of_one(trained: Any, seen: Array, key: PRNGKeyArray) -> tuple[Array, Any]:
        some = _beginnings(data, seen, key, batch, steps, bias_stds)
        loss = lambda trained: -ELBO_WEIGHT * elbo(_placed(form, trained), some, jax.random.fold_in(key, 1), dt)
        value, gradient = jax.value_and_grad(loss)(trained)
        return -value / ELBO_WEIGHT, gradient

    return jax.vmap(of_one)(trained, seen, jax.random.split(key, len(seen)))


@partial(jax.jit, static_argnames=("batch", "steps"))
def _prediction(
    form: Model, trained: Any, data: Windows, seen: Array, key: PRNGKeyArray, dt: float, batch: int, steps: int,
    bias_stds: Array,
) -> tuple[Predictions, Any]:  # fmt: skip
    """Return score and distance of each network on the beginnings of some windows, and the gradient of their sum."""

    def of_one(network: Any, seen: Array, key: PRNGKeyArray) -> tuple[Predictions, Any]:
        some = _beginnings(data, seen, key, batch, steps, bias_stds)

        def loss(network: Any) -> tuple[Array, Predictions]:
            transition = eqx.tree_at(lambda t: t.network, form.transition, network)
            terms = predictions(transition, some, jax.random.fold_in(key, 1), dt)
            return terms.score + terms.path, terms

        (_, terms), gradient = jax.value_and_grad(loss, has_aux=True)(network)
        return terms, gradient

    return jax.vmap(of_one)(trained[0], seen, jax.random.split(key, len(seen)))


@partial(jax.jit, static_argnames="optimizer")
def _step(
    trained: Any, of_evidence: Any, of_prediction: Any, moments: Any, optimizer: optax.GradientTransformation
) -> tuple[Any, Any]:
    """Take one step of each network along the sum of both gradients."""
    gradient = (jax.tree.map(jnp.add, of_evidence[0], of_prediction), *of_evidence[1:])
    steps, moments = jax.vmap(optimizer.update)(gradient, moments, trained)
    return optax.apply_updates(trained, steps), moments


def _beginnings(data: Windows, seen: Array, key: PRNGKeyArray, batch: int, steps: int, stds: Array) -> Windows:
    """Return the first steps of some of the windows that are seen, the controls of each with a bias of its own."""
    by_window, by_bias = jax.random.split(key)
    some = data.take(jax.random.choice(by_window, seen, (batch,)))
    first = Windows(jax.tree.map(lambda a: a[:, : steps + 1], some.states), some.controls[:, :steps])
    return first.with_biases(by_bias, stds)


def _placed(form: Model, trained: Any) -> Model:
    network, inverse, log_stds = trained
    transition = eqx.tree_at(lambda t: t.network, form.transition, network)
    return Model(transition, eqx.combine(inverse, form.inverse), log_stds)


@jax.jit
def _judge(form: Model, trained: Any, held: Windows, dt: float) -> Float[Array, ""]:
    """Return score and distance on windows that each network has not seen, with the same draws each time: the mean."""

    def of_one(network: Any, held: Windows) -> Array:
        transition = eqx.tree_at(lambda t: t.network, form.transition, network)
        terms = predictions(transition, held, jax.random.key(0), dt)
        return terms.score + terms.path

    return jnp.mean(jax.vmap(of_one)(trained[0], held))


def _share(progress: float) -> float:
    """Return the share of the horizon at a share of the updates."""
    until = 0.0
    for horizon, updates in HORIZON_STAGES:
        until += updates
        if progress <= until:
            return horizon
    return 1.0
