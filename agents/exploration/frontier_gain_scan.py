"""Explore as ``frontier_gain`` does, with a full turn in every metre.

goal = argmax_f A(f) exp(-lambda d(f)), and a full turn wherever the last one was ``every`` metres away.

A turn costs time and no path length. ``frontier_gain_scan`` shows what an explorer gains by looking aside on its path,
without any model of the expected gain. Described in ``docs/agents/exploration.md``.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from vssm_gym.agents.shared.explorer import Explorer
from vssm_gym.agents.shared.frontier_gain import FrontierGain, FrontierGainConfig
from vssm_gym.agents.shared.strategy import Choice, Situation, around
from vssm_gym.maps.voxel_map import VoxelMap


@dataclass(frozen=True)
class FrontierGainScanConfig:
    """Configure ``frontier_gain_scan``."""

    every: float = 1.0  # m between turns
    frontiers: FrontierGainConfig = field(default_factory=FrontierGainConfig)


class FrontierGainScan:
    """Choose the frontier of the greatest utility, with full turns on the path."""

    def __init__(self, config: FrontierGainScanConfig) -> None:
        self._config, self._frontiers = config, FrontierGain(config.frontiers)

    def reset(self, seed: int) -> None:
        """Open an episode; nothing here is random, so ``seed`` changes nothing."""
        self._turned: np.ndarray | None = None

    def choose(self, situation: Situation) -> Choice | None:
        """Return a full turn where one is due, else the frontier of the greatest utility."""
        choice, xy = self._frontiers.choose(situation), situation.planar[:2]
        if self._turned is None or situation.arrived:  # a full turn has just ended
            self._turned = xy.copy()
        if choice is None or math.hypot(*(xy - self._turned)) < self._config.every:
            return choice
        self._turned = xy.copy()
        return Choice(None, around(float(situation.planar[2])), None, "turns around on its path")


class FrontierGainScanAgent:
    """Explore frontiers by gain and cost with full turns on the path; the pose is observed."""

    name = "frontier_gain_scan"
    robot = "holonomic"
    task = "explore"
    needs_pose = True
    needs_map = False

    def __init__(self, config: FrontierGainScanConfig | None = None) -> None:
        self._explorer = Explorer(FrontierGainScan(config or FrontierGainScanConfig()))
        self.reset, self.act = self._explorer.reset, self._explorer.act

    @property
    def map(self) -> VoxelMap:
        """Return the belief over the apartment, world frame."""
        return self._explorer.map
