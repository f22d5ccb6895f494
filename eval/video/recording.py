"""What pictures and a video of an explorer's run are made from: moments of it, with what the agent then believed.

It watches a run as :func:`~vssm_gym.eval.protocols.explore_episode.run_episode` shows it. Pictures are drawn when the
run has ended: only then is it known how large the apartment is and how much a candidate can gain.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int8, UInt8

from vssm_gym.agents.base import Agent
from vssm_gym.agents.exploration.mi_explorer import Tour
from vssm_gym.agents.shared.own_map import OwnMapConfig
from vssm_gym.eval.protocols.explore_episode import Step, map_of
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.floor_plan import FloorPlan
from vssm_gym.planning.occupancy_grid import UNKNOWN

EVERY = 2  # steps between two moments, 0.4 s
EARLY = 0.4  # coverage from which on a choice is shown: by then there are several places to choose from
SEVERAL = 4  # places that make a choice worth showing


@dataclass(frozen=True)
class Plan:
    """The part of a floor plan that is known.

    Attributes:
        cells: ``(nx, ny)`` of FREE, OCCUPIED and UNKNOWN (:mod:`vssm_gym.planning.occupancy_grid`).
        origin: world position of the centre of cell ``[0, 0]``, m.
        resolution: edge of a cell, m.
    """

    cells: Int8[np.ndarray, "nx ny"]
    origin: Float[np.ndarray, "2"]
    resolution: float

    @classmethod
    def of(cls, m: VoxelMap) -> "Plan":
        """The plan of a belief at the heights of the robot's body."""
        plan = FloorPlan.of(m, *OwnMapConfig().heights)
        known = plan.cells != UNKNOWN
        if not known.any():
            return cls(plan.cells[:1, :1].copy(), plan.origin, plan.resolution)
        rows, columns = (np.flatnonzero(known.any(axis=a)) for a in (1, 0))
        low, end = np.array([rows[0], columns[0]]), np.array([rows[-1], columns[-1]]) + 1
        return cls(plan.cells[low[0] : end[0], low[1] : end[1]].copy(), plan.centres(low), plan.resolution)

    @property
    def bounds(self) -> Float[np.ndarray, "2 2"]:
        """Lowest and highest corner, m."""
        low = self.origin - 0.5 * self.resolution
        return np.stack([low, low + self.resolution * np.array(self.cells.shape)])


@dataclass(frozen=True)
class Moment:
    """One moment of a run.

    Attributes:
        seconds: since the start.
        metres: driven.
        coverage: of what can be seen at all, [0, 1].
        planar: x, y (m), heading (rad).
        status: what the agent says.
        way: still to be driven, m; None without one.
        rgb: what the agent sees.
        plan: what it believes.
        tour: the places it chose among, until it has stopped; None of an agent that shows none.
        chosen: whether it chose among them since the moment before.
    """

    seconds: float
    metres: float
    coverage: float
    planar: Float[np.ndarray, "3"]
    status: str
    way: Float[np.ndarray, "n 2"] | None
    rgb: UInt8[np.ndarray, "height width 3"]
    plan: Plan
    tour: Tour | None
    chosen: bool


class Recording:
    """Collects the moments of one run; given to the run as its spectator.

    Attributes:
        moments: every ``EVERY`` steps, and where the agent stops.
        path: ``(3,)`` x, y (m), heading of every step.
        seconds: of every step.
    """

    def __init__(self, agent: Agent) -> None:
        self._agent = agent
        self.moments: list[Moment] = []
        self.path: list[np.ndarray] = []
        self.seconds: list[float] = []
        self._tour: Tour | None = None

    def __call__(self, step: Step) -> None:
        """See one step."""
        self.path.append(step.planar)
        self.seconds.append(step.seconds)
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
                Plan.of(m),
                None if stops else tour,
                tour is not self._tour and not stops,
            )
        )
        self._tour = tour

    def bounds(self, around: float = 0.3) -> Float[np.ndarray, "2 2"]:
        """Lowest and highest corner of all that was ever known, with ``around`` m on each side."""
        corners = np.array([moment.plan.bounds for moment in self.moments])
        return np.stack([corners[:, 0].min(axis=0) - around, corners[:, 1].max(axis=0) + around])

    def driven(self, moment: Moment) -> Float[np.ndarray, "n 2"]:
        """The path up to a moment, m."""
        n = int(np.searchsorted(self.seconds, moment.seconds)) + 1
        return np.array(self.path[:n])[:, :2]

    def choice(self) -> Moment | None:
        """The first choice among ``SEVERAL`` places with ``EARLY`` covered; else the one among most places, or None."""
        choices = [moment for moment in self.moments if moment.chosen and moment.tour is not None]
        early = (c for c in choices if c.coverage >= EARLY and c.tour is not None and len(c.tour.xy) >= SEVERAL)
        return next(early, max(choices, key=_places, default=None))


def _places(moment: Moment) -> int:
    return 0 if moment.tour is None else len(moment.tour.xy)
