"""Find faults of a scene that can be used all the same, such as open edges or misplaced objects; report, not repair.

Each check returns sentences that name an item and its fault; :func:`with_notes` puts them into the scene's notes and
warns once. A scene that cannot be used is refused elsewhere, by the fields' types or the importers.
"""

import warnings
from collections.abc import Callable

import shapely

from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.envs.scenes.apartment_parts import ROUNDING
from vssm_gym.envs.scenes.solids import Solid, footprint

WALL_GAP = 0.05  # m; shorter gaps between walls let no robot through
# m above the floor that a wall, or furniture in its place, spans to close an edge; no higher than
# the ceiling: mazes are a tenth of a metre high
CLOSING_HEIGHTS = (0.1, 0.3)
EDGE_REACH = 0.02  # m between an edge and its wall: files round
TOUCH = 0.05  # m; nearer things hold each other
LARGE_THING = 0.5  # m; a smaller thing in the air stood on something that is no box: a chair's seat, a sink's rim
MOST_SENTENCES = 20  # sentences of one check; more are counted

Check = Callable[[Apartment], list[str]]


class SceneWarning(UserWarning):
    """Warn of a fault of a scene, or of a part that no robot reaches; sweeps and commands show it as a notice."""


def with_notes(apartment: Apartment, *checks: Check) -> Apartment:
    """Return the apartment with the findings of the checks in its ``notes``, after one warning with the same text."""
    found: list[str] = []
    for check in checks:
        sentences = check(apartment)
        found += sentences[:MOST_SENTENCES] + [f"and {len(sentences) - MOST_SENTENCES} more of the same kind"] * (
            len(sentences) > MOST_SENTENCES
        )
    if not found:
        return apartment
    warnings.warn(f"{apartment.name}: {'; '.join(found)}", category=SceneWarning, stacklevel=3)
    new = [sentence for sentence in found if sentence not in apartment.notes]  # a scene imported and saved has them
    return apartment.model_copy(update={"notes": (*apartment.notes, *new)})


def open_edges(apartment: Apartment) -> list[str]:
    """Return a sentence for each room's edge, or part of one, without a wall or furniture in its place.

    Doors are holes in walls: their edges are closed. Robots leave the floor through an open edge at the outside, and
    rays the scene.
    """
    low, high = (
        min(CLOSING_HEIGHTS[0], 0.5 * apartment.ceiling_height),
        min(CLOSING_HEIGHTS[1], apartment.ceiling_height - ROUNDING),
    )
    closing = [
        shapely.LineString([wall.start, wall.end]).buffer(wall.thickness / 2 + EDGE_REACH, cap_style="square")
        for wall in apartment.walls
        if wall.base <= low and wall.base + wall.height >= high
    ]
    closing += [
        footprint(box).buffer(EDGE_REACH)
        for piece in apartment.furniture
        for box in piece.boxes
        if _low(box) <= low and _high(box) >= high
    ]
    tree = shapely.STRtree(closing)
    found = []
    for room in apartment.rooms:
        for a, b in zip(room.polygon, [*room.polygon[1:], room.polygon[0]], strict=True):
            edge = shapely.LineString([a, b])
            beside = shapely.union_all([closing[i] for i in tree.query(edge)])
            for part in shapely.get_parts(edge.difference(beside)):
                if part.length > WALL_GAP:
                    (x0, y0), (x1, y1) = shapely.get_coordinates(part)[[0, -1]].tolist()
                    found.append(
                        f"{room.name} has no wall along {part.length:.2f} m of its edge, "
                        f"from ({x0:.2f}, {y0:.2f}) to ({x1:.2f}, {y1:.2f})"
                    )
    return found


def misplaced(apartment: Apartment) -> list[str]:
    """Return a sentence for each piece of furniture that no robot could meet.

    It lies off all rooms, under the floor or above the ceiling, or has no extent. It stays where it is: images show it
    where the file has it.
    """
    floor = shapely.union_all([shapely.Polygon(room.polygon) for room in apartment.rooms])
    shapely.prepare(floor)
    found = []
    for piece in apartment.furniture:
        low, high = min(map(_low, piece.boxes)), max(map(_high, piece.boxes))
        if not any(floor.intersects(footprint(box)) for box in piece.boxes):
            found.append(f"{piece.name} is outside the walls")
        elif high < 0.0:
            found.append(f"{piece.name} is under the floor")
        elif low > apartment.ceiling_height:
            found.append(f"{piece.name} is above the ceiling")
        elif max(extent for box in piece.boxes for extent in box.size) < 1e-3:
            found.append(f"{piece.name} is smaller than 1 mm")
    return found


def floating(apartment: Apartment) -> list[str]:
    """Return a sentence for each large piece of furniture in the air.

    Neither on the floor nor next to what could hold it.
    """
    boxes = apartment.boxes()
    plans = [footprint(box) for box in boxes]
    tree = shapely.STRtree(plans)
    found = []
    for piece in apartment.furniture:
        low, high = min(map(_low, piece.boxes)), max(map(_high, piece.boxes))
        if low <= TOUCH or max(extent for box in piece.boxes for extent in box.size) < LARGE_THING:
            continue
        plan = shapely.union_all([footprint(box) for box in piece.boxes]).buffer(TOUCH)
        near = [boxes[i] for i in tree.query(plan, predicate="intersects") if boxes[i].name != piece.name]
        if not any(_low(box) <= high + TOUCH and _high(box) >= low - TOUCH for box in near):
            found.append(f"{piece.name} hangs in the air, {low:.2f} m above the floor")
    return found


def _low(box: Solid) -> float:
    return box.center[2] - box.size[2] / 2


def _high(box: Solid) -> float:
    return box.center[2] + box.size[2] / 2
