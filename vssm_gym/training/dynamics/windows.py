"""Cut steps into windows, and measure the units in which a network sees them."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from vssm_gym.data.dynamics.log import Steps
from vssm_gym.geometry.transforms import matrix_to_planar
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.body_axes import body_axes
from vssm_gym.model.transition.learned import Scales
from vssm_gym.model.transition.manifold import RIGID, Manifold, RigidState

SMALLEST_SPREAD = 1e-3  # of an input that does not vary, such as the force of a rotor that is not there
SMALLEST_ERROR = 1e-3  # m, rad, m/s, rad/s: of a nominal step


class Windows(eqx.Module):
    """Hold windows of equal length.

    Attributes:
        states: measured states of the nominal transition, leading axes ``(batch, time + 1)``.
        controls: ``controls[:, k]`` leads from state ``k`` to ``k + 1``.
    """

    states: Any
    controls: Float[Array, "batch time m"]

    def __len__(self) -> int:
        """Return the number of windows."""
        return self.controls.shape[0]

    def take(self, chosen: Any) -> "Windows":
        """Return some of the windows."""
        return jax.tree.map(lambda a: a[chosen], self)

    def with_biases(self, key: PRNGKeyArray, stds: Float[Array, "m"]) -> "Windows":
        """Return the windows with a bias of its own added to the controls of each, ``N(0, stds^2)``."""
        drawn = jax.random.normal(key, (*self.controls.shape[:-2], 1, self.controls.shape[-1]))
        return Windows(self.states, self.controls + drawn * stds)


def states_of(steps: Steps, manifold: Manifold) -> Any:
    """Return the measured states of all poses, leading axis time."""
    if manifold == RIGID:
        return RigidState(jnp.asarray(steps.T_world_body, jnp.float32), jnp.asarray(steps.velocity, jnp.float32))
    return jnp.asarray(matrix_to_planar(np.asarray(steps.T_world_body)), jnp.float32)


def windows(parts: list[Steps], manifold: Manifold, length: int, stride: int = 1) -> Windows:
    """Return every window of ``length`` steps that begins at each ``stride``-th step of the parts.

    Args:
        parts: that are not continued by each other.
        manifold: of the states.
        length: steps of a window.
        stride: steps between two beginnings.
    """
    cut = []
    for steps in parts:
        states = states_of(steps, manifold)
        starts = np.arange(0, len(steps) - length + 1, stride)
        at = starts[:, None] + np.arange(length + 1)
        controls = jnp.asarray(steps.controls[at[:, :-1]], jnp.float32)
        cut.append(Windows(jax.tree.map(lambda a: a[at], states), controls))
    return jax.tree.map(lambda *a: jnp.concatenate(a), *cut)


def evenly_spread(count: int, most: int) -> Int[np.ndarray, "chosen"]:
    """Return at most ``most`` of ``count`` indices, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def measure_scales(nominal: Transition, data: Windows, dt: float) -> Scales:
    """Measure mean and spread of the network's inputs, and the size of the nominal transition's errors of one step.

    Args:
        nominal: whose errors a network will correct.
        data: windows of measured states.
        dt: length of a step, s.
    """
    axes, manifold = body_axes(nominal.manifold), nominal.manifold
    before, after = (jax.tree.map(lambda a: a[:, part], data.states) for part in (slice(0, -1), slice(1, None)))
    seen = np.concatenate([axes.describe(before), data.controls], axis=-1).reshape(-1, _inputs(nominal, data))
    predicted = nominal.mean(before, data.controls[..., : nominal.controls], dt)
    xi = axes.from_errors(predicted, manifold.error(predicted, after))
    errors = np.sqrt(np.mean(np.square(xi), axis=(0, 1)))
    return Scales(
        jnp.asarray(seen.mean(axis=0)),
        jnp.asarray(np.maximum(seen.std(axis=0), SMALLEST_SPREAD)),
        jnp.asarray(np.maximum(errors, SMALLEST_ERROR)),
        jnp.asarray(dt, jnp.float32),
    )


def _inputs(nominal: Transition, data: Windows) -> int:
    return body_axes(nominal.manifold).features + data.controls.shape[-1]
