"""Cut everything solid in an apartment into upright boxes: the one geometry of physics, images and free space."""

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
import shapely
from jaxtyping import Float

from vssm_gym.envs.scenes.apartment_parts import Door, Furniture, Material, Room, Wall, Window

Kind = Literal["floor", "ceiling", "wall", "door", "window", "furniture"]

SLAB = 0.1  # m, thickness of floor and ceiling
SLAB_MARGIN = 0.3  # m that floor and ceiling reach beyond the walls' centre lines
LEAF = 0.04  # m, thickness of a door's leaf
PANE = 0.02  # m, thickness of a window's pane
FLOOR_STEP = 0.25  # m, resolution of the border between two floors where it is not parallel to x or y
CUTS = 1000  # corner coordinates along an axis; where there are more the border of floors has FLOOR_STEP everywhere
_HIDE = 1e-3  # m by which a wall stays inside the one it runs into, so that no two faces coincide


@dataclass(frozen=True)
class SolidBox:
    """Define an upright solid box in the world frame.

    ``center`` (x, y, z) m, ``size`` full extents m along the box's own axes, ``yaw`` rad about z.
    ``name`` is the item it belongs to: a room for floors, "wall 3", "door 0", "window 1", or the piece of furniture.
    """

    name: str
    kind: Kind
    center: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw: float
    material: Material


class Solid(Protocol):
    """Have the geometry of an upright box of furniture or of the building."""

    @property
    def center(self) -> tuple[float, float, float]:
        """Return (x, y, z) m, world frame."""

    @property
    def size(self) -> tuple[float, float, float]:
        """Return the full extents m along its own axes."""

    @property
    def yaw(self) -> float:
        """Return the rotation about z, rad."""


class Building(Protocol):
    """Have an apartment's parts; see :class:`vssm_gym.envs.scenes.apartment.Apartment` for them."""

    @property
    def rooms(self) -> tuple[Room, ...]:
        """Return the rooms, which tile the floor."""

    @property
    def walls(self) -> tuple[Wall, ...]:
        """Return the walls; doors and windows name theirs by index."""

    @property
    def doors(self) -> tuple[Door, ...]:
        """Return the holes with leaves."""

    @property
    def windows(self) -> tuple[Window, ...]:
        """Return the holes with panes."""

    @property
    def furniture(self) -> tuple[Furniture, ...]:
        """Return the pieces made of boxes."""

    @property
    def ceiling_height(self) -> float:
        """Return the height of the ceiling's underside, m."""

    @property
    def ceiling(self) -> Material:
        """Return the ceiling's material."""


def footprint(box: Solid) -> shapely.Polygon:
    """Return the rectangle that a box covers on the floor, world frame."""
    half = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * box.size[:2]
    c, s = math.cos(box.yaw), math.sin(box.yaw)
    return shapely.Polygon(half @ np.array([[c, s], [-s, c]]) + box.center[:2])


def solid_boxes(apartment: Building) -> list[SolidBox]:
    """Return floor slabs (top at z = 0), ceiling, walls around their holes, leaves, panes, furniture, in this order."""
    boxes = [*_floor(apartment), _ceiling(apartment)]
    holes: dict[int, list[Door | Window]] = defaultdict(list)
    openings: list[Door | Window] = [*apartment.doors, *apartment.windows]
    for hole in openings:
        holes[hole.wall].append(hole)
    for index, reach in enumerate(_reaches(apartment)):
        boxes += _wall(apartment.walls[index], index, reach, sorted(holes[index], key=lambda hole: hole.offset))
    for i, door in enumerate(apartment.doors):
        boxes += door_leaves(f"door {i}", apartment.walls[door.wall], door)
    for i, window in enumerate(apartment.windows):
        boxes.append(_pane(f"window {i}", apartment.walls[window.wall], window))
    for piece in apartment.furniture:
        boxes += [SolidBox(piece.name, "furniture", b.center, b.size, b.yaw, b.material) for b in piece.boxes]
    return boxes


def _extent(apartment: Building) -> tuple[np.ndarray, np.ndarray]:
    points = [p for room in apartment.rooms for p in room.polygon]
    points += [p for wall in apartment.walls for p in (wall.start, wall.end)]
    return np.min(points, axis=0) - SLAB_MARGIN, np.max(points, axis=0) + SLAB_MARGIN


def _floor(apartment: Building) -> list[SolidBox]:
    """Tile the apartment's bounding rectangle with slabs, without gap or overlap, each with its room's floor.

    The rectangle is cut at every corner coordinate (up to CUTS of them), finer where a room has a slanted edge; a cell
    belongs to the first room that contains its centre (to the first room of all where none does: that ground is outside
    the walls), and runs of cells of one room merge into one slab.
    """
    low, high = _extent(apartment)
    cuts = []
    for axis in range(2):
        values = {low[axis], high[axis]} | {p[axis] for room in apartment.rooms for p in room.polygon}
        crowded = len(values) > CUTS
        if crowded:
            values = {low[axis], high[axis]}
        if crowded or any(_slanted(room.polygon) for room in apartment.rooms):
            values |= set(np.arange(low[axis], high[axis], FLOOR_STEP).tolist())
        ordered = sorted(values)
        cuts.append(np.array([v for v, w in zip(ordered, [-math.inf, *ordered[:-1]], strict=True) if v - w > 1e-6]))
    xs, ys = cuts
    cx, cy = np.meshgrid((xs[1:] + xs[:-1]) / 2, (ys[1:] + ys[:-1]) / 2, indexing="ij")
    owner = np.zeros(cx.shape, int)
    for i in reversed(range(len(apartment.rooms))):
        outline = shapely.Polygon(apartment.rooms[i].polygon)
        shapely.prepare(outline)
        x0, y0, x1, y1 = outline.bounds
        block = np.s_[slice(*np.searchsorted(xs, (x0, x1))), slice(*np.searchsorted(ys, (y0, y1)))]
        owner[block][shapely.contains_xy(outline, cx[block], cy[block])] = i
    return [
        _span(
            apartment.rooms[o].name, "floor", (xs[x0], ys[y0], -SLAB), (xs[x1], ys[y1], 0.0), apartment.rooms[o].floor
        )
        for x0, x1, y0, y1, o in _merge(owner)
    ]


def _slanted(polygon: tuple[tuple[float, float], ...]) -> bool:
    edges = np.abs(np.diff([*polygon, polygon[0]], axis=0))
    return bool((edges.min(axis=1) > 1e-6).any())


def _merge(owner: np.ndarray) -> list[tuple[int, int, int, int, int]]:
    """Tile the grid with greedy rectangles (x0, x1, y0, y1, owner), half open, that are uniform in owner."""
    free = np.ones(owner.shape, bool)
    rectangles = []
    for x0, y0 in np.ndindex(owner.shape):
        if not free[x0, y0]:
            continue
        fits = free & (owner == owner[x0, y0])
        y1 = y0 + 1
        while y1 < owner.shape[1] and fits[x0, y1]:
            y1 += 1
        x1 = x0 + 1
        while x1 < owner.shape[0] and fits[x1, y0:y1].all():
            x1 += 1
        free[x0:x1, y0:y1] = False
        rectangles.append((x0, x1, y0, y1, int(owner[x0, y0])))
    return rectangles


def _ceiling(apartment: Building) -> SolidBox:
    low, high = _extent(apartment)
    bottom = apartment.ceiling_height
    return _span("ceiling", "ceiling", (*low, bottom), (*high, bottom + SLAB), apartment.ceiling)


def _span(name: str, kind: Kind, low: tuple, high: tuple, material: Material) -> SolidBox:
    center = tuple(float(a + b) / 2 for a, b in zip(low, high, strict=True))
    size = tuple(float(b - a) for a, b in zip(low, high, strict=True))
    return SolidBox(name, kind, center, size, 0.0, material)  # type: ignore[arg-type]


def _place(wall: Wall, along: float, across: float, z: float) -> tuple[float, float, float]:
    """Return the world point of (metres along start -> end, metres to the left of it, z)."""
    c, s = math.cos(wall.yaw), math.sin(wall.yaw)
    return (wall.start[0] + c * along - s * across, wall.start[1] + s * along + c * across, z)


def _wall(wall: Wall, index: int, reach: tuple[float, float], holes: Sequence[Door | Window]) -> list[SolidBox]:
    """Return the wall's solid parts: between holes, below sills and above lintels.

    Two layers where its sides differ.
    """
    top = wall.base + wall.height
    parts: list[tuple[float, float, float, float]] = []
    at = -reach[0]
    for hole in holes:
        end = hole.offset + hole.width
        parts.append((at, hole.offset, wall.base, top))
        parts.append((hole.offset, end, wall.base, wall.base + hole.sill))
        parts.append((hole.offset, end, wall.base + hole.sill + hole.height, top))
        at = end
    parts.append((at, wall.length + reach[1], wall.base, top))

    half = wall.thickness / 2
    layers = [(-half, half, wall.front)]
    if wall.front != wall.back:
        layers = [(0.0, half, wall.front), (-half, 0.0, wall.back)]
    boxes = []
    for a, b, z0, z1 in parts:
        if b - a < 1e-6 or z1 - z0 < 1e-6:
            continue
        for low, high, material in layers:
            center = _place(wall, (a + b) / 2, (low + high) / 2, (z0 + z1) / 2)
            boxes.append(SolidBox(f"wall {index}", "wall", center, (b - a, high - low, z1 - z0), wall.yaw, material))
    return boxes


def _reaches(apartment: Building) -> list[tuple[float, float]]:
    """Return how far each wall extends beyond its start and its end to close the corners with other walls, m."""
    walls = apartment.walls
    lines = shapely.linestrings([[wall.start, wall.end] for wall in walls])
    tree = shapely.STRtree(lines)
    yaws, halves = np.array([wall.yaw for wall in walls]), np.array([wall.thickness / 2 for wall in walls])
    reaches = []
    for at_end in (False, True):
        tips = shapely.points([wall.end if at_end else wall.start for wall in walls])
        index, other = tree.query(tips, predicate="dwithin", distance=0.01)
        index, other = index[index != other], other[index != other]
        reach = np.zeros(len(walls))
        # Up to the other wall's far face, h at right angles; h tan(angle / 2) where a blunt corner would jut out.
        cosine = np.abs(np.cos(yaws[other] - yaws[index]))
        blunt = np.where(cosine < 1e-9, 1.0, np.sqrt((1.0 - cosine) / (1.0 + cosine)))
        np.maximum.at(reach, index, blunt * halves[other] - _HIDE)
        straight = np.abs(np.sin(yaws[other] - yaws[index])) < 0.1
        reach[index[straight]] = 0.0  # another wall continues it: the corner is closed already
        reaches.append(reach.tolist())
    return list(zip(*reaches, strict=True))


def door_leaves(name: str, wall: Wall, door: Door) -> list[SolidBox]:
    """Return leaves as thick as LEAF, flush with the wall's face on the side they swing to, hinged on that face."""
    hinges = ((), (door.hinge,), ("start", "end"))[door.leaves]
    if not hinges:
        return []
    width, thickness = door.width / len(hinges), min(LEAF, wall.thickness)
    side = 1.0 if door.swing == "front" else -1.0
    boxes = []
    for hinge in hinges:
        sense = 1.0 if hinge == "start" else -1.0
        angle = sense * side * door.openness * math.pi / 2
        c, s = math.cos(angle), math.sin(angle)
        x, y = sense * width / 2, -side * thickness / 2  # centre of the closed leaf as seen from its hinge
        pivot = door.offset if hinge == "start" else door.offset + door.width
        along, across = pivot + c * x - s * y, side * wall.thickness / 2 + s * x + c * y
        center = _place(wall, along, across, wall.base + door.height / 2)
        boxes.append(SolidBox(name, "door", center, (width, thickness, door.height), wall.yaw + angle, door.material))
    return boxes


def _pane(name: str, wall: Wall, window: Window) -> SolidBox:
    center = _place(wall, window.offset + window.width / 2, 0.0, wall.base + window.sill + window.height / 2)
    size = (window.width, min(PANE, wall.thickness), window.height)
    return SolidBox(name, "window", center, size, wall.yaw, window.material)


def signed_distance(
    points: Float[np.ndarray, "n 3"], boxes: Sequence[SolidBox], within: float = np.inf
) -> Float[np.ndarray, "n"]:
    """Return the distance (m) to the nearest face of any box, negative inside a box; exact outside of all.

    Args:
        points: world frame, m.
        boxes: solid.
        within: m; a larger distance may be returned as infinity, which saves time.
    """
    nearest = np.full(len(points), np.inf)
    for box in boxes:
        reach = 0.5 * float(np.linalg.norm(box.size)) + within
        near = np.flatnonzero((np.abs(points - np.array(box.center)) <= reach).all(axis=1))
        d, c, s = points[near] - np.array(box.center), np.cos(box.yaw), np.sin(box.yaw)
        local = np.stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0], d[:, 2]], axis=-1)
        q = np.abs(local) - 0.5 * np.array(box.size)
        outside = np.linalg.norm(np.maximum(q, 0.0), axis=1)
        nearest[near] = np.minimum(nearest[near], outside + np.minimum(q.max(axis=1), 0.0))
    return nearest
