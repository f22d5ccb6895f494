"""Define how explorers choose: a strategy maps a :class:`Situation` to a :class:`Choice`."""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.exploration.candidates import Roadmap


@dataclass(frozen=True)
class Situation:
    """Hold what a strategy chooses by.

    Attributes:
        map: the belief over the apartment, world frame; valid until the next step.
        roadmap: free space and distances in it.
        planar: ``(3,)`` x, y (m), heading (rad).
        std: ``(3,)`` of the same, as they will be known when the next choice is made; zeros where they are observed.
        camera: intrinsics of the robot's camera.
        T_body_cam: ``(4, 4)`` pose of the camera in the body frame, metres.
        dismissed: ``(n, 2)`` places, m, from which or at which nothing new was seen.
        arrived: True where the last choice was carried out, or cannot be.
    """

    map: VoxelMap
    roadmap: Roadmap
    planar: np.ndarray
    std: np.ndarray
    camera: Camera
    T_body_cam: np.ndarray
    dismissed: np.ndarray
    arrived: bool


@dataclass(frozen=True)
class Choice:
    """Hold a viewpoint: a place and the headings in which images are taken there.

    Attributes:
        goal: ``(2,)`` m; None: stay here.
        headings: headings (rad) to turn to at the goal, one after the other.
        target: ``(n, 2)`` m, frontier cells to be seen: once they are known the choice is obsolete; None: none.
        status: one readable line.
    """

    goal: np.ndarray | None
    headings: tuple[float, ...]
    target: np.ndarray | None
    status: str


class ExplorationStrategy(Protocol):
    """Choose viewpoints; explorers differ in their strategy."""

    def reset(self, seed: int) -> None:
        """Open an episode whose random choices follow from ``seed``."""
        ...

    def choose(self, situation: Situation) -> Choice | None:
        """Choose what to do next; None where nothing is left to gain."""
        ...


def around(heading: float) -> tuple[float, ...]:
    """Return three headings (rad) that make a full turn, back to ``heading``; each turn is the shorter one."""
    return tuple(float(wrap_angle(heading + turn)) for turn in (2.0 * math.pi / 3.0, 4.0 * math.pi / 3.0, 0.0))
