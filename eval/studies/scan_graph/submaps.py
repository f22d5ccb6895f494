"""Group keyframes into submaps, the surfaces that later scans are matched to.

A submap is ``SUBMAP`` consecutive keyframes, its frame that of its middle one, the anchor. Its surface is made once
from the relative poses that the keyframes then have, and anew after :meth:`Submaps.forget`.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from vssm_gym.eval.studies.scan_graph import correlative
from vssm_gym.eval.studies.scan_graph.clouds import Cloud, Points, surface, together
from vssm_gym.geometry.planar_poses import relation

SUBMAP = 10  # keyframes of a submap
TRACKED = 12  # newest keyframes, that the next scan is matched to


@dataclass
class Submaps:
    """Hold the points of the keyframes and the surfaces made of them.

    Attributes:
        cell: length that all lengths are in, m.
        points: of each keyframe, in its frame.
    """

    cell: float
    points: list[Points] = field(default_factory=list)
    _clouds: dict[int, Cloud] = field(default_factory=dict)
    _fields: dict[int, correlative.Field] = field(default_factory=dict)

    def __len__(self) -> int:
        """Return the number of complete submaps."""
        return len(self.points) // SUBMAP

    def forget(self) -> None:
        """Drop the surfaces: poses have changed."""
        self._clouds.clear()
        self._fields.clear()

    def anchor(self, number: int) -> int:
        """Return the keyframe whose frame is that of a submap."""
        return number * SUBMAP + SUBMAP // 2

    def cloud(self, number: int, poses: Float[np.ndarray, "nodes 3"]) -> Cloud:
        """Return the surface of a submap in its frame."""
        if number not in self._clouds:
            members = range(number * SUBMAP, (number + 1) * SUBMAP)
            self._clouds[number] = self._surface(members, poses, self.anchor(number))
        return self._clouds[number]

    def likelihood(self, number: int, poses: Float[np.ndarray, "nodes 3"]) -> correlative.Field:
        """Return the field of a submap's surface."""
        if number not in self._fields:
            self._fields[number] = correlative.field(self.cloud(number, poses), self.cell)
        return self._fields[number]

    def newest(self, poses: Float[np.ndarray, "nodes 3"]) -> Cloud:
        """Return the surface of the newest keyframes in the frame of the last."""
        last = len(self.points) - 1
        return self._surface(range(max(0, last + 1 - TRACKED), last + 1), poses, last)

    def distances(self, poses: Float[np.ndarray, "nodes 3"], place: Float[np.ndarray, "2"]) -> np.ndarray:
        """Return the distance of a place from the nearest keyframe of each submap, m."""
        apart = np.hypot(*(poses[: len(self) * SUBMAP, :2] - place).T)
        return np.asarray(apart.reshape(-1, SUBMAP).min(axis=1))

    def _surface(self, members: range, poses: np.ndarray, anchor: int) -> Cloud:
        parts = [self.points[k].moved(relation(poses[anchor], poses[k])) for k in members]
        return surface(together(parts), self.cell)
