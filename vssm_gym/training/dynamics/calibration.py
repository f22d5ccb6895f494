"""Calibrate the noise of learned transitions: envelopes of 95 % should hold 95 % of what a network has not seen."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from vssm_gym.model.transition.learned import LearnedTransition, together
from vssm_gym.training.dynamics.evaluation import coverage
from vssm_gym.training.dynamics.windows import Windows, evenly_spread

GAINS = np.geomspace(0.25, 8.0, 32)  # of the noise, among which calibration chooses
SPREAD_FACTORS = np.geomspace(0.1, 1.0, 16)  # of the spread of all networks together, likewise
CALIBRATED_ON = 24  # held-out windows of each network at most, each a tenth of a second for every gain
HELD_SHARE = 0.95  # share of held-out states that the envelopes of 95 % should hold


def calibrate(
    members: list[LearnedTransition], held: list[Windows], dt: float, noise: tuple[float, float]
) -> tuple[list[LearnedTransition], float]:
    """Multiply the noise by the gain with which envelopes hold the share of unseen states that they should.

    A network that has seen its windows many times is surer of them than of others, so each is judged on those that it
    has not seen, with biases as another flight may have. The share is that of all steps of all windows; it is a mean
    over the coordinates of position, and of pose.

    Args:
        members: transitions with one network each, after training.
        held: of each, windows that it was not trained on, with biases as those of its training.
        dt: length of a step, s.
        noise: standard deviations of measured positions (m) and rotations (rad).
    """
    some = [windows.take(evenly_spread(len(windows), CALIBRATED_ON)) for windows in held]
    low, high = 0, len(GAINS) - 1  # coverage grows with the gain: bisection
    while low < high:
        middle = (low + high) // 2
        shares = [
            coverage(with_gain(member, GAINS[middle]), windows, dt, noise).mean()
            for member, windows in zip(members, some, strict=True)
        ]
        low, high = (middle + 1, high) if np.mean(shares) < HELD_SHARE else (low, middle)
    return [with_gain(member, GAINS[low]) for member in members], float(GAINS[low])


def calibrate_together(
    members: list[LearnedTransition], seen: Windows, dt: float, noise: tuple[float, float]
) -> tuple[LearnedTransition, float]:
    """Return all networks together, their spread multiplied by ``sqrt(f)``.

    On unseen data they err less together than each alone, whose error the spread is that of, and more than on data that
    most of them have seen, which envelopes hold with the spread times ``f``. Their error there cannot be measured: the
    factor is the middle between 1 and ``f``, on a scale of ratios.

    Args:
        members: transitions with one network each, calibrated.
        seen: windows that they were trained on, with biases as well: without them ``f`` would take back what
            :func:`calibrate` added for biases.
        dt: length of a step, s.
        noise: standard deviations of measured positions (m) and rotations (rad).
    """
    whole = together(members)
    if whole.members == 1:
        return whole, 1.0
    some = seen.take(evenly_spread(len(seen), CALIBRATED_ON))
    low, high = 0, len(SPREAD_FACTORS) - 1
    while low < high:
        middle = (low + high) // 2
        share = coverage(with_gain(whole, SPREAD_FACTORS[middle]), some, dt, noise).mean()
        low, high = (middle + 1, high) if share < HELD_SHARE else (low, middle)
    factor = float(SPREAD_FACTORS[low]) ** 0.5
    return with_gain(whole, factor), factor


def with_gain(transition: LearnedTransition, gain: float) -> LearnedTransition:
    """Return the transition with all standard deviations multiplied: of the rest too, and of networks' weights."""
    spread = len(transition.nominal.manifold.turns) + transition.size
    offset = transition.network.offset.at[..., spread:].add(jnp.log(gain))
    louder = eqx.tree_at(lambda t: t.network.offset, transition, offset)
    if transition.disagreement is None:
        return louder
    return eqx.tree_at(lambda t: t.disagreement, louder, transition.disagreement * gain)
