"""Remember surfaces that the robot measures where its model predicts free space, and plan around them.

    surprise = an end of a beam, near by, whose predicted clearance is above what the errors of map and pose explain

A learned model may miss a thin wall. A robot that trusts it drives against the wall, and its filter, which knows of no
contact, walks through. What is measured counts as much as what is predicted; it is forgotten with the episode.
"""

import numpy as np
from jaxtyping import Float

from vssm_gym.planning.scans.range_table import RangeTable
from vssm_gym.planning.scans.search import clearance_at


class Surprises:
    """Hold a table of predicted ranges and what an episode's scans have added.

    Args:
        table: of the model.
        near: range up to which a reading is compared, m.
        above: predicted clearance at a reading's end from which it is a surprise, m.
    """

    def __init__(self, table: RangeTable, near: float, above: float) -> None:
        self._predicted, self._near, self._above = table, near, above
        self.table = table
        i, j = np.indices(table.clearance.shape)
        self._x, self._y = table.x + table.spacing * i, table.y + table.spacing * j

    def forget(self) -> None:
        """Return to what the model predicts."""
        self.table = self._predicted

    def look(
        self, pose: Float[np.ndarray, "3"], ranges: Float[np.ndarray, "beams"], angles: Float[np.ndarray, "beams"]
    ) -> Float[np.ndarray, "n 2"]:
        """Add the surprises of a scan; return where they are, x, y (m).

        Args:
            pose: of the robot, as estimated.
            ranges: measured, m; 0 where there is no reading.
            angles: of the beams on the robot, rad.
        """
        close = (ranges > 0.0) & (ranges <= self._near)
        direction = pose[2] + angles[close]
        ends = pose[:2] + ranges[close, None] * np.stack([np.cos(direction), np.sin(direction)], axis=-1)
        new = np.array([end for end in ends if clearance_at(self.table, end[0], end[1]) > self._above]).reshape(-1, 2)
        if len(new):
            clearance = self.table.clearance
            for x, y in new:
                clearance = np.minimum(clearance, np.hypot(self._x - x, self._y - y).astype(np.float32))
            self.table = self.table._replace(clearance=clearance)
        return new
