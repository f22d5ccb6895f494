"""Record a run of navigation step by step, with what the agent believed at each, for a picture and a video.

A :class:`Recording` is the spectator of :func:`~vssm_gym.eval.protocols.episode.run_episode`. The belief that is shown
is the agent's own where it keeps one (``agent.plan`` or ``agent.map``), else the map that it was given.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from vssm_gym.agents.base import Agent
from vssm_gym.eval.protocols.episode import StepRecord
from vssm_gym.eval.protocols.explore_episode import map_of
from vssm_gym.eval.video.plans import CroppedPlan, bounds_of
from vssm_gym.eval.video.track import Track
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.floor_plan import FloorPlan
from vssm_gym.planning.occupancy_grid import UNKNOWN
from vssm_gym.viz.pictures import REGION_95

CORNERS = 49  # of an ellipse, the first one again at the end
EMPTY_CELL = 0.05  # m, of the plan of an agent without a map


@dataclass(frozen=True)
class Moment:
    """Hold one step of a run.

    Attributes:
        seconds: since the start.
        metres: path length so far.
        planar: true x, y (m), heading (rad).
        estimate: the agent's estimate of it; None of an agent that keeps none.
        region: ``(n, 2)`` outline of the 95 % region of the estimated position, m; None without a covariance.
        status: the agent's status.
        path: the planned path, ``(n, 2)`` m; None without one.
        rgb: the agent's image.
        plan: the floor plan of its belief.
    """

    seconds: float
    metres: float
    planar: Float[np.ndarray, "3"]
    estimate: Float[np.ndarray, "3"] | None
    region: Float[np.ndarray, "n 2"] | None
    status: str
    path: Float[np.ndarray, "n 2"] | None
    rgb: UInt8[np.ndarray, "height width 3"]
    plan: CroppedPlan

    @property
    def error(self) -> float | None:
        """Return the distance between estimated and true position, m."""
        return None if self.estimate is None else float(np.hypot(*(self.estimate[:2] - self.planar[:2])))


class Recording:
    """Collect the moments of one run, as its spectator.

    Attributes:
        moments: one a step.
        track: where the robot was at every step.
        goal_rgb: the image of the goal, where the agent was given one.
    """

    def __init__(self, agent: Agent, given: VoxelMap | None) -> None:
        """Begin; ``given`` is the map that the agent was given."""
        self._agent = agent
        self._given = None if given is None else CroppedPlan.of(given)
        self.moments: list[Moment] = []
        self.track = Track()
        self.goal_rgb: np.ndarray | None = None

    def __call__(self, step: StepRecord) -> None:
        """Record one step."""
        self.track.add(step)
        seen, decision = step.observation, step.decision
        if "goal_rgb" in seen and self.goal_rgb is None:
            self.goal_rgb = np.array(seen["goal_rgb"])
        estimate = None if decision.pose is None else np.array(decision.pose, float)
        covariance = decision.covariance
        self.moments.append(
            Moment(
                step.seconds,
                float(step.info["path_length"]),
                step.planar,
                estimate,
                None if estimate is None or covariance is None else region_95(estimate, covariance),
                decision.status,
                None if decision.plan is None else np.array(decision.plan, float),
                np.array(seen["rgb"]),
                self._belief(step.planar),
            )
        )

    def _belief(self, planar: Float[np.ndarray, "3"]) -> CroppedPlan:
        """Return the floor plan of the agent's present belief; one unknown cell of an agent that keeps none."""
        plan, own = getattr(self._agent, "plan", None), map_of(self._agent)
        if isinstance(plan, FloorPlan):
            return CroppedPlan.cut(plan)
        if own is not None:
            return CroppedPlan.of(own)
        if self._given is not None:
            return self._given
        return CroppedPlan(np.full((1, 1), UNKNOWN, np.int8), planar[:2].copy(), EMPTY_CELL)

    def bounds(self, *regions: Float[np.ndarray, "2 2"]) -> Float[np.ndarray, "2 2"]:
        """Return the lowest and highest corner of all beliefs, of the path and of ``regions``, with a margin, m."""
        path = np.array(self.track.path)[:, :2]
        beliefs = {id(moment.plan): moment.plan.bounds for moment in self.moments}
        return bounds_of([*beliefs.values(), np.stack([path.min(axis=0), path.max(axis=0)]), *regions])

    def estimated(self, i: int) -> Float[np.ndarray, "n 2"]:
        """Return the estimated positions up to moment ``i``, m; none of an agent that keeps no estimate."""
        known = [moment.estimate[:2] for moment in self.moments[: i + 1] if moment.estimate is not None]
        return np.array(known).reshape(-1, 2)


def region_95(estimate: Float[np.ndarray, "3"], covariance: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "n 2"]:
    """``{p : (p - p^)' S^-1 (p - p^) = 2.448^2}``: return the outline of the 95 % region of a position, ``(n, 2)`` m.

    Args:
        estimate: x, y (m), heading (rad).
        covariance: of the error in the estimate's body frame: forward (m), left (m), turn (rad).
    """
    c, s = np.cos(estimate[2]), np.sin(estimate[2])
    R_world_body = np.array([[c, -s], [s, c]])
    variances, axes = np.linalg.eigh(np.asarray(covariance, float)[:2, :2])
    angle = np.linspace(0.0, 2.0 * np.pi, CORNERS)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    stretched = (REGION_95 * np.sqrt(np.maximum(variances, 0.0)))[:, None] * circle
    return np.asarray(estimate[:2] + (R_world_body @ axes @ stretched).T)
