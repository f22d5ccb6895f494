"""Evaluate open-loop predictions: errors after many steps, coverage of envelopes, likelihood of single steps."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.geometry.transforms import inverse, se3_log
from vssm_gym.model.predictive import Envelope, envelope, inside
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import GaussianBelief
from vssm_gym.model.transition.learned import LearnedTransition
from vssm_gym.model.transition.manifold import Manifold
from vssm_gym.training.dynamics.baselines import predict
from vssm_gym.training.dynamics.windows import SMALLEST_ERROR, Windows

ENVELOPE = 0.95  # share of futures that an envelope should hold
PATHS = 128  # that are drawn from each start
WINDOWS_AT_ONCE = 64  # windows that are predicted at once: parts of all lengths share one compiled program


@dataclass(frozen=True)
class PathErrors:
    """Hold errors of paths without noise at every step, over the windows.

    Attributes:
        position: m, root of the mean square.
        rotation: rad, likewise.
    """

    position: Float[np.ndarray, "time"]
    rotation: Float[np.ndarray, "time"]


def with_rest(transition: Transition, states: Any) -> Any:
    """Return measured states as states of the transition: with the rest at zero where it has one."""
    return transition.start(states) if isinstance(transition, LearnedTransition) else states


@eqx.filter_jit
def _off(transition: Transition, data: Windows, dt: float) -> Any:
    start = with_rest(transition, jax.tree.map(lambda a: a[:, 0], data.states))
    path = predict(transition, start, data.controls, dt)
    after = jax.tree.map(lambda a: a[:, 1:], data.states)
    body = path.body if isinstance(transition, LearnedTransition) else path
    manifold = transition.nominal.manifold if isinstance(transition, LearnedTransition) else transition.manifold
    T_predicted, T_true = manifold.pose(body), manifold.pose(after)
    off = T_predicted[..., :3, 3] - T_true[..., :3, 3]
    turned = se3_log(inverse(T_true) @ T_predicted)[..., 3:]
    return jnp.sum(off**2, axis=-1), jnp.sum(turned**2, axis=-1)


def path_errors(transition: Transition, data: Windows, dt: float) -> PathErrors:
    """Measure how far predictions without noise are from what happened, from the measured first states.

    Args:
        transition: that predicts.
        data: windows of one length.
        dt: length of a step, s.
    """
    position2, rotation2 = _in_batches(lambda some: _off(transition, some, dt), data)
    return PathErrors(np.sqrt(position2.mean(axis=0)), np.sqrt(rotation2.mean(axis=0)))


@eqx.filter_jit
def futures(
    transition: LearnedTransition,
    start: Any,
    controls: Float[Array, "time m"],
    noise: tuple[float, float],
    key: PRNGKeyArray,
    dt: float,
    paths: int = PATHS,
) -> tuple[Any, Any]:
    """Draw futures of the body from a measured state, and what would be measured of them.

    Args:
        transition: that predicts, with a rest drawn from its prior.
        start: one measured state of the nominal transition.
        controls: of every step.
        noise: standard deviations of measured positions (m) and rotations (rad): of the start, and of each later pose.
        key: random key.
        dt: length of a step, s.
        paths: number of futures.

    Returns:
        States of the nominal transition after each control, and the same as measured; axes ``(paths, time, ...)``.
    """
    manifold = transition.nominal.manifold
    n, p = len(manifold.turns), manifold.twists.shape[1]
    stds = jnp.zeros(n).at[:p].set(jnp.where(manifold.turns[:p], noise[1], noise[0]))
    by_start, by_path, by_pose = jax.random.split(key, 3)
    states = transition.extend(GaussianBelief(start, jnp.diag(stds**2), manifold)).sample(by_start, paths)
    drawn = transition.sample_paths(by_path, states, controls, dt).body
    return drawn, manifold.perturb(drawn, jax.random.normal(by_pose, (paths, len(controls), n)) * stds)


def pose_envelopes(manifold: Manifold, measured: Any) -> tuple[Envelope, Envelope]:
    """Return the envelopes of 95 % of measured futures at every step: of the position, and of the whole pose.

    Args:
        manifold: of the states.
        measured: of :func:`futures`, axes ``(paths, time, ...)``.
    """
    p = manifold.twists.shape[1]
    places = p - int(manifold.turns[:p].sum())
    return envelope(manifold, measured, ENVELOPE, places), envelope(manifold, measured, ENVELOPE, p)


@eqx.filter_jit
def _covered(
    transition: LearnedTransition, start: Any, controls: Any, after: Any, noise: Any, key: PRNGKeyArray, dt: float
) -> tuple[Array, Array]:
    manifold = transition.nominal.manifold
    _, measured = futures(transition, start, controls, noise, key, dt)
    position, pose = (inside(manifold, region, after) for region in pose_envelopes(manifold, measured))
    return position, pose


def coverage(
    transition: LearnedTransition, data: Windows, dt: float, noise: tuple[float, float] = (0.0, 0.0), seed: int = 0
) -> Float[np.ndarray, "2 time"]:
    """Measure the share of windows that the envelopes of 95 % of the futures hold, at every step.

    Args:
        transition: that predicts, from the measured first state and a rest drawn from its prior.
        data: windows of one length.
        dt: length of a step, s.
        noise: standard deviations of measured positions (m) and rotations (rad): of the start, and of what is compared.
        seed: of the samples.

    Returns:
        Of envelopes of the position, and of the whole pose.
    """
    held = []
    for k in range(len(data)):
        states = jax.tree.map(lambda a: a[k], data.states)
        start, after = (jax.tree.map(lambda a: a[part], states) for part in (0, slice(1, None)))
        key = jax.random.fold_in(jax.random.key(seed), k)
        held.append(np.asarray(_covered(transition, start, data.controls[k], after, noise, key, dt)))
    return np.mean(held, axis=0)


def _in_batches(measure: Callable[[Windows], Any], data: Windows) -> list[Float[np.ndarray, "windows ..."]]:
    """Return each array that a function gives for windows, float64, computed for some windows at a time."""
    found, n = [], len(data)
    for first in range(0, n, WINDOWS_AT_ONCE):
        some = data.take(
            np.minimum(np.arange(first, first + WINDOWS_AT_ONCE), n - 1)
        )  # the last one fills the last batch
        found.append([np.asarray(a, float) for a in measure(some)])
    return [np.concatenate(arrays)[:n] for arrays in zip(*found, strict=True)]


@eqx.filter_jit
def _step_errors(transition: Transition, data: Windows, dt: float, noise: tuple[float, float]) -> tuple[Any, Any]:
    """Return pose errors of single steps from every measured state, and their standard deviations (one: unknown)."""
    before, after = (jax.tree.map(lambda a: a[:, part], data.states) for part in (slice(0, -1), slice(1, None)))
    if isinstance(transition, LearnedTransition):
        step = transition.step(transition.start(before), data.controls, dt)
        p = transition.manifold.twists.shape[1]
        turns = transition.manifold.turns[:p]
        xi = transition.nominal.manifold.error(step.mean.body, after)[..., :p]
        measured = jnp.where(turns, noise[1], noise[0])  # of the start, and of the end
        return xi, jnp.sqrt(step.stds[..., :p] ** 2 + 2.0 * measured**2)
    p = transition.manifold.twists.shape[1]
    predicted = transition.mean(before, data.controls[..., : transition.controls], dt)
    xi = transition.manifold.error(predicted, after)[..., :p]
    return xi, jnp.ones_like(xi)


def step_likelihood(
    transition: Transition, trained_on: Windows, data: Windows, dt: float, noise: tuple[float, float] = (0.0, 0.0)
) -> float:
    """Measure the log-likelihood of the measured pose after one step from the measured state, nats, the mean.

    Args:
        transition: that predicts; noise that is not learned is measured on ``trained_on``.
        trained_on: windows.
        data: windows that are predicted.
        dt: length of a step, s.
        noise: standard deviations of measured positions (m) and rotations (rad), which learned noise does not hold.
    """
    errors = lambda some: _step_errors(transition, some, dt, noise)
    xi, stds = _in_batches(errors, data)
    if not isinstance(transition, LearnedTransition):
        known = _in_batches(errors, trained_on)[0]
        stds = np.broadcast_to(np.maximum(np.sqrt(np.mean(known**2, axis=(0, 1))), SMALLEST_ERROR), xi.shape)
    densities = -0.5 * (xi / stds) ** 2 - np.log(stds) - 0.5 * np.log(2.0 * np.pi)
    return float(densities.sum(axis=-1).mean())
