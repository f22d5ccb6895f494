"""Furnish rooms of each kind as people do: beds at the middle of walls, wardrobes in corners.

`furnish` goes through a list of wishes; a wish that finds no place by the rules of `placement` is left out.
"""

import itertools

import numpy as np

from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.envs.scenes.apartment_parts import Furniture
from vssm_gym.envs.scenes.generator.fitting import Fitting
from vssm_gym.envs.scenes.generator.furniture import bathroom, bedroom, decor, kitchen, living, work
from vssm_gym.envs.scenes.generator.ground import ground_of
from vssm_gym.envs.scenes.generator.placement import Site

Bare = dict[str, frozenset[int]]
"""Names of rooms to the edges that stay without pictures."""


def furnish(apartment: Apartment, seeds: dict[str, int], bare: Bare) -> Apartment:
    """Return the apartment with furniture; ``seeds`` maps each room's name to the seed of its own stream."""
    furniture: list[Furniture] = []
    boxes = apartment.boxes()
    for room in apartment.rooms:
        ground = ground_of(apartment, boxes, room)
        site = Site(room.name, ground, apartment.ceiling_height, bare.get(room.name, frozenset()))
        fitting = Fitting(site, np.random.default_rng(seeds[room.name]))
        PROGRAMS.get(room.kind, _hall)(fitting)
        furniture += site.furniture
    return apartment.model_copy(update={"furniture": tuple(furniture)})


def _living(room: Fitting) -> None:
    rng, style = room.rng, room.style
    seat = room.middle(living.lounge(rng, style)) if room.area > 11.0 else None
    if seat is None:
        seat = room.middle(living.sofa(rng, style, 1.6))
    room.facing(living.television(rng, style), seat)
    if room.area > 18.0:
        room.centre(living.dining(rng, style, 4))
    room.corner(work.bookshelf(rng, style))
    if room.chance(0.7):
        room.beside(living.armchair(rng, style), seat)
    if room.chance(0.6):
        room.corner(living.sideboard(rng, style))
    room.extras()
    if room.area > 20.0:
        room.corner(work.bookshelf(rng, style))
        room.corner(decor.plant(rng, style))
        room.pictures(2)


def _kitchen(room: Fitting) -> None:
    rng, style = room.rng, room.style
    _kitchen_run(room, 6)
    if room.area > 11.0 and room.chance(0.5):
        room.centre(kitchen.island(rng, style, 1.2))
    seats = living.dining(rng, style, 4) if room.area > 13.0 else living.bistro(rng, style)
    room.centre(seats)
    room.corner(kitchen.bin_(rng, style))
    if room.chance(0.4):
        room.corner(work.cabinet(rng, style))
    room.hang(decor.wall_shelf(rng, style))
    room.pictures(2)
    room.light()


def _kitchen_run(room: Fitting, most: int) -> None:
    """Place the longest run of modules that fits, with what hangs above it where no window is in the way."""
    first = bool(room.rng.integers(2))
    for modules, hung, other in itertools.product(range(most, 2, -1), (True, False), (False, True)):
        if room.corner(kitchen.kitchen_run(room.rng, room.style, modules, hung, first ^ other)) is not None:
            return


def _dining(room: Fitting) -> None:
    rng, style = room.rng, room.style
    if room.centre(living.dining(rng, style, 6 if room.area > 13.0 else 4)) is None:
        room.centre(living.dining(rng, style, 2))
    room.middle(living.sideboard(rng, style))
    room.corner(work.cabinet(rng, style))
    room.extras()


def _bedroom(room: Fitting) -> None:
    rng, style = room.rng, room.style
    bed = room.middle(bedroom.double_bed(rng, style)) if room.area > 9.5 else None
    if bed is None:
        bed = room.far_corner(bedroom.single_bed(rng, style))
    room.corner(bedroom.wardrobe(rng, style))
    room.facing(bedroom.dresser(rng, style), bed)
    if room.area > 14.0 and room.chance(0.5):
        room.corner(work.desk(rng, style))
    if room.chance(0.6):
        room.lay(decor.rug(rng, style, 1.4, 0.9))
    room.extras()


def _kids(room: Fitting) -> None:
    rng, style = room.rng, room.style
    room.far_corner(bedroom.single_bed(rng, style))
    room.corner(work.desk(rng, style))
    room.corner(work.bookshelf(rng, style))
    room.corner(bedroom.toy_chest(rng, style))
    room.lay(decor.rug(rng, style, 1.2, 1.2))
    if room.chance(0.5):
        room.corner(bedroom.wardrobe(rng, style))
    room.extras()


def _study(room: Fitting) -> None:
    rng, style = room.rng, room.style
    room.middle(work.desk(rng, style))
    room.corner(work.bookshelf(rng, style))
    if room.area > 10.0:
        room.middle(living.sofa(rng, style, 1.6))
    room.corner(work.cabinet(rng, style))
    room.lay(decor.rug(rng, style, 1.6, 1.1))
    if room.chance(0.5):
        room.corner(work.bookshelf(rng, style))
    room.extras()


def _bathroom(room: Fitting) -> None:
    rng, style = room.rng, room.style
    tub = bathroom.bathtub(rng, style) if room.area > 5.6 else bathroom.shower(rng, style)
    basin, seat = bathroom.vanity(rng, style, 0.9), bathroom.toilet(rng, style)
    small = bathroom.vanity(rng, style, 0.6)
    for bath, sink in ((tub, basin), (tub, small), (bathroom.shower(rng, style), small)):
        wishes = ((room.corner, bath), (room.corner, seat), (room.middle, sink))
        if room.all_of(wishes):
            break
    if room.chance(0.7):
        room.corner(bathroom.washing_machine(rng, style))
    room.corner(bathroom.hamper(rng, style))
    room.hang(bathroom.towels(rng, style))
    room.lay(decor.rug(rng, style, 0.75, 0.55))
    room.pictures(1)
    room.light()


def _hall(room: Fitting) -> None:
    rng, style = room.rng, room.style
    room.hang(work.coat_rack(rng, style))
    room.corner(work.shoe_cabinet(rng, style))
    if room.chance(0.5):
        room.corner(work.bench(rng, style))
    room.lay(decor.rug(rng, style, 1.8, 0.6))
    if room.chance(0.5):
        room.corner(decor.plant(rng, style))
    room.pictures(4)
    room.light()


def _storage(room: Fitting) -> None:
    rng, style = room.rng, room.style
    for _ in range(2):
        room.corner(work.storage_shelf(rng, style))
    room.corner(bathroom.washing_machine(rng, style))
    room.corner(work.boxes(rng, style))
    room.corner(bathroom.hamper(rng, style))
    room.light()


def _studio(room: Fitting) -> None:
    rng, style = room.rng, room.style
    _kitchen_run(room, 4)
    bed = room.far_corner(bedroom.single_bed(rng, style))
    seat = room.middle(living.sofa(rng, style, 1.6))
    room.facing(living.television(rng, style), seat)
    room.centre(living.bistro(rng, style))
    if room.beside(bedroom.wardrobe(rng, style), bed) is None:
        room.corner(bedroom.dresser(rng, style))
    room.corner(work.bookshelf(rng, style))
    room.lay(decor.rug(rng, style, 1.6, 1.2))
    room.extras()


def _living_kitchen(room: Fitting) -> None:
    _kitchen_run(room, 5)
    _living(room)


PROGRAMS = {
    "living room": _living,
    "kitchen": _kitchen,
    "dining room": _dining,
    "bedroom": _bedroom,
    "kids room": _kids,
    "study": _study,
    "bathroom": _bathroom,
    "hall": _hall,
    "storage": _storage,
    "studio": _studio,
    "living kitchen": _living_kitchen,
}
"""What furnishes a room, by its kind; any other kind is furnished as a hall."""
