"""Draw the control sequences by which hybrid A* leaves a node, and move them through a transition's mean (eq. P46).

The set is drawn once and is the same at every node. A transition of a robot in the plane moves alike from every place
and heading, so the motions from the origin are those from any pose.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.manifold import PLANAR


class Motions(NamedTuple):
    """Hold ``k`` sequences of ``m`` controls, each control in ``q / m`` parts.

    Attributes:
        controls: of the sequences.
        displacement: forward, left (m), turn (rad) from the node to the end of each part.
        length: of each part, m.
        turned: by a whole sequence, rad.
    """

    controls: np.ndarray  # (k, m, u)
    displacement: np.ndarray  # (k, q, 3)
    length: np.ndarray  # (k, q)
    turned: np.ndarray  # (k,)


def random_controls(
    seed: int, limits: Float[np.ndarray, "2"], sequences: int, steps: int, slowest: float = 0.5
) -> Float[np.ndarray, "k m 3"]:
    """Draw controls (turn, 0, distance) of a disc; a straight drive and both turns on the spot come first.

    Args:
        seed: of the draw.
        limits: largest turn (rad) and step (m).
        sequences: how many, at least three.
        steps: of each.
        slowest: share of the longest step, of the shortest one drawn.

    Raises:
        InputError: fewer than three sequences, or no step.
    """
    if sequences < 3 or steps < 1:
        raise InputError("random_controls", "sequences", f"three of one step, or more; found {sequences} of {steps}")
    rng = np.random.default_rng(seed)
    turn, step = (float(v) for v in limits)
    drawn = np.zeros((sequences, steps, 3))
    drawn[..., 0] = rng.uniform(-turn, turn, (sequences, steps))
    drawn[..., 2] = rng.uniform(slowest * step, step, (sequences, steps))
    drawn[:3] = 0.0
    drawn[0, :, 2] = step
    drawn[1, 0, 0], drawn[2, 0, 0] = turn, -turn
    return drawn


def motions(transition: Transition, controls: Float[np.ndarray, "k m u"], dt: float, part: float) -> Motions:
    """Return the motions of control sequences through the mean of a transition.

    Args:
        transition: of a robot in the plane.
        controls: of the sequences.
        dt: of a step, s.
        part: longest part in which a motion is checked, m.

    Raises:
        InputError: a transition of another state.
    """
    if transition.manifold != PLANAR:
        found = type(transition).__name__
        raise InputError("motions", "transition", f"one of a robot in the plane; found {found}")

    def step(state: jax.Array, control: jax.Array) -> tuple[jax.Array, jax.Array]:
        after = transition.mean(state, control, dt)
        return after, after

    start = jnp.zeros((len(controls), 3))
    _, states = jax.lax.scan(step, start, jnp.swapaxes(jnp.asarray(controls, jnp.float32), 0, 1))
    after = np.swapaxes(np.asarray(states, np.float64), 0, 1)
    before = np.concatenate([np.zeros((len(controls), 1, 3)), after[:, :-1]], axis=1)
    moved = np.hypot(*np.moveaxis(after - before, -1, 0)[:2])
    split = max(1, int(np.ceil(moved.max(initial=0.0) / part - 1e-6)))
    share = np.arange(1, split + 1)[:, None] / split
    between = before[:, :, None] + share * (after - before)[:, :, None]
    between[:, :, :-1, 2] = before[:, :, None, 2]  # it drives, and then it turns
    turned = np.abs(wrap_angle(after[..., 2] - before[..., 2])).sum(axis=1)
    k = len(controls)
    return Motions(
        np.asarray(controls, np.float64), between.reshape(k, -1, 3), np.repeat(moved / split, split, axis=1), turned
    )
