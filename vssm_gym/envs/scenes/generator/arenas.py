"""Build four arenas for cars, 5 x 4 m each, drawn by hand after places where people work.

depot: rows of racks with aisles between them. garage: bays at right angles to a wall, gaps for parallel parking and
pillars. dock: dead ends, which a car backs out of. paddock: slanted barriers, and gates of two posts.
No gap is between 0.12 and 0.38 m wide, so that no centimetre decides whether a car fits that is 0.19 m wide; bays are
0.42 m wide. The car's turning radius is 0.45 m.
"""

from collections.abc import Sequence

from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.envs.scenes.apartment_parts import Box, Furniture, Material
from vssm_gym.envs.scenes.generator.venues import one_room, pictures

Color = tuple[float, float, float]
Rectangle = tuple[float, float, float, float]  # x, y, width along x, breadth along y; m, about its middle

ARENA_CORNERS = ((0.0, 0.0), (5.2, 0.0), (5.2, 4.2), (0.0, 4.2))  # m, of the walls' centre lines
ENTRANCE = (2.6, 0.0)  # m, middle of the door
# RGB in [0, 1]
RED, AMBER, GREEN, BLUE, CREAM = (
    (0.9, 0.4, 0.34),
    (1.0, 0.8, 0.36),
    (0.5, 0.75, 0.5),
    (0.45, 0.6, 0.9),
    (0.95, 0.9, 0.8),
)


def depot() -> Apartment:
    """Build three rows of two racks, the middle row shifted; pallets narrow the aisles."""
    looks = [look("cabinet", BLUE, 0.7), look("drawers", AMBER, 0.6), look("planks", CREAM, 0.7)]
    racks = [(1.6, 1.0, 1.4, 0.3), (3.6, 1.0, 1.4, 0.3), (1.25, 2.1, 1.3, 0.3), (3.1, 2.1, 1.3, 0.3)]
    racks += [(1.6, 3.2, 1.4, 0.3), (3.6, 3.2, 1.4, 0.3)]
    pieces = [piece("rack", rack, 0.6, looks[i % 3]) for i, rack in enumerate(racks)]
    wood = look("planks", (0.8, 0.62, 0.42), 0.3)
    pallets = [(1.2, 1.3, 0.36, 0.3), (3.3, 2.4, 0.36, 0.3), (4.1, 2.9, 0.3, 0.3), (1.8, 2.9, 0.3, 0.3)]
    pieces += [piece("pallet", pallet, 0.22, wood) for pallet in pallets]
    pieces += [piece("drum", (4.53, 2.1, 0.26, 0.26), 0.4, look("metal", RED, 0.5), 0.4)]
    floor = Material(color=(0.86, 0.84, 0.80), texture="granite", scale=1.6)
    walls = (
        look("brick", CREAM, 1.2),
        look("subway", BLUE, 1.3),
        look("wainscot", AMBER, 1.4),
        look("mosaic", RED, 1.5),
    )
    return _arena("depot", floor, walls, pieces)


def garage() -> Apartment:
    """Build bays along the north wall, cars parked along the south wall with gaps between them, three pillars."""
    kerb = look("stripes", AMBER, 0.3)
    paints = [look("metal", color, 0.4) for color in (RED, BLUE, GREEN, CREAM)]
    # Seven kerbs make six bays, 0.42 m wide and 0.6 m deep; cars stand in two of them.
    kerbs = [(1.19 + 0.48 * i, 3.8, 0.06, 0.6) for i in range(7)]
    pieces = [piece("kerb", one, 0.15, kerb) for one in kerbs]
    pieces += [piece("car", (1.43 + 0.48 * i, 3.88, 0.19, 0.39), 0.18, paints[i % 4]) for i in (1, 4)]
    # Bumper to bumper along the south wall: gaps of 0.8 m.
    parked = [(0.75, 0.22, 0.39, 0.19), (1.94, 0.22, 0.39, 0.19), (3.13, 0.22, 0.39, 0.19), (4.32, 0.22, 0.39, 0.19)]
    pieces += [piece("car", one, 0.18, paints[(i + 1) % 4]) for i, one in enumerate(parked)]
    pillars = [(1.3, 2.0, 0.26, 0.26), (2.6, 1.7, 0.26, 0.26), (3.9, 2.0, 0.26, 0.26)]
    textures = ("mosaic", "brick", "checker")
    pieces += [
        piece("pillar", one, 2.2, look(texture, CREAM, 0.8), 0.0)
        for one, texture in zip(pillars, textures, strict=True)
    ]
    pieces += [piece("barrier", (0.62, 2.9, 0.12, 0.6), 0.25, look("stripes", RED, 0.5))]
    pieces += [piece("barrier", (4.58, 1.2, 0.12, 0.6), 0.25, look("stripes", RED, 0.5))]
    floor = Material(color=(0.76, 0.78, 0.82), texture="hexagons", scale=2.2)
    walls = (
        look("mosaic", GREEN, 1.4),
        look("brick", RED, 1.1),
        look("stripes", CREAM, 1.3),
        look("wallpaper", BLUE, 1.2),
    )
    return _arena("garage", floor, walls, pieces)


def dock() -> Apartment:
    """Build three alleys to the west and two to the east, dead ends all, with crates in the yard between them."""
    plank, metal = look("planks", GREEN, 0.5), look("metal", BLUE, 0.6)
    # Walls of alleys begin at the room's own: 0.58 m apart in the west, 0.46 m in the east.
    west = [(0.65, y, 1.1, 0.1) for y in (0.78, 1.46, 2.14, 2.82)]
    east = [(4.5, y, 1.2, 0.1) for y in (1.6, 2.16, 2.72)]
    pieces = [piece("partition", one, 0.5, plank) for one in west]
    pieces += [piece("partition", one, 0.5, metal) for one in east]
    pieces += [piece("container", (0.5, 3.75, 0.8, 0.5), 0.6, look("cabinet", RED, 0.6))]
    pieces += [piece("container", (4.75, 3.75, 0.6, 0.6), 0.6, look("drawers", AMBER, 0.6))]
    wood = look("planks", (0.8, 0.62, 0.42), 0.3)
    crates = [(2.15, 1.2, 0.3), (2.95, 1.9, -0.4), (2.1, 2.75, 0.7), (3.2, 3.1, 0.2), (3.3, 0.9, -0.6)]
    pieces += [piece("crate", (x, y, 0.32, 0.32), 0.3, wood, yaw) for x, y, yaw in crates]
    pieces += [piece("post", (2.55, 3.45, 0.14, 0.14), 0.6, look("stripes", RED, 0.3), 0.4)]
    floor = Material(color=(0.84, 0.76, 0.68), texture="parquet", scale=1.8)
    walls = (
        look("subway", GREEN, 1.2),
        look("wallpaper", RED, 1.3),
        look("brick", CREAM, 1.0),
        look("checker", BLUE, 1.6),
    )
    return _arena("dock", floor, walls, pieces)


def paddock() -> Apartment:
    """Build slanted barriers that make a chicane, gates of two posts 0.42 m apart, stacks of tyres."""
    stripes, tyre = (
        [look("stripes", color, 0.5) for color in (RED, AMBER, GREEN, BLUE)],
        look("leather", (0.3, 0.3, 0.32), 0.3),
    )
    slanted = [(0.96, 0.94, 1.0, 0.6), (1.12, 2.54, 1.0, -0.7), (2.35, 1.55, 0.9, 1.25), (2.45, 3.1, 1.0, 0.35)]
    slanted += [(3.5, 2.33, 1.1, -0.55), (4.25, 1.1, 0.9, 0.8), (4.2, 3.3, 0.8, -0.9)]
    pieces = [
        piece("barrier", (x, y, length, 0.12), 0.25, stripes[i % 4], yaw)
        for i, (x, y, length, yaw) in enumerate(slanted)
    ]
    gates = [(1.55, 1.7), (3.3, 1.35), (1.5, 3.35), (3.39, 3.13), (0.6, 1.85)]
    pieces += [
        piece("post", (x, y, 0.12, 0.12), 0.6, look("checker", CREAM, 0.3), 0.5 * i) for i, (x, y) in enumerate(gates)
    ]
    stacks = [(2.95, 0.67), (0.7, 3.5), (4.54, 2.25), (1.8, 0.69)]
    pieces += [piece("tyre stack", (x, y, 0.28, 0.28), 0.4, tyre, 0.3 + 0.6 * i) for i, (x, y) in enumerate(stacks)]
    floor = Material(color=(0.80, 0.86, 0.76), texture="mosaic", scale=2.6)
    walls = (
        look("checker", CREAM, 1.5),
        look("stripes", GREEN, 1.2),
        look("subway", AMBER, 1.2),
        look("brick", RED, 1.2),
    )
    return _arena("paddock", floor, walls, pieces)


def _arena(name: str, floor: Material, walls: Sequence[Material], pieces: Sequence[Furniture]) -> Apartment:
    apartment = one_room(name, ARENA_CORNERS, 2.2, floor, tuple(walls), ENTRANCE)
    numbered = [piece.model_copy(update={"name": f"{piece.category} {i + 1}"}) for i, piece in enumerate(pieces)]
    return apartment.model_copy(update={"furniture": (*numbered, *pictures(apartment, 0.9, 1.2, 1.3))})


def piece(category: str, rectangle: Rectangle, height: float, look: Material, yaw: float = 0.0) -> Furniture:
    """Return a piece of one box on the floor."""
    x, y, width, breadth = rectangle
    center = (round(x, 3), round(y, 3), round(0.5 * height, 4))
    box = Box(center=center, size=(width, breadth, height), yaw=round(yaw, 3), material=look)
    return Furniture(name=category, category=category, boxes=(box,))


def look(texture: str, color: Color, scale: float) -> Material:
    """Return the material of a texture, ``scale`` m large, in a colour."""
    return Material(color=color, texture=texture, scale=scale)
