"""Build parking arenas by seed: tight bays for a car, and the same arena after obstacles were moved.

    a bay's mark = (length, width) of its floor; width = car.width + 2 clearance, clearance in BAY_CLEARANCES

5 x 4 m. Bays at right angles to the two long walls, between kerbs; gaps between parked cars along the two short walls;
crates, barriers, posts and stacks of tyres in the yard between them, at least YARD_GAP from everything. A free bay has
a mark of paint on the floor, a piece of category :data:`BAY`, whose longer side is the direction in which a car stands.
Bays are centred on multiples of 5 cm across: on the lattice by which tasks are checked
(:mod:`vssm_gym.envs.tasks.car_space`).
"""

import math

import numpy as np
import shapely

from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.envs.scenes.apartment_parts import Furniture, Material
from vssm_gym.envs.scenes.generator.arenas import AMBER, ARENA_CORNERS, BLUE, CREAM, ENTRANCE, GREEN, RED, look, piece
from vssm_gym.envs.scenes.generator.furniture.pieces import pick, tinted
from vssm_gym.envs.scenes.generator.venues import one_room, pictures
from vssm_gym.envs.scenes.solids import SolidBox, footprint
from vssm_gym.errors import InputError
from vssm_gym.geometry.car import Car

BAY = "bay"  # category of the marks of free bays
BAY_CLEARANCES = (0.05, 0.06, 0.08)  # m on either side of a car that stands in the middle of a bay between kerbs
YARD_GAP = 0.42  # m between an obstacle of the yard and everything else, at least
BAYS, PITCH, DEPTH = 6, 0.5, 0.6  # of a row between kerbs: number, m from middle to middle, m from the wall
END_KERB = 0.08  # m: breadth of the first and the last kerb of a row
ROOMY = 0.14  # m before and behind a car in the middle of a gap between parked cars
OBSTACLES, MOVED_OBSTACLES = 7, 5  # in the yard, and how many of them are moved
MOVED_BY = 0.4  # m, at least
BEFORE, BESIDE_BAY = (
    (0.8, 1.2),
    0.4,
)  # m from a bay's middle to that of an obstacle moved there: ahead, and to either side
INNER = shapely.box(0.1, 0.1, 5.1, 4.1)  # m, between the walls
BAY_STEP = 0.05  # m: bays are centred on multiples of it
PAINT = 0.004  # m: height of a mark, over which cars drive
OBSTACLE_PLACES, ARENA_DRAWS = 400, 50  # places drawn for one obstacle, and arenas drawn before giving up
STREAM = 3  # of random numbers, apart from those of the homes of the same seed
KINDS = {
    "crate": (0.32, 0.32, 0.3, "planks", (0.80, 0.62, 0.42), 0.3),
    "barrier": (0.7, 0.12, 0.25, "stripes", RED, 0.5),
    "post": (0.14, 0.14, 0.6, "checker", CREAM, 0.3),
    "tyre stack": (0.28, 0.28, 0.4, "leather", (0.3, 0.3, 0.32), 0.3),
}
"""Length, breadth and height (m), texture, colour and the texture's size (m) of the yard's obstacles."""


def parking(seed: int, name: str, moved: bool = False) -> Apartment:
    """Build the parking arena of a seed, or with ``moved`` the same arena after MOVED_OBSTACLES obstacles were moved.

    Raises :class:`InputError` for a seed in whose yard the obstacles find no place.
    """
    for draw in range(ARENA_DRAWS):
        rng = np.random.default_rng([seed, STREAM, draw])
        fixed = [
            *_row(rng, 3.8, "north"),
            *_row(rng, 0.4, "south"),
            *_gaps(rng, 0.25, "west"),
            *_gaps(rng, 4.95, "east"),
        ]
        kinds = [
            "barrier",
            "barrier",
            *(pick(rng, ("crate", "crate", "post", "tyre stack")) for _ in range(OBSTACLES - 2)),
        ]
        before = _yard(rng, fixed, kinds)
        after = before and _moved(np.random.default_rng([seed, STREAM, draw, 1]), fixed, before)
        if before and after:
            break
    else:
        raise InputError(name, "seed", "one in whose yard all obstacles find a place: take another")
    color, texture = tinted(rng, (0.8, 0.8, 0.8), 0.06), pick(rng, ("granite", "checker", "hexagons"))
    textures = rng.permutation(["brick", "mosaic", "stripes", "subway"]).tolist()
    walls = tuple(
        look(texture, color, 1.2) for texture, color in zip(textures, (CREAM, GREEN, AMBER, BLUE), strict=True)
    )
    floor = Material(color=color, texture=texture, scale=2.0)
    apartment = one_room("parking", ARENA_CORNERS, 2.2, floor, walls, ENTRANCE)
    pieces = (*fixed, *(after if moved else before), *pictures(apartment, 0.9, 1.2, 1.3))
    return apartment.model_copy(update={"name": name, "furniture": pieces})


def _yard(rng: np.random.Generator, fixed: list[Furniture], kinds: list[str]) -> list[Furniture]:
    """Return obstacles at random places between fixed pieces; none where one finds no place."""
    yard: list[Furniture] = []
    for i, kind in enumerate(kinds):
        placed = _placed(rng, kind, f"{kind} {i + 1}", [*fixed, *yard])
        if placed is None:
            return []
        yard.append(placed)
    return yard


def _moved(rng: np.random.Generator, fixed: list[Furniture], before: list[Furniture]) -> list[Furniture]:
    """Return the obstacles with MOVED_OBSTACLES of them in front of bays; none where one finds no place."""
    yard = list(before)
    for i in rng.permutation(len(yard))[:MOVED_OBSTACLES].tolist():
        placed = _placed(rng, yard[i].category, yard[i].name, [*fixed, *yard[:i], *yard[i + 1 :]], yard[i])
        if placed is None:
            return []
        yard[i] = placed
    return yard


def _row(rng: np.random.Generator, y: float, side: str) -> list[Furniture]:
    """Return the kerbs, marks and parked cars of a row of bays at right angles to a long wall; m."""
    first = BAY_STEP * int(rng.integers(22, 32))  # of the first bay's middle: 1.1 to 1.55 m
    middles = first + PITCH * np.arange(BAYS)
    widths = (Car().width + 2.0 * rng.choice(BAY_CLEARANCES, BAYS)).round(3)
    taken = set(rng.permutation(BAYS)[:2].tolist())
    lefts, rights = middles - 0.5 * widths, middles + 0.5 * widths
    low, high = [lefts[0] - END_KERB, *rights], [*lefts, rights[-1] + END_KERB]
    pieces = []
    for i, (a, b) in enumerate(zip(low, high, strict=True)):
        kerb = (float(0.5 * (a + b)), y, round(float(b - a), 3), DEPTH)
        pieces.append(_named(f"{side} kerb {i + 1}", "kerb", kerb, 0.15, look("stripes", AMBER, 0.3)))
    for i, (x, width) in enumerate(zip(middles.tolist(), widths.tolist(), strict=True)):
        if i in taken:
            pieces.append(_car(rng, f"{side} car {i + 1}", x, y))
        else:
            pieces.append(_named(f"{side} bay {i + 1}", BAY, (x, y, width, DEPTH), PAINT, look("stripes", CREAM, 0.4)))
    return pieces


def _gaps(rng: np.random.Generator, x: float, side: str) -> list[Furniture]:
    """Return three cars parked along a short wall, and the marks of the two gaps between them; m."""
    long, wide = Car().length, Car().width
    gap = long + 2.0 * ROOMY
    y = BAY_STEP * int(rng.integers(18, 24))  # of the first car's middle
    pieces = [_car(rng, f"{side} car {i + 1}", x, y + i * (long + gap)) for i in range(3)]
    for i in range(2):
        mark = (x, y + (i + 0.5) * (long + gap), wide + 0.04, gap)
        pieces.append(_named(f"{side} bay {i + 1}", BAY, mark, PAINT, look("stripes", CREAM, 0.4)))
    return pieces


def _car(rng: np.random.Generator, name: str, x: float, y: float) -> Furniture:
    """Return a parked car that stands along y."""
    car, paint = Car(), look("metal", pick(rng, (RED, BLUE, GREEN)), 0.4)
    return _named(name, "car", (x, y, car.width, car.length), car.height, paint)


def _named(
    name: str, category: str, rectangle: tuple[float, float, float, float], height: float, paint: Material
) -> Furniture:
    return piece(category, rectangle, height, paint).model_copy(update={"name": name})


def _placed(
    rng: np.random.Generator,
    kind: str,
    name: str,
    others: list[Furniture],
    before: Furniture | None = None,
) -> Furniture | None:
    """Return an obstacle at the first drawn place YARD_GAP from all others; None where there is none.

    One that stood somewhere ``before`` is moved by MOVED_BY or more, in front of a bay between kerbs.
    """
    taken = [ground(other) for other in others]
    bays = [other.boxes[0].center for other in others if other.category == BAY and other.boxes[0].size[1] == DEPTH]
    width, depth, height, texture, color, scale = KINDS[kind]
    for _ in range(OBSTACLE_PLACES):
        at = rng.uniform((0.1, 0.1), (5.1, 4.1)) if before is None else _in_front(rng, pick(rng, bays))
        x, y = (round(float(v), 2) for v in at)
        yaw = round(float(rng.uniform(-math.pi / 2, math.pi / 2)), 3)
        found = piece(kind, (x, y, width, depth), height, look(texture, color, scale), yaw)
        shape = ground(found)
        if not INNER.contains(shape) or INNER.exterior.distance(shape) < YARD_GAP:
            continue
        if min(shape.distance(other) for other in taken) < YARD_GAP:
            continue
        if before is None or math.dist(found.boxes[0].center, before.boxes[0].center) >= MOVED_BY:
            return found.model_copy(update={"name": name})
    return None


def _in_front(rng: np.random.Generator, bay: tuple[float, float, float]) -> tuple[float, float]:
    """Return a place in the yard from which an obstacle is in the way of cars that turn into a bay, m."""
    ahead = float(rng.uniform(*BEFORE)) * (1.0 if bay[1] < 0.5 * ARENA_CORNERS[2][1] else -1.0)
    return bay[0] + float(rng.uniform(-BESIDE_BAY, BESIDE_BAY)), bay[1] + ahead


def ground(item: Furniture) -> shapely.Polygon:
    """Return the outline on the floor of a piece of one box, m."""
    box = item.boxes[0]
    return footprint(SolidBox("", "furniture", box.center, box.size, box.yaw, box.material))
