"""Define motion along a line, linear and Gaussian, so that dense systems in float64 know all of it."""

from dataclasses import dataclass
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import GaussianBelief


@dataclass(frozen=True)
class Line:
    """Describe R^2: place along the world's x axis (m) and velocity (m/s)."""

    twists: ClassVar[np.ndarray] = np.eye(6)[:, :1]
    turns: ClassVar[np.ndarray] = np.array([False, False])

    def perturb(self, state: Any, xi: Any) -> Any:
        """Add."""
        return state + xi

    def error(self, mean: Any, state: Any) -> Any:
        """Subtract."""
        return state - mean

    def log_volume(self, xi: Any) -> Any:
        """Return zero."""
        return jnp.zeros(xi.shape[:-1])

    def pose(self, state: Any) -> Any:
        """Return a pose on the line."""
        still = jnp.broadcast_to(jnp.eye(4), (*state.shape[:-1], 4, 4))
        return still.at[..., 0, 3].set(state[..., 0])

    def resting(self, T_world_body: Any) -> Any:
        """Return the place without velocity."""
        return jnp.array([T_world_body[0, 3], 0.0])


LINE = Line()


class LineMotion(Transition):
    """``x' = x + v dt``, ``v' = v + u dt``, each with Gaussian noise.

    Attributes:
        std: of place and velocity after a step.
        information: of a reading of the place after each step, all of them 0: ``exp(-information x^2 / 2)`` multiplies
            the density.
    """

    std: tuple[float, float] = (0.1, 0.2)
    information: float = 0.0

    manifold = LINE
    controls = 1
    commanded = True

    def mean(self, state: Any, control: Any, dt: Any) -> Any:
        """Integrate."""
        return state @ step_matrix(dt).T + jnp.concatenate([jnp.zeros_like(control), control * dt], axis=-1)

    def noise_covariance(self, state: Any, control: Any, dt: Any) -> Any:
        """Return a diagonal matrix."""
        return jnp.diag(jnp.asarray(self.std) ** 2)

    def log_prob(self, following: Any, state: Any, control: Any, dt: Any) -> Any:
        """Add the logarithm of the reading's factor."""
        return super().log_prob(following, state, control, dt) - 0.5 * self.information * following[..., 0] ** 2


def step_matrix(dt: Any) -> Any:
    """Return ``F``, by which a step of ``dt`` seconds carries errors on."""
    return jnp.array([[1.0, dt], [0.0, 1.0]])


def dense_path(
    transition: LineMotion, start: GaussianBelief, controls: np.ndarray, dt: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance of ``p(z_1:T | u)``, all steps in one vector, without readings."""
    time = len(controls) + 1
    mean = np.zeros(2 * time)
    root = np.zeros((2 * time, 2 * time))  # of every independent error to every state
    mean[:2], root[:2, :2] = np.asarray(start.mean), np.linalg.cholesky(np.asarray(start.covariance, float))
    for t in range(1, time):
        F, now, before = np.array([[1.0, dt[t - 1]], [0.0, 1.0]]), slice(2 * t, 2 * t + 2), slice(2 * t - 2, 2 * t)
        mean[now] = F @ mean[before] + [0.0, controls[t - 1, 0] * dt[t - 1]]
        root[now] = F @ root[before]
        root[now, now] += np.diag(transition.std)
    return mean, root @ root.T
