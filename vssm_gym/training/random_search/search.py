"""Climb the reward of a vector of parameters by augmented random search, V2-t (Mania, Guy and Recht, 2018; eq. P53).

    r_k+- = R(theta +- nu delta_k),    delta_k ~ N(0, I)
    theta <- theta + alpha / (b s) sum_k (r_k+ - r_k-) delta_k    over the b directions with the largest max(r_k+, r_k-)

``s`` is the standard deviation of the 2 b rewards in the sum. States are normalised by their running mean and standard
deviation (V2), which are those of all rollouts so far.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from vssm_gym.errors import InputError

LEAST_STATE_STD = 1e-3  # of a state's component, that it is divided by at least


@dataclass(frozen=True)
class Moments:
    """Hold number, sum and sum of squares of states, whose running mean and deviation normalise them.

    Attributes:
        count: of states.
        total: ``(n,)`` sum.
        squares: ``(n,)`` sum of squares.
    """

    count: float
    total: np.ndarray
    squares: np.ndarray

    @classmethod
    def of(cls, size: int) -> "Moments":
        """Return those of no state: mean 0, deviation 1."""
        return cls(0.0, np.zeros(size), np.zeros(size))

    def __add__(self, other: "Moments") -> "Moments":
        return Moments(self.count + other.count, self.total + other.total, self.squares + other.squares)

    @property
    def mean(self) -> np.ndarray:
        """Return the mean of each component."""
        return self.total / max(self.count, 1.0)

    @property
    def std(self) -> np.ndarray:
        """Return the standard deviation of each component; 1 before two states were seen."""
        if self.count < 2.0:
            return np.ones_like(self.total)
        return np.sqrt(np.maximum(self.squares / self.count - self.mean**2, LEAST_STATE_STD**2))


Evaluate: TypeAlias = Callable[[np.ndarray, Moments], tuple[np.ndarray, Moments]]
"""Rewards ``(n,)`` of parameters ``(n, size)``, their states normalised by moments, and the moments of their states."""


@dataclass(frozen=True)
class SearchConfig:
    """Configure the search.

    Args:
        directions: drawn a step.
        best: of them that move the parameters (V2-t).
        spread: nu, of a perturbation.
        rate: alpha, step size.
    """

    directions: int = 16
    best: int = 8
    spread: float = 0.1
    rate: float = 0.1

    def __post_init__(self) -> None:
        if not 1 <= self.best <= self.directions:
            raise InputError("SearchConfig", "best", f"1 to {self.directions}, not {self.best}")
        for name in ("spread", "rate"):
            if not getattr(self, name) > 0.0:
                raise InputError("SearchConfig", name, f"above 0, not {getattr(self, name)}")


def climb(
    parameters: Float[np.ndarray, "size"],
    moments: Moments,
    evaluate: Evaluate,
    config: SearchConfig,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "size"], Moments, float]:
    """Return the parameters after one step, the moments of all states so far, and the mean reward of the rollouts.

    Args:
        parameters: before the step.
        moments: of the states before it.
        evaluate: the rewards; each pair ``2 k``, ``2 k + 1`` of its rows are the two sides of a direction.
        config: of the search.
        rng: of the directions.
    """
    delta = rng.normal(size=(config.directions, len(parameters)))
    sides = np.stack([parameters + config.spread * delta, parameters - config.spread * delta], axis=1)
    rewards, seen = evaluate(sides.reshape(-1, len(parameters)), moments)
    pairs = rewards.reshape(-1, 2)
    best = np.argsort(-pairs.max(axis=1), kind="stable")[: config.best]
    deviation = float(pairs[best].std())
    step = (pairs[best, 0] - pairs[best, 1]) @ delta[best]
    moved = parameters + config.rate / (config.best * max(deviation, 1e-8)) * step
    return moved, moments + seen, float(rewards.mean())
