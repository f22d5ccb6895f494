"""Accumulate minimum, maximum, mean and standard deviation of a feature, as LeRobot's format stores them."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

LEVELS = np.arange(256) / 255.0  # of a colour of 8 bits


@dataclass(frozen=True)
class Moments:
    """Hold what n values of a feature have shown; ``spread`` is the sum of squared differences from the mean."""

    count: int
    low: np.ndarray
    high: np.ndarray
    mean: np.ndarray
    spread: np.ndarray

    @classmethod
    def of(cls, values: np.ndarray) -> Self:
        """Return those of ``(n, ...)`` values, each place by itself."""
        values = values.reshape(len(values), *(values.shape[1:] or (1,)))
        mean = values.mean(0, dtype=np.float64)
        spread = ((values - mean) ** 2).sum(0)
        return cls(len(values), values.min(0).astype(float), values.max(0).astype(float), mean, spread)

    @classmethod
    def of_images(cls, images: np.ndarray) -> Self:
        """Return those of ``(n, height, width, channels)`` uint8, ``(channels, 1, 1)`` in [0, 1], by histograms."""
        channels = (images[..., channel].ravel() for channel in range(images.shape[-1]))
        counts = np.stack([np.bincount(values, minlength=len(LEVELS)) for values in channels])
        share = counts / counts.sum(axis=1, keepdims=True)
        mean = share @ LEVELS
        spread = len(images) * (share * (LEVELS - mean[:, None]) ** 2).sum(axis=1)
        seen = counts > 0
        low, high = LEVELS[seen.argmax(axis=1)], LEVELS[::-1][seen[:, ::-1].argmax(axis=1)]
        return cls(len(images), *(one[:, None, None] for one in (low, high, mean, spread)))

    def with_more(self, other: Self) -> Self:
        """Return those of both sets of values (Chan et al., Updating Formulae and a Pairwise Algorithm, 1979)."""
        count = self.count + other.count
        step = other.mean - self.mean
        return type(self)(
            count,
            np.minimum(self.low, other.low),
            np.maximum(self.high, other.high),
            self.mean + step * (other.count / count),
            self.spread + other.spread + step**2 * (self.count * other.count / count),
        )

    def as_json(self) -> dict[str, list[Any]]:
        """Return what ``stats.json`` holds of a feature."""
        std = np.sqrt(self.spread / self.count)
        found = {"min": self.low, "max": self.high, "mean": self.mean, "std": std}
        return {**{name: values.tolist() for name, values in found.items()}, "count": [self.count]}


def merged(some: dict[str, Moments], more: dict[str, Moments]) -> dict[str, Moments]:
    """Return the statistics of two stretches of frames, by feature."""
    return {name: some[name].with_more(one) if name in some else one for name, one in more.items()}


def finite(features: dict[str, Moments]) -> dict[str, dict[str, list[Any]]]:
    """Return the statistics of each feature as JSON; none of a feature with a value that is not finite."""
    return {name: one.as_json() for name, one in features.items() if np.isfinite([one.low, one.high]).all()}
