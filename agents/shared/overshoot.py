"""Notice images that show more motion than was commanded, step after step: their depth is too large.

    e_k = d_k^T xi_k / sqrt(d_k^T Q_k d_k),   S_k = max(0, S_k-1 + min(e_k, 3) - 0.5),   overshoot where  S_k > 9

``xi_k`` leads from where command ``k`` should have taken the robot to where the filter believes it is, ``d_k`` is the
direction of that command and ``Q_k`` the covariance of its noise, so that ``e_k`` is standard normal, and ``S_k`` its
cumulative sum (Page, Biometrika 1954). A robot that maps as it drives has no other witness of the scale of its depth:
its map has the same scale. Less motion than was commanded proves nothing, because an obstacle may hold the robot: steps
below -3 do not count.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vssm_gym.model.transition.base import Transition

LEAST_STEP = 0.01  # m: a shorter command says nothing of the scale
MOST_STDS = 3.0  # that one step may count for: a single shove is no false scale, and a collision none at all


@dataclass(frozen=True)
class OvershootConfig:
    """Configure how much evidence is asked for."""

    slack: float = 0.5  # stds of a step that are no evidence
    limit: float = 9.0  # of the sum: by chance once in 50,000 steps


class Overshoot:
    """Sum up how far the estimates go beyond the commands.

    Args:
        transition: of a robot whose controls are commands.
        dt: length of a step, s.
        config: evidence asked for.
    """

    def __init__(self, transition: Transition, dt: float, config: OvershootConfig) -> None:
        self._transition, self._dt, self._config = transition, dt, config
        self._sum = 0.0

    def reset(self) -> None:
        """Forget the steps: the estimate was found again at another place."""
        self._sum = 0.0

    def update(self, before: Any, command: np.ndarray, after: Any) -> bool:
        """Return True if the estimates have gone too far; ``before`` and ``after`` are the means around a command."""
        length, deviation = _deviation(
            self._transition, before, jnp.asarray(command, jnp.float32), after, jnp.float32(self._dt)
        )
        if length >= LEAST_STEP and deviation >= -MOST_STDS:
            self._sum = max(0.0, self._sum + min(float(deviation), MOST_STDS) - self._config.slack)
        return self._sum > self._config.limit


@jax.jit
def _deviation(
    transition: Transition, before: Any, control: jax.Array, after: Any, dt: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return the length of the commanded step, m, and how many standard deviations the estimate is beyond it."""
    manifold = transition.manifold
    predicted = transition.expected(before, control, dt)
    p = manifold.twists.shape[1]
    along = -jnp.where(manifold.turns[:p], 0.0, manifold.error(predicted, before)[:p])
    length = jnp.linalg.norm(along)
    along /= jnp.maximum(length, 1e-9)
    Q = transition.noise_covariance(before, control, dt)[:p, :p]
    beyond = along @ manifold.error(predicted, after)[:p]
    return length, beyond / jnp.sqrt(jnp.maximum(along @ Q @ along, 1e-12))
