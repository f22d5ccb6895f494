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
    """What a strategy chooses by.

    Attributes:
        map: the belief over the apartment, world frame; valid until the next step.
        roadmap: free space and ways in it.
        planar: ``(3,)`` x, y (m), heading (rad).
        std: ``(3,)`` of the same, as they will be known when the next choice is made; zeros where they are observed.
        camera: what will be seen,
        T_body_cam: and from where on the body, ``(4, 4)``.
        dismissed: ``(n, 2)`` places, m, that were looked at in vain.
        arrived: whether the last choice was carried out, or cannot be.
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
    """Where to go and where to look.

    Attributes:
        goal: ``(2,)`` m; None: stay here.
        looks: headings (rad) to turn to at the goal, one after the other.
        target: ``(n, 2)`` m, the frontier cells that this is about: when they are known it is pointless; None: none.
        status: one readable line.
    """

    goal: np.ndarray | None
    looks: tuple[float, ...]
    target: np.ndarray | None
    status: str


class ExplorationStrategy(Protocol):
    """What makes explorers differ."""

    def reset(self, seed: int) -> None:
        """Open an episode whose random choices follow from ``seed``."""
        ...

    def choose(self, situation: Situation) -> Choice | None:
        """What to do next; None where nothing is left to gain."""
        ...


def around(heading: float) -> tuple[float, ...]:
    """Three looks that make a whole turn, back to ``heading`` (rad); every turn takes the shorter way."""
    return tuple(float(wrap_angle(heading + turn)) for turn in (2.0 * math.pi / 3.0, 4.0 * math.pi / 3.0, 0.0))
