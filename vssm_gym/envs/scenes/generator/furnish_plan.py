"""Furnish a plan that came from a file, such as one of HouseExpo, by the rules of the generator.

Walls, floors and doors stay as they are; the pictures of the importer give way to those of the generator. A room is
furnished by its kind, which the words in the file's name for it decide, or by its area where they say nothing.
"""

import operator

import numpy as np
import shapely

from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.envs.scenes.apartment_parts import Furniture, Room
from vssm_gym.envs.scenes.free_space import STEP_HEIGHT, FreeSpace
from vssm_gym.envs.scenes.generator.fitting import Fitting
from vssm_gym.envs.scenes.generator.furnish import PROGRAMS
from vssm_gym.envs.scenes.generator.furniture.pieces import pick
from vssm_gym.envs.scenes.generator.placement import Site
from vssm_gym.envs.scenes.generator.plan_ground import plan_ground
from vssm_gym.envs.scenes.generator.procedural import LARGEST_SEED
from vssm_gym.errors import InputError

PICTURE = "picture"  # the only furniture that a plan may have
_DRAWS = 10  # furnishings tried before giving up; the first keeps all rooms connected

# The first row with a word that is part of a room's kind decides.
_WORDS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("bathroom", ("bath", "toilet", "shower", "wc")),
    ("living kitchen", ("living kitchen",)),
    ("kitchen", ("kitchen",)),
    ("dining room", ("dining",)),
    ("living room", ("living", "lounge")),
    ("kids room", ("child", "kid", "nursery")),
    ("bedroom", ("bed", "guest")),
    ("studio", ("studio",)),
    ("study", ("office", "study")),
    ("hall", ("hall", "corridor", "entr", "lobby", "stair", "balcony", "terrace", "loggia")),
    ("storage", ("stor", "garage", "basement", "boiler", "laundry", "pantry", "wardrobe")),
)
# m^2 below which a room of unknown kind is one of these.
_BY_AREA: tuple[tuple[float, tuple[str, ...]], ...] = (
    (5.0, ("hall", "storage")),
    (9.0, ("study", "kids room")),
    (18.0, ("bedroom", "study", "kids room", "dining room")),
    (np.inf, ("living room",)),
)


def furnish_plan(apartment: Apartment, seed: int) -> Apartment:
    """Return a plan with furniture, a pure function of (plan, seed): the same content hash for the same seed.

    A room without a place for anything on its floor gets a note, as does one whose kind was chosen by its area, or one
    that is no home's: of less than 1 or within more than 150 m^2, or of a hundred corners and more. The default robot
    reaches the rooms that it reached before.

    Args:
        apartment: rooms, walls and doors, without furniture except pictures.
        seed: 0 to 2^63 - 1.

    Raises:
        InputError: another seed, an apartment with furniture, or one in which nothing finds a place.
    """
    try:
        number = operator.index(seed)
    except TypeError as error:
        raise InputError(apartment.name, "seed", f"a whole number; found {seed!r:.80}") from error
    if not 0 <= number <= LARGEST_SEED:
        raise InputError(apartment.name, "seed", f"0 to 2^63 - 1; found {number}")
    if found := [piece.name for piece in apartment.furniture if piece.category != PICTURE]:
        expected = f"a plan without furniture, to be furnished; found {len(found)} pieces, such as {found[0]!r:.80}"
        raise InputError(apartment.name, "furniture", expected)
    robot = HolonomicRobot()
    bare = apartment.model_copy(update={"furniture": ()})
    before = set(FreeSpace.from_apartment(bare, robot.radius, robot.height).cut_off_rooms())
    for draw in range(_DRAWS):
        furniture, notes = _furniture(bare, np.random.default_rng([number, draw]))
        content = {"name": f"{apartment.name[:170]}-furnished-{number}", "furniture": tuple(furniture)}
        furnished = bare.model_copy(update=content | {"notes": (*apartment.notes, *notes)})
        if set(FreeSpace.from_apartment(furnished, robot.radius, robot.height).cut_off_rooms()) <= before:
            break
    else:
        raise InputError(apartment.name, "seed", f"one that keeps the rooms connected within {_DRAWS} draws")
    if not any(map(_stands, furniture)):
        raise InputError(apartment.name, "rooms", "a room with a place for furniture; there is none")
    return furnished


def furnished_as(room: Room, rng: np.random.Generator) -> tuple[str, bool]:
    """Return the kind of furniture that a room gets, and whether its own kind decided it."""
    if room.kind in PROGRAMS:
        return room.kind, True
    for kind, words in _WORDS:
        if any(word in room.kind.lower() for word in words):
            return kind, True
    area = shapely.Polygon(room.polygon).area
    return pick(rng, next(kinds for most, kinds in _BY_AREA if area < most)), False


def _furniture(bare: Apartment, rng: np.random.Generator) -> tuple[list[Furniture], list[str]]:
    """Return the furniture of all rooms, and a sentence for each room that is not furnished by its own kind."""
    furniture: list[Furniture] = []
    notes: list[str] = []
    boxes = bare.boxes()
    for room, seed in zip(bare.rooms, rng.integers(2**32, size=len(bare.rooms)).tolist(), strict=True):
        own = np.random.default_rng(seed)
        kind, known = furnished_as(room, own)
        placed: list[Furniture] = []
        if (ground := plan_ground(bare, boxes, room)) is not None:
            site = Site(room.name, ground, bare.ceiling_height, frozenset())
            PROGRAMS[kind](Fitting(site, own))
            placed = site.furniture
        if not any(map(_stands, placed)):
            notes.append(f"{room.name} stays without furniture")
        elif not known:
            notes.append(f"{room.name}, whose kind the file does not give, is furnished as a {kind}")
        furniture += placed
    return furniture, notes


def _stands(piece: Furniture) -> bool:
    """Return True for furniture on the floor, which a robot drives around."""
    low = min(box.center[2] - 0.5 * box.size[2] for box in piece.boxes)
    high = max(box.center[2] + 0.5 * box.size[2] for box in piece.boxes)
    return low < STEP_HEIGHT < high
