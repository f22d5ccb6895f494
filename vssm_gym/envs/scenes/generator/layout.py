"""Draw floor plans by seed: rooms in two strips along a corridor, around a living room, or a few rooms in a block.

All lengths are whole decimetres; a plan is drawn with the corridor along x and then mirrored and turned at random.
`layout` raises `NoPlan` where the doors of a draw do not fit; the caller draws again.
"""

import math
from collections.abc import Callable

import numpy as np

from vssm_gym.envs.scenes.apartment_parts import XY
from vssm_gym.envs.scenes.generator import looks
from vssm_gym.envs.scenes.generator.floorplan import BuildingPlan, DoorPlan, RoomPlan, WindowPlan
from vssm_gym.envs.scenes.generator.furniture.pieces import cm, pick
from vssm_gym.envs.scenes.generator.openings import NoPlan, place_doors, place_windows

Polygon = tuple[XY, ...]
Rooms = list[tuple[str, str, Polygon]]
"""Name, kind and outline."""
Links = list[tuple[str, str | None, str]]
"""Which rooms are joined, and by what: "door" (swings into the first), "opening", "entrance" (the second None)."""

# Along the corridor, m: narrowest and widest.
_WIDTHS = {
    "living room": (4.4, 6.0),
    "kitchen": (2.8, 3.6),
    "dining room": (3.0, 3.8),
    "bedroom": (3.2, 4.2),
    "kids room": (2.8, 3.6),
    "study": (2.6, 3.4),
    "bathroom": (2.0, 2.6),
    "storage": (1.8, 2.2),
}
# Public rooms on one side, private ones on the other, by the number of rooms without the corridor.
_STRIPS = {
    4: (("living room", "kitchen"), ("bedroom", "bathroom")),
    5: (("living room", "kitchen"), ("bedroom", "bathroom", "study")),
    6: (("living room", "kitchen", "study"), ("bedroom", "bathroom", "kids room")),
    7: (("living room", "kitchen", "study"), ("bedroom", "bathroom", "kids room", "storage")),
    8: (("living room", "dining room", "kitchen", "study"), ("bedroom", "bathroom", "kids room", "storage")),
}


def layout(name: str, rng: np.random.Generator, size: str) -> tuple[BuildingPlan, dict[str, frozenset[int]]]:
    """Draw a plan of 1 to 3 (small), 4 to 6 (medium) or 7 to 9 rooms (large), and which edges of its rooms are bare.

    Raises:
        NoPlan: this draw has rooms that no door can join; draw again.
    """
    if size == "small":
        rooms, links = pick(rng, _SMALL)(rng)
    else:
        count = int(rng.integers(4, 7)) if size == "medium" else int(rng.integers(7, 10))
        around = count in (5, 6, 7) and rng.uniform() < 0.35
        rooms, links = _around_living(rng, count) if around else _along_corridor(rng, count)
    rooms = _turned(rng, rooms)
    plans: list[RoomPlan] = []
    bare = {}
    for room, kind, polygon in rooms:
        plan, edges = looks.room_plan(rng, room, kind, polygon)
        plans.append(plan)
        bare[room] = edges
    inner = pick(rng, (0.1, 0.12))
    outer = pick(rng, (0.12, 0.14))
    height = cm(rng, 2.5, 2.7)
    doors: tuple[DoorPlan, ...] = place_doors(rng, tuple(plans), links, max(inner, outer))
    windows: tuple[WindowPlan, ...] = place_windows(rng, tuple(plans), doors)
    facade, leaf, entrance = looks.facade(rng), looks.leaf(rng), looks.entrance(rng)
    return BuildingPlan(name, tuple(plans), doors, windows, facade, leaf, entrance, height, inner, outer), bare


def _rect(x0: float, y0: float, x1: float, y1: float) -> Polygon:
    return ((x0, y0), (x1, y0), (x1, y1), (x0, y1))


def _cuts(widths: list[float]) -> list[float]:
    return [round(float(x), 1) for x in np.concatenate([[0.0], np.cumsum(widths)])]


def _along_corridor(rng: np.random.Generator, count: int) -> tuple[Rooms, Links]:
    """Draw two strips of rooms on both sides of a corridor; in the smallest the living room swallows the corridor.

    The shorter strip ends early where the difference is large enough, which makes the whole plan an L.
    """
    merged = count == 4 or (count < 7 and rng.uniform() < 0.3)  # the living room and the corridor are one room
    strips: list[tuple[list[str], list[float]]] = []
    for group in _STRIPS[count if merged else count - 1]:
        ordered = [str(kind) for kind in rng.permutation(group)]
        if "living room" in ordered:  # at an end: it has windows on two sides
            ordered.remove("living room")
            ordered.insert(0, "living room")
        strips.append((ordered, [cm(rng, *_WIDTHS[kind], 0.1) for kind in ordered]))
    totals = [sum(widths) for _, widths in strips]
    if abs(totals[0] - totals[1]) < 1.6 or merged:  # make both strips equally long
        k = int(totals[0] > totals[1])
        kinds, widths = strips[k]
        _widen(kinds, widths, abs(totals[0] - totals[1]))
    south, corridor, north = cm(rng, 3.6, 4.6, 0.1), cm(rng, 1.3, 1.6, 0.1), cm(rng, 3.4, 4.2, 0.1)
    y1, y2, y3 = round(south, 1), round(south + corridor, 1), round(south + corridor + north, 1)
    cuts = [_cuts(widths) for _, widths in strips]
    end = max(cuts[0][-1], cuts[1][-1])
    rooms: Rooms = []
    links: Links = []
    hall = "living room" if merged else "hall"
    for (kinds, _), xs, low, high in zip(strips, cuts, (0.0, y2), (y1, y3), strict=True):
        for kind, a, b in zip(kinds, xs[:-1], xs[1:], strict=True):
            if kind == "living room" and merged:
                rooms.append((kind, kind, ((a, low), (b, low), (b, high), (end, high), (end, y2), (a, y2))))
            else:
                rooms.append((kind, kind, _rect(a, low, b, high)))
                links.append((kind, hall, "door"))
            if kind == "living room" and not merged:
                links[-1] = (kind, hall, "opening")
    if not merged:
        rooms.append(("hall", "hall", _rect(0.0, y1, end, y2)))
    links.append((hall, None, "entrance"))
    ordered = strips[0][0]
    if len(ordered) > 1 and ordered[1] in ("kitchen", "dining room"):
        links.append(("living room", ordered[1], "opening"))
    if "dining room" in ordered and abs(ordered.index("dining room") - ordered.index("kitchen")) == 1:
        links.append(("dining room", "kitchen", "opening"))
    return rooms, links


def _widen(kinds: list[str], widths: list[float], more: float) -> None:
    """Distribute ``more`` m among the rooms that profit from it."""
    roomy = [i for i, kind in enumerate(kinds) if kind not in ("bathroom", "storage")]
    per = math.floor(more / len(roomy) * 10.0 + 1e-6) / 10.0
    for i in roomy:
        widths[i] = round(widths[i] + per, 1)
    widths[roomy[0]] = round(widths[roomy[0]] + more - per * len(roomy), 1)


def _around_living(rng: np.random.Generator, count: int) -> tuple[Rooms, Links]:
    """Draw a living room from front to back with a column of rooms on either side; no corridor."""
    left = ["kitchen", "bathroom"] + (["study"] if count == 7 else [])
    right = ["bedroom", "kids room"] + (["storage"] if count > 5 else [])
    columns = [[str(kind) for kind in rng.permutation(kinds)] for kinds in (left, right)]
    breadths = {"kitchen": (3.0, 3.6), "bathroom": (2.2, 2.6), "storage": (1.8, 2.0), "study": (2.8, 3.2)}
    heights = [[cm(rng, *breadths.get(kind, (3.3, 4.0)), 0.1) for kind in kinds] for kinds in columns]
    total = round(max(sum(h) for h in heights), 1)
    for kinds, h in zip(columns, heights, strict=True):
        grow = next(i for i, kind in enumerate(kinds) if kind not in ("bathroom", "storage"))
        h[grow] = round(h[grow] + total - sum(h), 1)
    a, b, c = cm(rng, 3.0, 3.6, 0.1), cm(rng, 4.2, 5.2, 0.1), cm(rng, 3.3, 3.9, 0.1)
    x1, x2, x3 = round(a, 1), round(a + b, 1), round(a + b + c, 1)
    rooms: Rooms = [("living room", "living room", _rect(x1, 0.0, x2, total))]
    links: Links = [("living room", None, "entrance")]
    for kinds, h, low, high in zip(columns, heights, (0.0, x2), (x1, x3), strict=True):
        ys = _cuts(h)
        for kind, s, t in zip(kinds, ys[:-1], ys[1:], strict=True):
            rooms.append((kind, kind, _rect(low, s, high, t)))
            links.append((kind, "living room", "opening" if kind == "kitchen" else "door"))
    return rooms, links


def _studio(rng: np.random.Generator) -> tuple[Rooms, Links]:
    w, d = cm(rng, 5.0, 6.4, 0.1), cm(rng, 4.0, 5.0, 0.1)
    return [("studio", "studio", _rect(0.0, 0.0, w, d))], [("studio", None, "entrance")]


def _studio_with_bath(rng: np.random.Generator) -> tuple[Rooms, Links]:
    """Draw a studio around its bathroom."""
    w, d, a, b = cm(rng, 6.0, 7.2, 0.1), cm(rng, 4.6, 5.4, 0.1), cm(rng, 2.0, 2.4, 0.1), cm(rng, 2.2, 2.6, 0.1)
    studio = ((a, 0.0), (w, 0.0), (w, d), (0.0, d), (0.0, b), (a, b))
    rooms = [("studio", "studio", studio), ("bathroom", "bathroom", _rect(0.0, 0.0, a, b))]
    return rooms, [("studio", None, "entrance"), ("bathroom", "studio", "door")]


def _two_rooms(rng: np.random.Generator) -> tuple[Rooms, Links]:
    """Draw a living kitchen, a bedroom beside it and a bathroom between them."""
    a, b, d = cm(rng, 4.6, 5.6, 0.1), cm(rng, 3.2, 3.8, 0.1), cm(rng, 3.3, 4.0, 0.1)
    e, x = cm(rng, 2.1, 2.5, 0.1), round(a + b, 1)
    top = round(d + e, 1)
    rooms = [
        ("living kitchen", "living kitchen", _rect(0.0, 0.0, a, top)),
        ("bedroom", "bedroom", _rect(a, 0.0, x, d)),
        ("bathroom", "bathroom", _rect(a, d, x, top)),
    ]
    links: Links = [("living kitchen", None, "entrance")]
    return rooms, [*links, ("bedroom", "living kitchen", "door"), ("bathroom", "living kitchen", "door")]


_SMALL: tuple[Callable[[np.random.Generator], tuple[Rooms, Links]], ...] = (_studio, _studio_with_bath, _two_rooms)


def _turned(rng: np.random.Generator, rooms: Rooms) -> Rooms:
    """Mirror the rooms along x and along y and exchange the axes at random; outlines stay counter-clockwise."""
    flip_x, flip_y, swap = (bool(rng.integers(2)) for _ in range(3))
    width = max(x for _, _, p in rooms for x, _ in p)
    breadth = max(y for _, _, p in rooms for _, y in p)
    turned: Rooms = []
    for name, kind, polygon in rooms:
        points = [(round(width - x, 1) if flip_x else x, round(breadth - y, 1) if flip_y else y) for x, y in polygon]
        if swap:
            points = [(y, x) for x, y in points]
        if (flip_x + flip_y + swap) % 2:
            points.reverse()
        turned.append((name, kind, tuple(points)))
    return turned


__all__ = ["NoPlan", "layout"]
