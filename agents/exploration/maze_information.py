"""Explore a maze where scans will say most about the map a step, by samples of the model alone (eq. P50, P51, P52).

``maze_information`` infers its pose and a map of the plane from scans (PRISM in the plane) and chooses among random
control sequences and paths by ``I(M; x_1:T | u) / steps``. Of the model it uses the contract of models of scans alone:
draws of scans, of maps, and predicted ranges. Described in ``docs/agents/exploration.md``.
"""

import time
from dataclasses import dataclass, field

import jax
import numpy as np

from vssm_gym.agents.base import AgentContext, Decision, Observation
from vssm_gym.agents.shared.planar.driving import follow_safely, free_ahead, leave
from vssm_gym.agents.shared.planar.scan_mapper import ScanMapper, ScanMapperConfig, scanner_of
from vssm_gym.maps.planar_map import PlanarMap
from vssm_gym.model.scan_emission import OccupancyScans
from vssm_gym.planning.exploration.plane.choice import PlaneChoice, PlaneChoiceConfig, choose
from vssm_gym.planning.exploration.plane.roads import PlaneRoads


@dataclass(frozen=True)
class MazeInformationConfig:
    """Configure ``maze_information``; lengths in metres."""

    mapper: ScanMapperConfig = field(default_factory=ScanMapperConfig)
    choice: PlaneChoiceConfig = field(default_factory=PlaneChoiceConfig)
    beams: int = 16  # of the scans whose information is estimated
    scale: float = 0.005  # of a reading's Laplace noise
    free_path: float = 5.0  # cells of unknown space that a beam passes
    executed: int = 16  # steps of a choice that are driven before the next one
    room: float = 0.02  # around the robot's centre that a path keeps
    margin: float = 0.001  # beyond the robot's radius that must be free ahead


class MazeInformationAgent:
    """Drive what is most informative a step, a few steps at a time."""

    name = "maze_information"
    robot = "disc"
    task = "explore"
    needs_pose = False
    needs_map = False

    def __init__(self, config: MazeInformationConfig | None = None) -> None:
        self._config = config or MazeInformationConfig()
        self._mapper = ScanMapper(self._config.mapper)

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> None:
        """Open an episode whose draws follow from ``seed``."""
        self._mapper.reset(context, observation)
        self._limits = np.asarray(context.limits, np.float64)
        self._half_width = 0.5 * context.body_length + self._config.margin
        self._key, self._choices = jax.random.key(seed), 0
        self._scanner = scanner_of(self._config.beams, self._config.mapper.reach)
        self._last: np.ndarray | None = None
        self._driving: PlaneChoice | None = None
        self._driven = 0  # steps of the present choice

    def act(self, observation: Observation) -> Decision:
        """Update pose and map, choose where a choice is due, and drive a step."""
        began = time.perf_counter()
        if self._last is not None:
            self._mapper.observe(self._last, observation)
        pose = self._mapper.pose
        tracked = time.perf_counter()
        scan = self._mapper.smooth_scan()
        command = self._continue(pose, scan)
        chosen = command is None
        if command is None:
            self._driving, self._driven = self._choose(pose), 0
            command = self._continue(pose, scan)
        latency = {"tracking": tracked - began}
        if chosen:
            latency["planning"] = time.perf_counter() - tracked
        status = "leaves a tight place" if command is None else self._status()
        self._last = leave(scan, self._limits, self._half_width) if command is None else command
        self._driven += 1
        action = np.array([*self._last, 0.0], np.float32)
        covariance = np.asarray(self._mapper.belief.covariance, np.float64)
        plan = None if self._driving is None else self._driving.path
        return Decision(action, pose, status, latency, plan, covariance=covariance)

    @property
    def planar_map(self) -> PlanarMap:
        """Return what is known of the maze."""
        return self._mapper.map

    def _continue(self, pose: np.ndarray, scan: np.ndarray) -> np.ndarray | None:
        """Return the next command of the present choice; None where it is over, or the way is not free."""
        choice, k = self._driving, self._driven
        if choice is None or k >= self._config.executed:
            return None
        if choice.path is not None:
            return follow_safely(pose, choice.path, scan, self._limits, self._half_width)
        if choice.controls is None or k >= len(choice.controls):
            return None
        command = np.asarray(choice.controls[k], np.float64)[[0, 2]]
        return command if free_ahead(scan, 0.0, self._half_width) >= command[1] else None

    def _choose(self, pose: np.ndarray) -> PlaneChoice | None:
        c, mapper = self._config, self._mapper
        key, self._choices = jax.random.fold_in(self._key, self._choices), self._choices + 1
        known, seen = (
            OccupancyScans(m, self._scanner, c.scale, free_path=c.free_path) for m in (mapper.map, mapper.seen)
        )
        roads = PlaneRoads.of(mapper.seen, pose[:2], c.room)
        return choose(key, known, seen, mapper.transition, mapper.belief, roads, self._limits, mapper.dt, c.choice)

    def _status(self) -> str:
        choice = self._driving
        assert choice is not None
        kind = "a path" if choice.path is not None else "a sequence"
        return f"drives {kind} of {choice.nats:.0f} nats, {choice.value:.2f} a step"
