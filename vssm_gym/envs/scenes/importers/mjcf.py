"""Import MJCF with a floor: its geoms at their initial pose become upright boxes.

Boxes that stand upright are exact; spheres, capsules, cylinders, ellipsoids, tilted boxes and meshes become small
upright boxes (`vssm_gym.envs.scenes.importers.voxels`), so that rays, physics and free space keep one geometry. The
floor is a plane, or the largest flat box, that faces up at the lowest level; it moves to z = 0. Where the geoms enclose
rooms, the rooms are the floor; otherwise all of it is, and walls stand around it.
"""

import math
import zlib
from collections import defaultdict
from pathlib import Path

import numpy as np
import shapely
from shapely import Polygon

from vssm_gym.envs.physics import StaticGeom, static_geoms
from vssm_gym.envs.scenes.apartment import LEAST_FLOOR, Apartment
from vssm_gym.envs.scenes.apartment_parts import MAX_COORDINATE, Box, Furniture, Material, Room, Wall
from vssm_gym.envs.scenes.faults import misplaced, with_notes
from vssm_gym.envs.scenes.importers.mjcf_xml import StillModel
from vssm_gym.envs.scenes.importers.voxels import VOXEL_EDGE, bounds_of, inside_of, voxelised, voxelised_surface, yaw_of
from vssm_gym.envs.scenes.solids import footprint
from vssm_gym.envs.validation import validated
from vssm_gym.errors import InputError

MOST_BOXES = 20_000  # most of a scene
LEVEL = 0.02  # m; the floor's candidates within this of the lowest are one level
FLAT = 4.0  # a box is flat whose sides are this many times its height
ENDLESS_MARGIN = 1.0  # m of an endless floor around the outermost geom
HEADROOM = 2.6  # m, least height of the ceiling
ENCLOSING_HEIGHTS = (0.02, 1.0)  # m above the floor: geoms here enclose rooms
CLOSED_GAP = 0.1  # m; narrower gaps do not open a room
ENCLOSED = 2.0  # m^2 of an enclosed room
BORDER_THICKNESS = 0.1  # m, thickness of the walls around the floor
UPRIGHT = 1e-6  # of a unit vector's z: below 0.1 degrees


def import_mjcf(path: Path) -> Apartment:
    """Return the `Apartment` of an MJCF file; raise InputError naming the file and what is wrong or missing."""
    model = StillModel(path)
    geoms = static_geoms(model.xml, model.assets, path)
    notes = model.notes
    for geom in geoms:
        numbers = np.concatenate([geom.center, geom.size, geom.rgba, geom.vertices.ravel()])
        if not np.isfinite(numbers).all() or np.abs(numbers).max() > MAX_COORDINATE:
            raise InputError(path, f"geom {geom.name!r}", f"numbers within {MAX_COORDINATE:g} m")
        if geom.shape in ("hfield", "sdf"):
            raise InputError(path, f"geom {geom.name!r}", f"a shape with flat ground beside it; found {geom.shape}")
    unseen = [geom for geom in geoms if geom.rgba[3] == 0.0 and not geom.collides]
    geoms = [geom for geom in geoms if not any(geom is other for other in unseen)]
    floor = _floor(geoms, path)
    level = floor.center[2] + (floor.size[2] if floor.shape == "box" else 0.0)
    if abs(level) > 1e-9:
        notes.append(f"moved by {-level:.3f} m: the floor is z = 0")
    furniture = _furniture([geom for geom in geoms if geom is not floor], level, path, notes)
    tops = [box.center[2] + box.size[2] / 2 for piece in furniture for box in piece.boxes]
    ceiling = max([HEADROOM, *(top + 0.05 for top in tops)])
    rooms, walls = _rooms(floor, furniture, ceiling, path, notes)
    content = {
        "name": path.stem,
        "rooms": rooms,
        "walls": walls,
        "furniture": furniture,
        "ceiling_height": ceiling,
        "notes": notes,
    }
    return with_notes(validated(Apartment, content, path), misplaced)


def _floor(geoms: list[StaticGeom], path: Path) -> StaticGeom:
    """Return the floor: of the planes and flat boxes that face up at the lowest level the largest.

    Planes come first.
    """
    found = [
        geom
        for geom in geoms
        if geom.rotation[2, 2] > 1.0 - 1e-4
        and (geom.shape == "plane" or (geom.shape == "box" and min(geom.size[:2]) >= FLAT * geom.size[2]))
        and (geom.shape == "plane" or 4.0 * geom.size[0] * geom.size[1] >= LEAST_FLOOR)
    ]
    if not found:
        raise InputError(
            path, "worldbody", f"a floor: a plane or a flat box of at least {LEAST_FLOOR:g} m^2 that faces up"
        )
    tops = [geom.center[2] + (geom.size[2] if geom.shape == "box" else 0.0) for geom in found]
    lowest = [geom for geom, top in zip(found, tops, strict=True) if top <= min(tops) + LEVEL]
    return max(lowest, key=lambda geom: (geom.shape == "plane", geom.size[0] * geom.size[1]))


def _furniture(geoms: list[StaticGeom], level: float, path: Path, notes: list[str]) -> list[Furniture]:
    """Return one piece a geom, its z measured from the floor.

    Approximations and omissions are appended to ``notes``.
    """
    pieces: list[Furniture] = []
    used: dict[str, int] = defaultdict(int)
    total = cut = under = 0
    for i, geom in enumerate(geoms):
        boxes, exact = _boxes(geom, path)
        cut += not exact
        material = _material(geom, i)
        solid = []
        for center, size, yaw in boxes:
            low, high = center[2] - size[2] / 2 - level, center[2] + size[2] / 2 - level
            low = max(low, -0.05)  # geoms under the floor are not seen
            if high - low < 1e-4 or high <= 0.0:
                continue
            at = (float(center[0]), float(center[1]), float(low + high) / 2)
            sides = (float(size[0]), float(size[1]), float(high - low))
            box = {"center": at, "size": sides, "yaw": yaw, "material": material}
            solid.append(validated(Box, box, path, at=f"geom {geom.name!r}"))
        total += len(solid)
        if total > MOST_BOXES:
            raise InputError(path, "worldbody", f"geoms that make at most {MOST_BOXES:,} upright boxes")
        if solid:
            name = geom.name[:80] or geom.shape
            used[name] += 1
            unique = name if used[name] == 1 else f"{name} #{used[name]}"
            pieces.append(Furniture(name=unique, category=geom.shape, boxes=tuple(solid)))
        under += not solid
    if cut:
        notes.append(f"{cut} geoms that are no upright boxes were cut into upright boxes, {VOXEL_EDGE:g} m fine")
    if under:
        notes.append(f"left out: {under} geom{'s' * (under > 1)} under the floor, or with no more than its thickness")
    return pieces


def _boxes(geom: StaticGeom, path: Path) -> tuple[list[tuple[np.ndarray, np.ndarray, float]], bool]:
    """Return upright boxes (centre, size, yaw) of a geom, and True if they are exact."""
    shape, size, center = geom.shape, geom.size, geom.center
    if shape == "plane":  # one more than the floor: a slab under its surface
        if not (size[:2] > 0.0).all():
            raise InputError(path, f"geom {geom.name!r}", "a size: only the floor may be an endless plane")
        shape, size, center = "box", np.array([size[0], size[1], 0.02]), center - 0.02 * geom.rotation[:, 2]
    vertical = int(np.argmax(np.abs(geom.rotation[2])))
    if shape == "box" and abs(geom.rotation[2, vertical]) > 1.0 - UPRIGHT:
        first, second = (vertical + 1) % 3, (vertical + 2) % 3
        yaw = math.atan2(geom.rotation[1, first], geom.rotation[0, first])
        return [(center, 2.0 * np.maximum(size[[first, second, vertical]], 5e-4), yaw)], True
    if shape == "mesh":
        points = geom.vertices @ geom.rotation.T + center
        return [((a + b) / 2, b - a, 0.0) for a, b in voxelised_surface(points, geom.faces)], False
    if shape not in ("box", "sphere", "ellipsoid", "cylinder", "capsule"):
        raise InputError(
            path, f"geom {geom.name!r}", f"a box, sphere, ellipsoid, cylinder, capsule, mesh or plane; found {shape}"
        )
    corners = bounds_of(shape, size)
    yaw = yaw_of(geom.rotation, corners.max(axis=0))
    c, s = math.cos(yaw), math.sin(yaw)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    local = turn.T @ geom.rotation  # the geom's axes in the frame of the cells
    if shape == "sphere" or shape == "ellipsoid":
        reach = np.linalg.norm(local * corners.max(axis=0), axis=1)
    else:
        reach = np.abs(corners @ local.T).max(axis=0)
    inside = inside_of(shape, size)
    made = voxelised(-reach, reach, lambda p: inside(p @ local))
    return [(center + turn @ ((a + b) / 2), b - a, yaw) for a, b in made], False


def _material(geom: StaticGeom, number: int) -> Material:
    """Return the geom's colour, not quite black, on a texture that a hash of its name chooses."""
    color = np.clip(geom.rgba[:3], 0.08, 1.0).tolist()
    large = geom.shape in ("box", "plane", "mesh") and geom.size.max() > 1.0
    textures = ("plaster", "stucco", "wallpaper") if large else ("wood", "fabric", "stucco")
    texture = textures[zlib.crc32(f"{geom.name} {number}".encode()) % len(textures)]
    return Material(color=color, texture=texture, scale=1.5 if large else 0.6)


def _rooms(
    floor: StaticGeom, furniture: list[Furniture], height: float, path: Path, notes: list[str]
) -> tuple[list[Room], list[Wall]]:
    """Return the rooms, and walls around all of them; how the floor was found is appended to ``notes``."""
    ground = _ground(floor, furniture, path)
    color = np.clip(0.4 + 0.6 * floor.rgba[:3], 0.0, 1.0).tolist()
    material = Material(color=color, texture="tiles", scale=1.5)
    solid = [
        footprint(box)
        for piece in furniture
        for box in piece.boxes
        if box.center[2] + box.size[2] / 2 > ENCLOSING_HEIGHTS[0]
        and box.center[2] - box.size[2] / 2 < ENCLOSING_HEIGHTS[1]
    ]
    free = ground - shapely.union_all(solid).buffer(CLOSED_GAP / 2, join_style="mitre")
    rim = ground.exterior.buffer(1e-3)
    enclosed = [p for p in shapely.get_parts(free) if p.area >= ENCLOSED and not p.intersects(rim)]
    if enclosed:
        # Back under the walls by more than the gap; whatever a room surrounds is solid or a room of its own.
        outlines = [Polygon(p.exterior).buffer(CLOSED_GAP, join_style="mitre").simplify(0.01) for p in enclosed]
        outlines = [Polygon(max(shapely.get_parts(outline), key=lambda p: p.area).exterior) for outline in outlines]
        outlines.sort(key=lambda outline: outline.area)
        notes.append(f"only what the geoms enclose is floor: {len(outlines)} room{'s' * (len(outlines) > 1)}")
        ground = shapely.box(*shapely.union_all(outlines).buffer(ENDLESS_MARGIN).bounds)
    else:
        outlines = [ground]
        notes.append("nothing encloses the floor: walls were put around it")
    rooms = [
        Room(name=f"Floor {i}", kind="room", polygon=_corners(outline), floor=material)
        for i, outline in enumerate(outlines, 1)
    ]
    return rooms, _edge(ground, height)


def _corners(outline: Polygon) -> tuple[tuple[float, float], ...]:
    return tuple((float(x), float(y)) for x, y in shapely.get_coordinates(outline.exterior)[:-1])


def _ground(floor: StaticGeom, furniture: list[Furniture], path: Path) -> Polygon:
    """Return the floor's rectangle; that of an endless plane goes ENDLESS_MARGIN beyond what stands on it."""
    half = floor.size[:2].copy()
    if (half > 0.0).all():
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * half
        return Polygon(corners @ floor.rotation[:2, :2].T + floor.center[:2])
    plans = [footprint(box) for piece in furniture for box in piece.boxes]
    if not plans:
        raise InputError(path, "worldbody", "geoms on the floor or a floor of finite size")
    x0, y0, x1, y1 = shapely.union_all(plans).bounds
    return shapely.box(x0 - ENDLESS_MARGIN, y0 - ENDLESS_MARGIN, x1 + ENDLESS_MARGIN, y1 + ENDLESS_MARGIN)


def _edge(ground: Polygon, height: float) -> list[Wall]:
    """Return walls outside the floor's edges, so that no robot and no ray leaves the scene."""
    material = Material(color=(0.75, 0.72, 0.68), texture="concrete", scale=1.0)
    corners = shapely.get_coordinates(ground.buffer(BORDER_THICKNESS / 2, join_style="mitre").exterior)
    corners = corners[np.linalg.norm(np.diff(corners, axis=0, append=corners[:1]), axis=1) > 1e-6]
    return [
        Wall(start=a, end=b, thickness=BORDER_THICKNESS, height=height, front=material, back=material)
        for a, b in zip(corners.tolist(), np.roll(corners, -1, axis=0).tolist(), strict=True)
    ]
