"""Record moments of an exploration, with the agent's belief at each, for pictures and a video.

A :class:`Recording` is the spectator of :func:`~vssm_gym.eval.protocols.explore_episode.run_episode`. Pictures are
drawn when the run has ended, because only then the extent of the map and the range of gains are known.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from vssm_gym.agents.base import Agent
from vssm_gym.agents.exploration.mi_explorer import Tour
from vssm_gym.eval.protocols.episode import StepRecord
from vssm_gym.eval.protocols.explore_episode import map_of
from vssm_gym.eval.video.plans import CroppedPlan, bounds_of
from vssm_gym.eval.video.track import Track

EVERY = 2  # steps between two moments, 0.4 s
EARLY = 0.4  # coverage from which on a choice is shown: by then there are several candidates
SEVERAL = 4  # least number of candidates of a choice that is shown


@dataclass(frozen=True)
class Moment:
    """Hold one moment of a run.

    Attributes:
        seconds: since the start.
        metres: path length so far.
        coverage: of the observable area, [0, 1].
        planar: x, y (m), heading (rad).
        status: the agent's status.
        path: the planned path, ``(n, 2)`` m; None without one.
        rgb: the agent's image.
        plan: the floor plan of its belief.
        tour: its candidates, until it has stopped; None of an agent that shows none.
        chosen: whether it chose among them since the moment before.
    """

    seconds: float
    metres: float
    coverage: float
    planar: Float[np.ndarray, "3"]
    status: str
    path: Float[np.ndarray, "n 2"] | None
    rgb: UInt8[np.ndarray, "height width 3"]
    plan: CroppedPlan
    tour: Tour | None
    chosen: bool


class Recording:
    """Collect the moments of one run, as its spectator.

    Attributes:
        moments: every ``EVERY`` steps, and where the agent stops.
        track: where the robot was at every step.
    """

    def __init__(self, agent: Agent) -> None:
        self._agent = agent
        self.moments: list[Moment] = []
        self.track = Track()
        self._tour: Tour | None = None

    def __call__(self, step: StepRecord) -> None:
        """Record one step."""
        self.track.add(step)
        decision = step.decision
        stops = bool(decision.action[3] > 0.5)
        m = map_of(self._agent)
        if m is None or (step.number % EVERY and not stops):
            return
        tour = getattr(self._agent, "tour", None)
        self.moments.append(
            Moment(
                step.seconds,
                float(step.info["path_length"]),
                float(step.info["coverage"]),
                step.planar,
                decision.status,
                decision.plan,
                np.array(step.observation["rgb"]),
                CroppedPlan.of(m),
                None if stops else tour,
                tour is not self._tour and not stops,
            )
        )
        self._tour = tour

    def bounds(self) -> Float[np.ndarray, "2 2"]:
        """Return the lowest and highest corner of all known space, with a margin, m."""
        return bounds_of(moment.plan.bounds for moment in self.moments)

    def choice(self) -> Moment | None:
        """Return the first choice at ``EARLY`` coverage among ``SEVERAL`` candidates, or that among most, or None."""
        choices = [moment for moment in self.moments if moment.chosen and moment.tour is not None]
        early = (c for c in choices if c.coverage >= EARLY and c.tour is not None and len(c.tour.xy) >= SEVERAL)
        return next(early, max(choices, key=_places, default=None))


def _places(moment: Moment) -> int:
    return 0 if moment.tour is None else len(moment.tour.xy)
