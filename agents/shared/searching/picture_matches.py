"""Keep the poses where a picture may have been taken, and those where the camera has seen something else."""

import math
from dataclasses import dataclass

import numpy as np

from vssm_gym.geometry.transforms import wrap_angle


@dataclass(frozen=True)
class Match:
    """Hold a pose where the picture may have been taken.

    Attributes:
        planar: ``(3,)`` of the body, m and rad, in the map's frame.
        log_prob: ``log p(picture | z, M)``, mean of a pixel, nats.
        correlation: of the luminances of the picture and of the map seen from there.
        share: of the picture that the map shows.
    """

    planar: np.ndarray
    log_prob: float
    correlation: float
    share: float

    def is_near(self, planar: np.ndarray, place: float, heading: float) -> bool:
        """Return True where a pose ``(3,)`` is within ``place`` m and ``heading`` rad."""
        turned = abs(float(wrap_angle(self.planar[2] - planar[2])))
        return math.hypot(*(self.planar[:2] - planar[:2])) < place and turned < heading


@dataclass(frozen=True)
class MatchesConfig:
    """Configure which poses are one; metres and radians."""

    kept: int = 12
    apart: tuple[float, float] = (0.3, 0.3)  # matches that are nearer are one
    refuted: tuple[float, float] = (0.5, 0.4)  # a match that is nearer to a refuted pose is refuted
    better: float = 1.0  # nats a pixel by which a match must be likelier than another one to replace it


class Matches:
    """Hold the last alignment near each pose, the likeliest first."""

    def __init__(self, config: MatchesConfig = MatchesConfig()) -> None:
        self._config = config
        self.all: list[Match] = []
        self._refuted: list[np.ndarray] = []

    def add(self, new: Match) -> None:
        """Add a match in place of those near it, unless it is refuted."""
        c = self._config
        if any(new.is_near(planar, *c.refuted) for planar in self._refuted):
            return
        others = [one for one in self.all if not one.is_near(new.planar, *c.apart)]
        self.all = sorted([*others, new], key=lambda one: -one.log_prob)[: c.kept]

    def refute(self, match: Match) -> None:
        """Refute a match and all that will be found near it."""
        self._refuted.append(match.planar)
        self.all = [one for one in self.all if not one.is_near(match.planar, *self._config.refuted)]

    def best(self, log_prob: float, correlation: float, share: float, than: Match | None = None) -> Match | None:
        """Return the likeliest match that is not refuted; None where there is none.

        Args:
            log_prob: at least, mean of a pixel of what the map shows: others have none.
            correlation: of the match, at least.
            share: of the match, at least.
            than: a match at another place, which it must be better than.
        """
        c = self._config
        for one in self.all:
            fits = one.log_prob >= log_prob * one.share and one.correlation >= correlation and one.share >= share
            if fits:
                if than is None:
                    return one
                likelier = one.log_prob > than.log_prob + c.better
                return one if likelier and not one.is_near(than.planar, *c.refuted) else None
        return None
