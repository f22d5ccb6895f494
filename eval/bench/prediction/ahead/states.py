"""Predict the states of every window by a transition: errors, envelopes and densities at every step."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from vssm_gym.eval.bench.prediction.ahead.judged import STEPS_AHEAD, Judged
from vssm_gym.eval.bench.prediction.models import IMAGE_SAMPLES
from vssm_gym.model.predictive import Envelope, inside
from vssm_gym.model.transition.belief import normal_log_prob
from vssm_gym.model.transition.learned import LearnedTransition
from vssm_gym.model.transition.manifold import Manifold
from vssm_gym.training.dynamics.evaluation import futures, path_errors, pose_envelopes

FUTURES = 256  # paths that are drawn from each start: the covariance of a pose has 21 numbers
DRAWN = (0.25, 0.75)  # places among the windows of those whose paths a picture shows


@dataclass(frozen=True)
class Path:
    """Hold the predicted places of one window, m, in the world.

    Attributes:
        window: number of the window.
        samples: of the futures at every step, as measured.
        mean: their mean.
        truth: measured ones, that of the start first.
    """

    window: int
    samples: Float[np.ndarray, "paths time 3"]
    mean: Float[np.ndarray, "time 3"]
    truth: Float[np.ndarray, "time+1 3"]


@dataclass(frozen=True)
class Foreseen:
    """Hold what a transition predicts of all windows.

    Attributes:
        position: m, root mean square over the windows of the error of the path without noise, at every step.
        rotation: rad, likewise.
        held: whether the envelope of 95 % of the position, and of the pose, holds what was measured.
        log_prob: nats, log density of the measured pose at every step.
        states: the first futures of each window after ``STEPS_AHEAD``, axes ``(windows, samples, steps, ...)``; without
            the noise of measured poses: a camera is where it is.
        paths: those of a few windows.
    """

    position: Float[np.ndarray, "time"]
    rotation: Float[np.ndarray, "time"]
    held: Bool[np.ndarray, "windows 2 time"]
    log_prob: Float[np.ndarray, "windows time"]
    states: Any
    paths: tuple[Path, ...]


@eqx.filter_jit
def _window(
    transition: LearnedTransition,
    states: Any,
    controls: Array,
    noise: tuple[float, float],
    key: PRNGKeyArray,
    dt: float,
) -> tuple[Array, Array, Any, Array]:
    """Return coverage, density, the futures that images are taken from, and all places of one window."""
    manifold = transition.nominal.manifold
    start, after = (jax.tree.map(lambda a: a[part], states) for part in (0, slice(1, None)))
    drawn, measured = futures(transition, start, controls, noise, key, dt, FUTURES)
    regions = pose_envelopes(manifold, measured)
    held = jnp.stack([inside(manifold, region, after) for region in regions])
    at = jnp.asarray(STEPS_AHEAD) - 1
    seen_from = jax.tree.map(lambda a: a[:IMAGE_SAMPLES, at], drawn)
    return held, pose_log_prob(manifold, regions[1], after), seen_from, manifold.pose(measured)[..., :3, 3]


def pose_log_prob(manifold: Manifold, region: Envelope, states: Any) -> Float[Array, "*batch time"]:
    """Return the log density of poses under a Gaussian in the tangent at the mean of the futures, nats (eq. M16).

    Args:
        manifold: of the states.
        region: mean and covariance of the pose at every step.
        states: leading axes ``(..., time)``.
    """
    xi = manifold.error(region.mean, states)
    p = region.covariance.shape[-1]
    # In units of each coordinate's spread: metres beside milliradians are too much for a float32 factorisation
    stds = jnp.sqrt(jnp.diagonal(region.covariance, axis1=-2, axis2=-1))
    correlation = region.covariance / (stds[..., :, None] * stds[..., None, :])
    log_p = normal_log_prob(xi[..., :p] / stds, correlation) - jnp.sum(jnp.log(stds), axis=-1)
    return log_p - manifold.log_volume(xi)


def foresee(
    transition: LearnedTransition,
    judged: Judged,
    noise: tuple[float, float],
    seed: int,
    on_window: Callable[[], None] | None = None,
) -> Foreseen:
    """Predict every window from its measured first state and its controls.

    Args:
        transition: that predicts.
        judged: the windows.
        noise: standard deviations of measured positions (m) and rotations (rad).
        seed: of the samples: equal ones for all transitions.
        on_window: called after each window.
    """
    data, key = judged.data, jax.random.key(seed)
    errors = path_errors(transition, data, judged.dt)
    shown = {round(share * (len(data) - 1)) for share in DRAWN}
    held, log_prob, states, paths = [], [], [], []
    for k in range(len(data)):
        of_one = jax.tree.map(lambda a, k=k: a[k], data.states)
        drawn = jax.random.fold_in(key, k)
        found = _window(transition, of_one, data.controls[k], noise, drawn, judged.dt)
        held.append(np.asarray(found[0]))
        log_prob.append(np.asarray(found[1], float))
        states.append(jax.tree.map(np.asarray, found[2]))
        if k in shown:
            samples = np.asarray(found[3], float)
            truth = np.asarray(transition.nominal.manifold.pose(of_one), float)[:, :3, 3]
            paths.append(Path(k, samples, samples.mean(axis=0), truth))
        if on_window:
            on_window()
    stacked = jax.tree.map(lambda *a: np.stack(a), *states)
    return Foreseen(errors.position, errors.rotation, np.stack(held), np.stack(log_prob), stacked, tuple(paths))
