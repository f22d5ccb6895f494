"""Generate apartments by seed: `generate(7)` is the same home for everyone, to the byte, within a version."""

import operator
from typing import Literal, get_args

import numpy as np

from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.scenes.generator.floorplan import build
from vssm_gym.envs.scenes.generator.furnish import furnish
from vssm_gym.envs.scenes.generator.layout import layout
from vssm_gym.envs.scenes.generator.openings import NoPlan
from vssm_gym.envs.scenes.generator.parking import parking
from vssm_gym.errors import InputError, one_of

Size = Literal["small", "medium", "large"]
SIZES: tuple[Size, ...] = get_args(Size)
"""1 to 3, 4 to 6 and 7 to 9 rooms."""

Form = Literal["small", "medium", "large", "parking", "parking-moved"]
FORMS: tuple[Form, ...] = get_args(Form)
"""The sizes of homes, and the car's parking arenas before and after obstacles were moved."""

PREFIX = "procedural:"
"""How the specification of a scene by seed begins."""

LARGEST_SEED = 2**63 - 1  # of a signed 64-bit integer
_PLANS_DRAWN = 50  # plans drawn before giving up; nine in ten seeds take the first or second


def generate(seed: int, size: Form = "medium") -> Apartment:
    """Return a furnished apartment, or a parking arena, a pure function of (seed, size).

    It has the same content hash on every machine.

    The default robot (0.1 m radius, 0.5 m tall) reaches every room, through passages at least 0.47 m wide; what is
    narrower is at most 0.11 m. See docs/scenes.md for the rules.

    Raises:
        InputError: a seed outside 0 .. 2^63 - 1 or another size.
    """
    try:
        number = operator.index(seed)
    except TypeError as error:
        raise InputError("procedural", "seed", f"a whole number; found {seed!r}") from error
    if not 0 <= number <= LARGEST_SEED:
        raise InputError("procedural", "seed", f"0 to 2^63 - 1; found {number}")
    if size not in FORMS:
        raise InputError("procedural", "size", one_of(FORMS, size))
    name = f"{PREFIX}{number}" + ("" if size == "medium" else f":{size}")
    if size in ("parking", "parking-moved"):
        return parking(number, name, moved=size == "parking-moved")
    robot = HolonomicRobot()
    for draw in range(_PLANS_DRAWN):
        rng = np.random.default_rng([number, SIZES.index(size), draw])
        try:
            plan, bare = layout(name, rng, size)
        except NoPlan:
            continue
        seeds = {room.name: int(rng.integers(2**32)) for room in plan.rooms}
        apartment = furnish(build(plan), seeds, bare)
        if not FreeSpace.from_apartment(apartment, robot.radius, robot.height).cut_off_rooms():
            return apartment
    raise InputError(name, "seed", f"one for which a plan is found within {_PLANS_DRAWN} draws: take another")


def recorded_spec(spec: str) -> str:
    """Return the scene in which the drive was recorded that a scene's map is learned from, before obstacles moved."""
    return spec.removesuffix("-moved") if spec.startswith(PREFIX) else spec


def parse_spec(spec: str) -> tuple[int, Form]:
    """Return seed and size of "procedural:SEED" or "procedural:SEED:SIZE"; raise InputError where it is neither."""
    seed, _, size = spec.removeprefix(PREFIX).partition(":")
    if not (seed.isascii() and seed.isdigit() and len(seed) <= 19):
        raise InputError(spec, "scene", f"{PREFIX}SEED or {PREFIX}SEED:SIZE with a seed of digits, below 2^63")
    for known in FORMS:
        if (size or "medium") == known and not (":" in spec.removeprefix(PREFIX) and not size):
            return int(seed), known
    raise InputError(spec, "scene", f"a size of {', '.join(FORMS)} after the seed; found {size!r}")
