"""Train a learned transition: Adam on random windows whose length grows, the best on held-out windows kept."""

import time
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.body_axes import body_axes
from vssm_gym.model.transition.learned import LearnedTransition, Scales, untrained
from vssm_gym.model.transition.manifold import RIGID
from vssm_gym.progress import OnProgress
from vssm_gym.training.dynamics.evaluation import coverage
from vssm_gym.training.dynamics.inverse_emission import new_inverse_emission
from vssm_gym.training.dynamics.objective import ELBO_WEIGHT, Model, elbo, predictions
from vssm_gym.training.dynamics.windows import Windows, measure_scales

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
HELD_WINDOWS = 64  # held-out windows at most
GAINS = np.geomspace(0.25, 8.0, 32)  # of the noise, among which calibration chooses
CALIBRATED_ON = 64  # held-out windows at most, each of which takes a tenth of a second for every gain
HELD_SHARE = 0.95  # share of held-out states that the envelopes of 95 % should hold


@dataclass(frozen=True)
class FitConfig:
    """Configure a training.

    Attributes:
        updates: gradient steps.
        minutes: after which it ends even so.
        batch: windows a gradient step.
        rate: of Adam at first; it falls to zero as a cosine.
        decay: of the weights, in units of the rate.
        seed: of weights and draws.
    """

    updates: int = 1500
    minutes: float = 9.0
    batch: int = 24
    rate: float = 2e-3
    decay: float = 0.0
    seed: int = 0


@dataclass(frozen=True)
class Fitted:
    """Hold what a training has found.

    Attributes:
        transition: the best one on the held-out windows, its noise calibrated there.
        updates: that were done.
        seconds: that they took, compilation included.
        interrupted: whether it was ended before its time.
        score: of the best, on the held-out windows: m.
        improved: whether any update was better there than the nominal step.
        gain: by which calibration multiplied the noise.
        noise: standard deviations of measured positions (m) and rotations (rad), as learned.
        history: a row each time the held-out windows were looked at.
    """

    transition: LearnedTransition
    updates: int
    seconds: float
    interrupted: bool
    score: float
    improved: bool
    gain: float
    noise: tuple[float, float]
    history: list[dict[str, float]]


def fit(
    nominal: Transition,
    data: Windows,
    held: Windows,
    dt: float,
    config: FitConfig | None = None,
    on_progress: OnProgress | None = None,
) -> Fitted:
    """Train a correction of a nominal transition.

    Args:
        nominal: whose steps are corrected.
        data: windows to learn from; their length is the longest horizon.
        held: windows of the same length from other parts, on which the best is chosen and its noise calibrated.
        dt: length of a step, s.
        config: effort, rates and seed.
        on_progress: called with ("training", updates, total).
    """
    config, began = config or FitConfig(), time.monotonic()
    key = jax.random.key(config.seed)
    model = _new_model(key, nominal, data, dt)
    held = held.take(_spread(len(held), HELD_WINDOWS))
    stds = _bias_stds(nominal, model.transition.scales)
    horizon = data.controls.shape[1]
    untrained_transition = model.transition
    optimizer = optimizer_for(config)
    moments, history = optimizer.init(_trained(model)), list[dict[str, float]]()
    first = float(_judge(model.transition, held, dt))
    best, score, done, interrupted = model.transition, first, 0, False
    try:
        for done in range(1, config.updates + 1):
            steps = max(2, round(_share(done / config.updates) * horizon))
            drawn = jax.random.fold_in(key, done)
            bound, of_evidence = _evidence(model, data, drawn, dt, config.batch, min(EVIDENCE_STEPS, horizon), stds)
            terms, of_prediction = _prediction(model.transition, data, drawn, dt, config.batch, steps, stds)
            model, moments = _step(model, of_evidence, of_prediction, moments, optimizer)
            if done % JUDGED_EVERY == 0 or done == config.updates:
                now = float(_judge(model.transition, held, dt))
                row = {"updates": done, "held": now, "elbo": float(bound)}
                history.append(row | {"score": float(terms.score), "path": float(terms.path)})
                if now < score:
                    best, score = model.transition, now
            if on_progress and (done % 10 == 0 or done == config.updates):
                on_progress("training", done, config.updates)
            if time.monotonic() - began > 60.0 * config.minutes:
                break
    except KeyboardInterrupt:
        interrupted = True
    # Compiled updates return the plain numbers of the nominal step as arrays: those that were given are kept.
    best = eqx.tree_at(lambda t: t.network, untrained_transition, best.network)
    position, rotation = (float(std) for std in jnp.exp(model.log_stds))
    best, gain = calibrate(best, held, dt, (position, rotation))
    seconds = time.monotonic() - began
    return Fitted(best, done, seconds, interrupted, score, score < first, gain, (position, rotation), history)


def optimizer_for(config: FitConfig) -> optax.GradientTransformation:
    """Return Adam with decoupled weight decay, a rate that falls as a cosine, and bounded gradients.

    A gradient that is not finite changes nothing, however many there are.
    """
    rate = optax.cosine_decay_schedule(config.rate, config.updates)
    bounded = optax.chain(optax.clip_by_global_norm(LARGEST_GRADIENT), optax.adamw(rate, weight_decay=config.decay))
    return optax.apply_if_finite(bounded, max_consecutive_errors=config.updates)


def calibrate(
    transition: LearnedTransition, held: Windows, dt: float, noise: tuple[float, float]
) -> tuple[LearnedTransition, float]:
    """Multiply the noise by the gain with which envelopes hold the share of held-out states that they should.

    A network that has seen its windows many times is surer of them than of others. The share is that of all steps of
    all windows; it is a mean over the coordinates of position, and of pose.

    Args:
        transition: after training.
        held: windows that it was not trained on.
        dt: length of a step, s.
        noise: standard deviations of measured positions (m) and rotations (rad).
    """
    some = held.take(_spread(len(held), CALIBRATED_ON))
    low, high = 0, len(GAINS) - 1  # coverage grows with the gain: bisection
    while low < high:
        middle = (low + high) // 2
        louder = with_gain(transition, GAINS[middle])
        share = coverage(louder, some, dt, noise).mean()
        low, high = (middle + 1, high) if share < HELD_SHARE else (low, middle)
    return with_gain(transition, GAINS[low]), float(GAINS[low])


def with_gain(transition: LearnedTransition, gain: float) -> LearnedTransition:
    """Return the transition with all standard deviations multiplied, those of the rest included."""
    spread = len(transition.nominal.manifold.turns) + transition.size
    offset = transition.network.offset.at[spread:].add(jnp.log(gain))
    return eqx.tree_at(lambda t: t.network.offset, transition, offset)


def _bias_stds(nominal: Transition, scales: Scales) -> Float[Array, "m"]:
    """Return standard deviations of the biases that windows are trained with: those of an IMU; commands are exact."""
    spread = scales.spread[body_axes(nominal.manifold).features :]
    if nominal.manifold != RIGID:
        return jnp.zeros(len(spread))
    return (BIAS_SHARE * spread).at[:6].set(jnp.repeat(jnp.asarray(BIAS_STDS), 3))


def _new_model(key: PRNGKeyArray, nominal: Transition, data: Windows, dt: float) -> Model:
    by_network, by_inverse = jax.random.split(key)
    further = data.controls.shape[-1] - nominal.controls
    transition = untrained(by_network, nominal, measure_scales(nominal, data, dt), further=further)
    return Model(transition, new_inverse_emission(by_inverse, transition), jnp.full(2, FIRST_LOG_STD))


def _trained(model: Model) -> Any:
    """Return what Adam changes: not the nominal transition, and not the units."""
    return model.transition.network, eqx.filter(model.inverse, eqx.is_inexact_array), model.log_stds


@partial(jax.jit, static_argnames=("batch", "steps"))
def _evidence(
    model: Model, data: Windows, key: PRNGKeyArray, dt: float, batch: int, steps: int, bias_stds: Array
) -> tuple[Array, Any]:
    """Return the ELBO on the beginnings of some windows, and the gradient of its negative."""
    some = _beginnings(data, key, batch, steps, bias_stds)
    loss = lambda trained: -ELBO_WEIGHT * elbo(_placed(model, trained), some, jax.random.fold_in(key, 1), dt)
    value, gradient = jax.value_and_grad(loss)(_trained(model))
    return -value / ELBO_WEIGHT, gradient


@partial(jax.jit, static_argnames=("batch", "steps"))
def _prediction(
    transition: LearnedTransition, data: Windows, key: PRNGKeyArray, dt: float, batch: int, steps: int, bias_stds: Array
) -> tuple[Any, Any]:
    """Return score and distance on the beginnings of some windows, and the gradient of their sum."""
    some = _beginnings(data, key, batch, steps, bias_stds)

    def loss(network: Any) -> tuple[Array, Any]:
        terms = predictions(eqx.tree_at(lambda t: t.network, transition, network), some, jax.random.fold_in(key, 1), dt)
        return terms.score + terms.path, terms

    (_, terms), gradient = jax.value_and_grad(loss, has_aux=True)(transition.network)
    return terms, gradient


@partial(jax.jit, static_argnames="optimizer")
def _step(
    model: Model, of_evidence: Any, of_prediction: Any, moments: Any, optimizer: optax.GradientTransformation
) -> tuple[Model, Any]:
    """Take one step along the sum of both gradients."""
    network = jax.tree.map(jnp.add, of_evidence[0], of_prediction)
    before = _trained(model)
    steps, moments = optimizer.update((network, *of_evidence[1:]), moments, before)
    return _placed(model, optax.apply_updates(before, steps)), moments


def _beginnings(data: Windows, key: PRNGKeyArray, batch: int, steps: int, stds: Array) -> Windows:
    """Return the first steps of some windows, the controls of each with a bias of its own."""
    by_window, by_bias = jax.random.split(key)
    some = data.take(jax.random.randint(by_window, (batch,), 0, len(data)))
    bias = jax.random.normal(by_bias, (batch, 1, stds.shape[0])) * stds
    return Windows(jax.tree.map(lambda a: a[:, : steps + 1], some.states), some.controls[:, :steps] + bias)


def _placed(model: Model, trained: Any) -> Model:
    network, inverse, log_stds = trained
    transition = eqx.tree_at(lambda t: t.network, model.transition, network)
    return Model(transition, eqx.combine(inverse, model.inverse), log_stds)


@jax.jit
def _judge(transition: LearnedTransition, held: Windows, dt: float) -> Float[Array, ""]:
    """Return score and distance on held-out windows, with the same draws each time."""
    terms = predictions(transition, held, jax.random.key(0), dt)
    return terms.score + terms.path


def _share(progress: float) -> float:
    """Return the share of the horizon at a share of the updates."""
    until = 0.0
    for horizon, updates in HORIZON_STAGES:
        until += updates
        if progress <= until:
            return horizon
    return 1.0


def _spread(count: int, most: int) -> np.ndarray:
    """Return at most ``most`` of ``count`` indices, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))
