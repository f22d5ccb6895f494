"""Cut free space into rooms: at its doors a plan is narrow, and wider on both sides.

    cut at a segment of length d across the plan  <=>  both parts hold a disc wider than d, and MIN_AREA

Candidates start at the ends of walls (short edges between two corners that jut into the plan) straight ahead, and at
single such corners along the continued wall faces; shorter cuts come first. Metres throughout.
"""

import math
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float
from shapely import Polygon
from shapely.ops import split

MIN_AREA = 1.2  # m^2 of a room
NARROWEST_OPENING, WIDEST_OPENING = 0.4, 2.1  # m, widths of openings
WIDE_CORNER = 1.3  # m: without a wall's end pointing at it, a wider opening is a corner of the room, not a door
WIDER = 1.08  # the disc on either side of a cut against its length
JAMB = 0.45  # m, thickest wall whose end counts as a door's jamb
BARE = 0.1  # m, thickness of a lintel where the plan shows none


@dataclass(frozen=True)
class Opening:
    """Hold a cut ``start`` -> ``end`` (x, y) m between two rooms, and the ``thickness`` m of its wall."""

    start: tuple[float, float]
    end: tuple[float, float]
    thickness: float

    @property
    def width(self) -> float:
        """Return the distance from start to end, m."""
        return math.dist(self.start, self.end)


def split_rooms(outline: Polygon) -> tuple[list[Polygon], list[Opening]]:
    """Return the parts of ``outline`` between its narrow openings, and the openings; the parts tile the outline."""
    rooms, openings = [outline], []
    # Of equal ones the first: in the middle of a wall's end rather than along its faces.
    for opening in sorted(_candidates(outline), key=lambda opening: round(opening.width, 2)):
        middle = shapely.Point(np.mean([opening.start, opening.end], axis=0))
        index = next((i for i, room in enumerate(rooms) if room.contains(middle)), None)
        if index is None:
            continue
        along = np.subtract(opening.end, opening.start) / opening.width
        line = shapely.LineString([opening.start - 1e-3 * along, opening.end + 1e-3 * along])
        parts = [part for part in split(rooms[index], line).geoms if part.area > 1e-6]
        if len(parts) == 2 and all(_is_room(part, opening.width) for part in parts):
            rooms[index : index + 1] = parts
            openings.append(opening)
    return rooms, openings


def _is_room(part: Polygon, width: float) -> bool:
    return part.area >= MIN_AREA and not part.buffer(-0.5 * WIDER * width).is_empty


def corners(outline: Polygon) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n"]]:
    """Return the outline's corners, counter-clockwise, and the sine of each one's turn.

    Negative where it juts inwards.
    """
    points = shapely.get_coordinates(shapely.orient_polygons(outline).exterior)[:-1]
    before, after = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
    turn = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    return points, turn / np.maximum(np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1), 1e-12)


def _candidates(outline: Polygon) -> list[Opening]:
    points, turn = corners(outline)
    n = len(points)
    border = outline.exterior
    shapely.prepare(border)
    found: list[Opening] = []

    def look(origin: np.ndarray, direction: np.ndarray, thickness: float, widest: float) -> None:
        """Add an opening from ``origin`` straight ahead to the next wall, if it is as wide as a door."""
        ahead = shapely.LineString([origin + 1e-4 * direction, origin + (widest + 0.1) * direction])
        hits = shapely.get_coordinates(ahead.intersection(border))
        width = min((float(np.dot(hit - origin, direction)) for hit in hits), default=math.inf)
        if NARROWEST_OPENING <= width <= widest:
            end = origin + width * direction
            found.append(Opening((float(origin[0]), float(origin[1])), (float(end[0]), float(end[1])), thickness))

    juts = turn < -0.2
    edges = np.roll(points, -1, axis=0) - points
    lengths = np.linalg.norm(edges, axis=1)
    after = [(i, (i + 1) % n) for i in range(n) if lengths[i] > 1e-3]
    for i, j in after:
        if juts[i] and juts[j] and lengths[i] <= JAMB:
            ahead = np.array([-edges[i, 1], edges[i, 0]]) / lengths[i]
            look((points[i] + points[j]) / 2, ahead, float(lengths[i]), WIDEST_OPENING)
    for i, j in after:
        if juts[j]:  # the edge goes on
            look(points[j], edges[i] / lengths[i], BARE, WIDE_CORNER)
        if juts[i]:  # backwards
            look(points[i], -edges[i] / lengths[i], BARE, WIDE_CORNER)
    return found
