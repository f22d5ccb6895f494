"""Build walls around a plan: behind every edge of the free polygon a wall whose face is that edge.

Where two parts of the plan are closer than two walls' thickness, each side's wall takes half of what is between them.
So what the walls leave free is the polygon itself. Metres throughout.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float
from shapely import Polygon

OUTER_THICKNESS = 0.12  # m, where nothing is behind the wall
THIN = 0.03  # m; an edge with less behind it is halved, down to pieces of PIECE m
PIECE = 0.1  # m
_ASIDE = 3e-3  # m that the test for space behind an edge leaves out at both its ends: corners of nearly 90 degrees
SHORT = 0.025  # m; shorter edges are chamfers of a corner


@dataclass(frozen=True)
class Face:
    """Hold the visible face of a wall, ``start`` -> ``end`` (2,) m with the room on its left, and its ``thickness``."""

    start: Float[np.ndarray, "2"]
    end: Float[np.ndarray, "2"]
    thickness: float

    @property
    def along(self) -> Float[np.ndarray, "2"]:
        """Return the unit vector start -> end."""
        return (self.end - self.start) / np.linalg.norm(self.end - self.start)

    @property
    def inward(self) -> Float[np.ndarray, "2"]:
        """Return the unit vector into the room."""
        return np.array([-self.along[1], self.along[0]])

    def body(self) -> Polygon:
        """Return the wall's ground plan."""
        back = self.thickness * self.inward
        return Polygon([self.start, self.end, self.end - back, self.start - back])


def wall_faces(room: Polygon, free: Polygon, most: int) -> list[Face]:
    """Return walls along those edges of ``room`` that are edges of ``free``; the others are openings to other rooms.

    Raises ValueError where the walls have more than ``most`` pieces: thin walls between many corners are halved often.
    """
    shapely.prepare(free)
    points = shapely.get_coordinates(shapely.orient_polygons(room).exterior)
    solid: list[Face] = []
    for a, b in itertools.pairwise(points):
        if np.linalg.norm(b - a) > 1e-6 and free.exterior.distance(shapely.Point((a + b) / 2)) < 1e-6:
            for piece in _behind(a, b, free):
                solid.append(piece)
                if len(solid) > most:
                    raise ValueError(f"more than {most} pieces of walls")
    # The end of a thin wall is covered by the walls on both its sides; long walls first, so that they stay.
    solid.sort(key=lambda face: -float(np.linalg.norm(face.end - face.start)))
    kept: list[Face] = []
    bodies, bounds = np.empty(len(solid), object), np.zeros((len(solid), 4))  # of those kept
    for face in solid:
        body, n = face.body(), len(kept)
        low, high = np.array(body.bounds[:2]) - 1e-6, np.array(body.bounds[2:]) + 1e-6
        beside = bodies[:n][((bounds[:n, :2] <= high) & (bounds[:n, 2:] >= low)).all(axis=1)]
        near = beside[shapely.distance(beside, body) < 1e-6]
        if body.difference(shapely.union_all(near).buffer(1e-4)).area > 1e-5:
            kept.append(_closed_corners(face, free))
            bodies[n] = kept[-1].body()
            bounds[n] = bodies[n].bounds
    return kept


def _behind(a: np.ndarray, b: np.ndarray, free: Polygon) -> Iterator[Face]:
    """Yield the wall behind the edge ``a`` -> ``b``, in pieces where a sharp corner leaves it thin."""
    length = float(np.linalg.norm(b - a))
    along = (b - a) / length
    out = np.array([along[1], -along[0]])
    aside = min(_ASIDE, length / 4) * along
    probe = Polygon(
        [a + aside, b - aside, b - aside + 2 * OUTER_THICKNESS * out, a + aside + 2 * OUTER_THICKNESS * out]
    )
    behind = shapely.get_parts(probe.intersection(free))
    points = shapely.get_coordinates([part for part in behind if part.area > 1e-6])
    gap = float(np.min((points - a) @ out)) if len(points) else 2 * OUTER_THICKNESS
    if gap < 2 * THIN and length > 2 * PIECE:
        yield from _behind(a, (a + b) / 2, free)
        yield from _behind((a + b) / 2, b, free)
    else:
        yield Face(a, b, min(max(gap / 2, 0.01), OUTER_THICKNESS))


def _closed_corners(face: Face, free: Polygon) -> Face:
    """Return the face up to a thickness longer at ends where that stays behind other walls, to close corners."""
    allowed = free.intersection(face.body()).area + 1e-7
    reach = min(OUTER_THICKNESS, float(np.linalg.norm(face.end - face.start))) * face.along
    start, end = face.start - reach, face.end + reach
    at_start = free.intersection(Face(start, face.end, face.thickness).body()).area < allowed
    at_end = free.intersection(Face(face.start, end, face.thickness).body()).area < allowed
    return Face(start if at_start else face.start, end if at_end else face.end, face.thickness)


def square_corners(outline: Polygon) -> Polygon:
    """Return the outline without chamfers shorter than SHORT: its neighbours meet instead.

    Unchanged where that fails.
    """
    points = list(shapely.get_coordinates(outline.exterior)[:-1])
    i = 0
    while i < len(points) and len(points) > 4:
        p, a, b, q = (points[(i + k) % len(points)] for k in (-1, 0, 1, 2))
        u, v = a - p, q - b
        cross = float(u[0] * v[1] - u[1] * v[0])
        if np.linalg.norm(b - a) < SHORT and abs(cross) > 0.1 * np.linalg.norm(u) * np.linalg.norm(v):
            meet = a + u * float(((b - a)[0] * v[1] - (b - a)[1] * v[0]) / cross)
            if np.linalg.norm(meet - a) < 2 * SHORT and min(np.linalg.norm(u), np.linalg.norm(v)) > SHORT:
                points[i] = meet
                del points[(i + 1) % len(points)]
                continue
        i += 1
    squared = Polygon(points)
    return squared if squared.is_valid and abs(squared.area - outline.area) < 0.01 * outline.area else outline
