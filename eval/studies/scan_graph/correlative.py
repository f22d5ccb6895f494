"""Match a scan to a surface without a good start: the best of all poses in a window, by branch and bound.

    score(T) = mean_k exp(-(d(T p_k) / cell)^2 / 2),    d the distance to the surface

The window's positions are searched in square blocks of cells: the score in a field of each block's maximum bounds
that of every position in it, so a block whose bound is below the best score found is left out (Olson's two levels,
Cartographer's bound). A second peak that is nearly as high says that the place cannot be told from another.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt, maximum_filter1d

from vssm_gym.eval.studies.scan_graph.clouds import Cloud, Points, rotation

SEARCH_BLOCK = 4  # cells
MOST_SCORED = 90  # of a scan, that are scored
RIVAL = 0.95  # of the best score: blocks that may hold a rival are searched too
MOST_EXPANDED = 1000  # that a search looks into: where so many may hold the best pose, no one is
RIVAL_CELLS, RIVAL_TURN = 6.0, 0.15  # cells, rad from the best pose, beyond which a peak is another
SEARCH_STEP = (0.01, 0.05)  # rad, least and largest step of the turn


@dataclass(frozen=True)
class Field:
    """Hold the likelihood of a point at each cell.

    Attributes:
        fine: of a point in a cell; 0 beyond the border.
        coarse: largest of the ``SEARCH_BLOCK`` x ``SEARCH_BLOCK`` cells from a cell on.
        low: the place of the first cell, m.
    """

    fine: Float[np.ndarray, "w h"]
    coarse: Float[np.ndarray, "w h"]
    low: Float[np.ndarray, "2"]


@dataclass(frozen=True)
class Peak:
    """Hold the best pose, its score, and the score of the best pose far from it."""

    pose: Float[np.ndarray, "3"]
    score: float
    rival: float


def field(cloud: Cloud, cell: float) -> Field:
    """Return the field of a surface."""
    border = 4 * cell
    low = cloud.places.min(axis=0) - border
    shape = np.ceil((cloud.places.max(axis=0) + border - low) / cell).astype(int) + 1
    free = np.ones(shape, bool)
    free[tuple(np.floor((cloud.places - low) / cell).astype(int).T)] = False
    fine = np.exp(-0.5 * distance_transform_edt(free) ** 2)
    fine[fine < 1e-3] = 0.0
    fine = np.pad(fine, SEARCH_BLOCK)  # blocks that begin before the border
    coarse = fine
    for axis in (0, 1):
        coarse = maximum_filter1d(coarse, SEARCH_BLOCK, axis, mode="constant", origin=-(SEARCH_BLOCK // 2))
    return Field(fine, coarse, low - SEARCH_BLOCK * cell)


def search(
    within: Field, points: Points, centre: Float[np.ndarray, "3"], cell: float, window: float, turns: float
) -> Peak:
    """Return the best pose in a window.

    Args:
        within: field of the surface.
        points: of the scan, in its frame.
        centre: middle of the window.
        cell: of the field, m.
        window: half its width, m.
        turns: half of its turns, rad.
    """
    places = points.places[:: max(1, len(points) // MOST_SCORED)]
    far = float(np.percentile(np.hypot(*places.T), 75))
    step = float(np.clip(cell / far, *SEARCH_STEP))
    count = int(np.ceil(turns / step))
    headings = centre[2] + step * np.arange(-count, count + 1)
    rotated = np.stack([places @ rotation(heading).T for heading in headings])
    cells = np.floor((rotated + centre[:2] - within.low) / cell).astype(int)
    blocks = int(np.ceil(window / (SEARCH_BLOCK * cell)))
    offsets = SEARCH_BLOCK * np.stack(np.meshgrid(*2 * [np.arange(-blocks, blocks)], indexing="ij"), -1).reshape(-1, 2)
    bounds = np.stack([_score(within.coarse, c, offsets) for c in cells])
    inside = np.stack(np.meshgrid(*2 * [np.arange(SEARCH_BLOCK)], indexing="ij"), axis=-1).reshape(-1, 2)
    found: list[np.ndarray] = []  # score, heading's number, offset
    best = 0.0
    for number in np.argsort(-bounds, axis=None):
        k, block = np.unravel_index(number, bounds.shape)
        if bounds[k, block] < max(RIVAL * best, 1e-6):
            break
        if len(found) == MOST_EXPANDED:
            return Peak(np.array(centre, float), best, best)
        fine = offsets[block] + inside
        scores = _score(within.fine, cells[k], fine)
        top = int(scores.argmax())
        best = max(best, float(scores[top]))
        found.append(np.array([scores[top], k, *fine[top]]))
    if not found:
        return Peak(np.array(centre, float), 0.0, 0.0)
    rows = np.array(found)
    first = rows[rows[:, 0].argmax()]
    apart = np.hypot(*(rows[:, 2:] - first[2:]).T) > RIVAL_CELLS
    apart |= np.abs(rows[:, 1] - first[1]) * step > RIVAL_TURN
    pose = np.array([*(centre[:2] + cell * first[2:]), headings[int(first[1])]])
    return Peak(pose, float(first[0]), float(rows[apart, 0].max(initial=0.0)))


def _score(values: np.ndarray, cells: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Return the mean of the values at cells moved by each offset; 0 outside."""
    i, j = (cells[None] + offsets[:, None]).transpose(2, 0, 1)
    inside = (i >= 0) & (j >= 0) & (i < values.shape[0]) & (j < values.shape[1])
    return np.where(inside, values[np.where(inside, i, 0), np.where(inside, j, 0)], 0.0).mean(axis=1)
