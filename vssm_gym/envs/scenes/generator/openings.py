"""Place doors and windows by seed: doors near corners and clear of each other, windows where wall is left."""

import itertools
import math

import numpy as np
import shapely

from vssm_gym.envs.scenes.apartment_parts import XY
from vssm_gym.envs.scenes.generator.floorplan import DoorPlan, RoomPlan, WindowPlan
from vssm_gym.envs.scenes.generator.furniture.pieces import cm, pick

NIB = 0.1  # m of wall between a door and the corner: too narrow for any robot
_STEP = 0.1  # m between the places tried
_SIZES = {"bathroom": (0.6, 0.6, 1.5), "storage": (0.5, 0.5, 1.6), "kitchen": (1.2, 1.0, 1.2), "hall": (0.8, 1.2, 0.9)}


class NoPlan(Exception):  # noqa: N818 - a draw that is repeated, no error
    """Signal that a drawn plan has no place for one of its doors."""


def place_doors(
    rng: np.random.Generator, rooms: tuple[RoomPlan, ...], links: list[tuple[str, str | None, str]], thickness: float
) -> tuple[DoorPlan, ...]:
    """Place a door for every link, none in the swing of another.

    Raises:
        NoPlan: one finds no place.
    """
    by_name = {room.name: room for room in rooms}
    doors: list[DoorPlan] = []
    zones: list[shapely.Polygon] = []
    # Entrances and wide openings have least choice: first.
    for first, second, what in sorted(links, key=lambda link: ("entrance", "opening", "door").index(link[2])):
        a, b = by_name[first], by_name.get(second or "")
        small = a.kind in ("bathroom", "storage")
        width = {"entrance": cm(rng, 0.9, 1.0), "opening": cm(rng, 1.0, 1.2)}.get(
            what, cm(rng, 0.75, 0.85) if small else cm(rng, 0.8, 0.95)
        )
        into = None if what == "opening" else first
        places = []
        for start, end in _shared(a, b, rooms):
            length = math.dist(start, end)
            u = ((end[0] - start[0]) / length, (end[1] - start[1]) / length)
            margin = 0.5 * thickness + NIB + 0.5 * width
            if length < 2 * margin:
                continue
            ends = [margin, length - margin]
            # A hinge within NIB of the corner or so far that a robot passes behind the leaf.
            inner = np.arange(margin + 0.5, length - margin - 0.5, _STEP).tolist()
            places += [(0, u, start, s) for s in ends] + [(1, u, start, s) for s in inner]
        order = rng.permutation(len(places))
        wanted = 0 if what == "door" else 1
        for i in sorted(order.tolist(), key=lambda i: abs(places[i][0] - wanted)):
            _, u, start, s = places[i]
            at = (round(start[0] + s * u[0], 3), round(start[1] + s * u[1], 3))
            zone = _zone(at, u, width, into is not None, thickness)
            if not any(zone.intersects(other) for other in zones):
                doors.append(DoorPlan(at, (first, second), width, into))
                zones.append(zone)
                break
        else:
            raise NoPlan(f"no door between {first} and {second or 'outside'}")
    return tuple(doors)


def _zone(at: XY, u: XY, width: float, swings: bool, thickness: float) -> shapely.Polygon:
    """Return the floor that a door needs on both sides of the wall: its swing, or a step."""
    across = 0.5 * thickness + (width if swings else 0.5)
    dx, dy = abs(u[0]) * 0.5 * width + abs(u[1]) * across, abs(u[1]) * 0.5 * width + abs(u[0]) * across
    return shapely.box(at[0] - dx, at[1] - dy, at[0] + dx, at[1] + dy)


def _shared(a: RoomPlan, b: RoomPlan | None, rooms: tuple[RoomPlan, ...]) -> list[tuple[XY, XY]]:
    """Return straight stretches of wall between two rooms, or between a room and the outside.

    Ends in increasing order.
    """
    outline = shapely.Polygon(a.polygon).exterior
    if b is not None:
        line = outline.intersection(shapely.Polygon(b.polygon).exterior)
    else:
        line = outline.difference(
            shapely.union_all([shapely.Polygon(r.polygon).exterior for r in rooms if r.name != a.name])
        )
    cuts = {p for room in rooms for p in room.polygon}
    found = []
    for part in shapely.get_parts(shapely.line_merge(line) if line.geom_type == "MultiLineString" else line):
        if part.geom_type != "LineString":
            continue
        for p, q in itertools.pairwise(part.simplify(1e-6).coords):
            p, q = sorted(((round(p[0], 3), round(p[1], 3)), (round(q[0], 3), round(q[1], 3))))
            # A wall ends wherever another room's corner meets it.
            inside = sorted(c for c in cuts if p < c < q and (c[0] == p[0] == q[0] or c[1] == p[1] == q[1]))
            found += list(itertools.pairwise([p, *inside, q]))
    return sorted(found)


def place_windows(
    rng: np.random.Generator, rooms: tuple[RoomPlan, ...], doors: tuple[DoorPlan, ...]
) -> tuple[WindowPlan, ...]:
    """Place one window for every 3 m or so of outer wall, clear of the doors.

    Halls, baths and stores have one at most.
    """
    windows = []
    for room in rooms:
        width, height, sill = _SIZES.get(room.kind, (0.0, 1.3, 0.9))
        most = 1 if room.kind in ("bathroom", "storage", "hall") else 4
        stretches = [pq for pq in _shared(room, None, rooms) if math.dist(*pq) > 1.2]
        for start, end in sorted(stretches, key=lambda pq: -math.dist(*pq)):
            length = math.dist(start, end)
            count = max(1, round(length / 3.2))
            for k in range(count):
                if most == 0:
                    break
                w = width or cm(rng, 1.0, 1.7, 0.1)
                w = min(w, math.floor((length / count - 0.6) * 10) / 10)
                s = round((k + 0.5) * length / count, 2)
                at = (
                    round(start[0] + s * (end[0] - start[0]) / length, 3),
                    round(start[1] + s * (end[1] - start[1]) / length, 3),
                )
                if w >= 0.5 and all(math.dist(at, door.at) > 0.5 * (w + door.width) + 0.15 for door in doors):
                    windows.append(WindowPlan(at, round(w, 2), height, sill))
                    most -= 1
    return tuple(windows) if windows else (_any_window(rng, rooms),)


def _any_window(rng: np.random.Generator, rooms: tuple[RoomPlan, ...]) -> WindowPlan:
    stretches = _shared(rooms[0], None, rooms)
    start, end = pick(rng, stretches)
    return WindowPlan((0.5 * (start[0] + end[0]), 0.5 * (start[1] + end[1])), 0.6, 0.6, 1.5)
