"""Describe the floor of a room of any outline by an axis-parallel one inside of it, on which furniture is placed.

A plan from a file has walls that run askew, bends of a centimetre and corners cut off. Lines through its corners make a
grid; the ground is the union of the grid's cells that are free from wall to wall. Lines closer than `_JOG` count as one
thick line, so that a wall with small bends is straight, along the part of it that stands furthest into the room.
"""

import itertools

import numpy as np
import shapely
from jaxtyping import Bool, Float
from shapely import Polygon

from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.envs.scenes.apartment_parts import Room
from vssm_gym.envs.scenes.generator.ground import BACK_GAP, Edge, Ground, kept_free
from vssm_gym.envs.scenes.importers.rectangles import cover
from vssm_gym.envs.scenes.solids import SolidBox, footprint

_JOG = 0.03  # m, bends of a wall up to which it counts as straight
_THICKEST_LINE = 0.06  # m, lines that count as one together
_ASKEW_STEP = 0.1  # m between the lines through a wall that runs askew
_MOST_LINES = 400  # either way; the plans of HouseExpo have a hundred
_MOST_CORNERS = 160  # of a ground; the most of a HouseExpo plan at hand are 112, along a wall askew
_LEAST_GROUND, _MOST_BOUNDS = 1.0, 150.0  # m^2 of a room that is furnished, and of the rectangle around it
_AROUND = 0.2  # m of wall around the outline
_TOLERANCE = 1e-4  # m by which a cell may reach over the free floor: files round


def plan_ground(apartment: Apartment, boxes: list[SolidBox], room: Room) -> Ground | None:
    """Return the ground of a room; None where it is smaller or larger than a home's, or has too many corners.

    Everything outside of the ground counts as wall, up to the ceiling; the room's doorways are before the door's face.

    Args:
        apartment: a plan without furniture.
        boxes: the apartment's boxes.
        room: one of its rooms, of any outline.
    """
    free = _free_floor(apartment, boxes, room)
    if free.area < _LEAST_GROUND or free.envelope.area > _MOST_BOUNDS:
        return None
    lines = [_lines(free, axis) for axis in range(2)]
    if max(len(along) for along in lines) > 2 * _MOST_LINES:
        return None
    kept = _kept(free, lines)
    outline = _largest(lines, kept)
    if outline is None or len(outline.exterior.coords) > _MOST_CORNERS:
        return None
    corners = np.round(shapely.get_coordinates(outline.exterior)[:-1], 6)
    x, y = lines
    blocked = ~_inside(outline, lines)
    rows = [
        (x[i0], y[j0], 0.0, x[i1], y[j1], apartment.ceiling_height)
        for i0, i1, j0, j1 in cover(blocked, blocked)
        if x[i1] > x[i0] and y[j1] > y[j0]
    ]
    closed, entries = kept_free(apartment, corners, 0.5)
    sides = enumerate(itertools.pairwise([*corners, corners[0]]))
    edges = [Edge(a, b, 0.0, side) for side, (a, b) in sides]
    return Ground(corners, np.round(np.array(rows), 6), closed, entries, edges, BACK_GAP)


def _free_floor(apartment: Apartment, boxes: list[SolidBox], room: Room) -> Polygon:
    """Return the largest part of the room's floor between walls and leaves, up to the faces of the walls with doors."""
    floor = Polygon(room.polygon)
    shapely.prepare(floor)
    standing = [footprint(box) for box in boxes if box.kind in ("wall", "door", "window")]
    for door in apartment.doors:
        wall = apartment.walls[door.wall]
        standing.append(
            shapely.LineString([wall.start, wall.end]).buffer(
                0.5 * wall.thickness, cap_style="square", join_style="mitre"
            )
        )
    near = [shape for shape in standing if floor.intersects(shape)]
    parts = shapely.get_parts(floor.difference(shapely.union_all(near)).simplify(_TOLERANCE))
    return max((part for part in parts if isinstance(part, Polygon)), key=lambda part: part.area, default=Polygon())


def _lines(free: Polygon, axis: int) -> Float[np.ndarray, "lines"]:
    """Return the coordinates (m, ascending) of the grid's lines across an axis, two for each thick line."""
    values: list[float] = []
    for ring in (free.exterior, *free.interiors):
        corners = shapely.get_coordinates(ring)
        values += corners[:, axis].tolist()
        for a, b in itertools.pairwise(corners):
            if np.abs(b - a).min() > _JOG:  # askew
                count = int(np.ceil(np.linalg.norm(b - a) / _ASKEW_STEP))
                values += (a[axis] + (b - a)[axis] * np.arange(1, count) / count).tolist()
    thick: list[list[float]] = []
    for value in sorted(values):
        if thick and value - thick[-1][1] < _JOG and value - thick[-1][0] < _THICKEST_LINE:
            thick[-1][1] = value
        else:
            thick.append([value, value])
    inner = np.round(np.array(thick).reshape(-1), 6)
    return np.array([inner[0] - _AROUND, *inner, inner[-1] + _AROUND])


def _boxes(lines: list[np.ndarray]) -> np.ndarray:
    """Return the cells between the lines as polygons, (columns, rows)."""
    (x0, y0), (x1, y1) = ([along[:-1] for along in lines], [along[1:] for along in lines])
    return shapely.box(x0[:, None], y0[None], x1[:, None], y1[None])


def _kept(free: Polygon, lines: list[np.ndarray]) -> Bool[np.ndarray, "columns rows"]:
    """Return which cells are free, of thick lines only those between free cells."""
    cells = _boxes(lines)
    room = free.buffer(_TOLERANCE, join_style="mitre")
    shapely.prepare(room)
    kept = shapely.covers(room, cells)
    # Cells alternate: those with an odd index lie inside a thick line, which may have no width.
    kept[1:-1:2] = _covered(room, cells[1:-1:2]) & kept[:-2:2] & kept[2::2]
    kept[:, 1:-1:2] = _covered(room, cells[:, 1:-1:2]) & kept[:, :-2:2] & kept[:, 2::2]
    return kept


def _covered(room: Polygon, cells: np.ndarray) -> Bool[np.ndarray, "columns rows"]:
    return (shapely.area(cells) < _TOLERANCE**2) | shapely.covers(room, cells)


def _largest(lines: list[np.ndarray], kept: Bool[np.ndarray, "columns rows"]) -> Polygon | None:
    """Return the largest connected part of the cells, counter-clockwise, without what is narrower than a thick line."""
    cells = _boxes(lines)[kept]
    whole = shapely.union_all(cells[shapely.area(cells) > 0.0])
    parts = [part for part in shapely.get_parts(whole) if isinstance(part, Polygon)]
    best = max(parts, key=lambda part: part.area, default=Polygon())
    if best.area < _LEAST_GROUND:
        return None
    return Polygon(shapely.orient_polygons(best).simplify(0.0).exterior)


def _inside(outline: Polygon, lines: list[np.ndarray]) -> Bool[np.ndarray, "columns rows"]:
    """Return which cells lie in the outline."""
    x, y = (0.5 * (along[:-1] + along[1:]) for along in lines)
    shapely.prepare(outline)
    return np.asarray(shapely.intersects_xy(outline, *np.meshgrid(x, y, indexing="ij")))
