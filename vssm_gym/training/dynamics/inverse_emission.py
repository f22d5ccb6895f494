"""``q(z_t | z^_1:T, u_1:T-1)``: what all measured poses and controls say of a state, by a bidirectional LSTM (VSSM-LM).

The network reads each pose in the axes of its body: the motion to its neighbours, the vertical, the controls. It says
how far the state is from the measured one, in body axes, and how certain that is; so it knows neither place nor yaw.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.geometry.transforms import inverse, se3_log
from vssm_gym.model.transition.body_axes import body_axes
from vssm_gym.model.transition.learned import LearnedTransition, Scales
from vssm_gym.model.transition.with_rest import RestState
from vssm_gym.training.dynamics.windows import Windows

LSTM_CELLS = 64  # cells in each direction (VSSM-LM)
FIRST_STD = 0.5  # of the rest at first, below its prior's: the posterior tells windows apart


class Evidence(NamedTuple):
    """Hold a Gaussian for every state of a window, in body axes at ``centre``.

    Attributes:
        centre: states, leading axes ``(batch, time + 1)``.
        stds: of errors in body axes and of the rest.
    """

    centre: RestState
    stds: Float[Array, "batch times n"]


class InverseEmission(eqx.Module):
    """Read a window in both directions.

    Attributes:
        forward: cell that reads from the first pose on.
        backward: cell that reads from the last.
        leave: weights of the outputs, zero at first: the state is the measured one.
        offset: of the outputs.
    """

    forward: eqx.nn.LSTMCell
    backward: eqx.nn.LSTMCell
    leave: Float[Array, "hidden outputs"]
    offset: Float[Array, "outputs"]

    def __call__(self, transition: LearnedTransition, data: Windows, dt: float | Array) -> Evidence:
        """Return what the window says of each of its states.

        Args:
            transition: whose states these are.
            data: measured windows.
            dt: length of a step, s.
        """
        seen = jnp.swapaxes(_seen(transition, data, dt), 0, 1)  # time first
        both = jnp.concatenate([_read(self.forward, seen), _read(self.backward, seen[::-1])[::-1]], axis=-1)
        said = jnp.swapaxes(both @ self.leave + self.offset, 0, 1)
        n, r = len(transition.nominal.manifold.turns), transition.size
        units = transition.scales.errors
        rest = jnp.zeros((*said.shape[:2], r))
        e = jnp.concatenate([said[..., :n] * units, said[..., n : n + r]], axis=-1)
        stds = jnp.exp(jnp.clip(said[..., n + r :], -7.0, 3.0)) * jnp.concatenate([units, jnp.ones(r)])
        return Evidence(transition.perturb_in_body_axes(RestState(data.states, rest), e), stds)


def new_inverse_emission(key: PRNGKeyArray, transition: LearnedTransition) -> InverseEmission:
    """Draw cells that read; what they say is the measured state, at first."""
    by_forward, by_backward = jax.random.split(key)
    n, r = len(transition.nominal.manifold.turns), transition.size
    inputs = 6 + body_axes(transition.nominal.manifold).features + transition.controls
    forward, backward = (eqx.nn.LSTMCell(inputs, LSTM_CELLS, key=k) for k in (by_forward, by_backward))
    offset = jnp.zeros(2 * (n + r)).at[2 * n + r :].set(jnp.log(FIRST_STD))
    return InverseEmission(forward, backward, jnp.zeros((2 * LSTM_CELLS, 2 * (n + r))), offset)


def _seen(transition: LearnedTransition, data: Windows, dt: float | Array) -> Float[Array, "batch times inputs"]:
    """Return the inputs at every pose: the motion to the next one, the body's axes, the controls of the step."""
    manifold, scales = transition.nominal.manifold, transition.scales
    T = manifold.pose(data.states)
    twist = se3_log(inverse(T[:, :-1]) @ T[:, 1:]) / dt
    last = lambda a: jnp.concatenate([a, a[:, -1:]], axis=1)  # at the last pose, where no step begins
    features = jnp.concatenate([body_axes(manifold).describe(data.states), last(data.controls)], axis=-1)
    return jnp.concatenate([last(twist), _standard(scales, features)], axis=-1)


def _standard(scales: Scales, features: Array) -> Array:
    return jnp.clip((features - scales.centre) / scales.spread, -6.0, 6.0)


def _read(cell: eqx.nn.LSTMCell, seen: Float[Array, "time batch inputs"]) -> Array:
    """Return the outputs of a cell after each of the inputs."""
    step = jax.vmap(cell)

    def advance(carry: Any, now: Array) -> tuple[Any, Array]:
        carry = step(now, carry)
        return carry, carry[0]

    zero = jnp.zeros((seen.shape[1], cell.hidden_size))
    return jax.lax.scan(advance, (zero, zero), seen)[1]
