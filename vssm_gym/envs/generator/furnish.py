"""What stands in a room of each kind, and where people put it: beds at the middle of walls, wardrobes in corners.

`furnish` goes through a list of wishes; a wish that finds no place by the rules of `placement` is left out.
"""

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np

from vssm_gym.envs.apartment import Apartment, Furniture
from vssm_gym.envs.generator import bathroom, bedroom, decor, kitchen, living, work
from vssm_gym.envs.generator.pieces import Piece, Style, cm
from vssm_gym.envs.generator.placement import Score, Site

Bare = dict[str, frozenset[int]]
"""Names of rooms to the edges that stay without pictures."""


def furnish(apartment: Apartment, seeds: dict[str, int], bare: Bare) -> Apartment:
    """The apartment with furniture; ``seeds`` gives each room by name the seed of its own stream."""
    furniture: list[Furniture] = []
    boxes = apartment.boxes()
    for room in apartment.rooms:
        site = Site(apartment, boxes, room, bare.get(room.name, frozenset()))
        _Room(site, np.random.default_rng(seeds[room.name])).fill()
        furniture += site.furniture
    return apartment.model_copy(update={"furniture": tuple(furniture)})


class _Room:
    """A site, its stream of chance and its style, with the ways to place a piece."""

    def __init__(self, site: Site, rng: np.random.Generator) -> None:
        self.site, self.rng, self.style = site, rng, Style.draw(rng)
        self._paintings: list[str] = []

    def fill(self) -> None:
        _PROGRAMS.get(self.site.room.kind, _hall)(self)

    def chance(self, p: float) -> bool:
        """True with probability p."""
        return bool(self.rng.uniform() < p)

    # ---- ways to place: each returns (x, y, turn) or None

    def middle(self, piece: Piece) -> np.ndarray | None:
        """At the middle of a wall, long walls first, away from the doors."""
        return self._along(piece, lambda o, t: 0.6 * self._centred(o, t) + 0.25 * self._from_doors(o))

    def corner(self, piece: Piece) -> np.ndarray | None:
        """At the end of a wall, or beside what stands there."""
        return self._along(piece, lambda o, t: -self._to_side(piece, o, t) + 0.05 * self._from_doors(o))

    def far_corner(self, piece: Piece) -> np.ndarray | None:
        """As `corner`, but away from the doors above all."""
        return self._along(piece, lambda o, t: -self._to_side(piece, o, t) + 0.5 * self._from_doors(o))

    def beside(self, piece: Piece, at: np.ndarray | None) -> np.ndarray | None:
        """Along a wall, near a place."""
        if at is None:
            return self.corner(piece)
        return self._along(piece, lambda o, t: -np.linalg.norm(o - at[:2], axis=1))

    def facing(self, piece: Piece, at: np.ndarray | None) -> np.ndarray | None:
        """At a wall opposite to a placed piece, in its middle line."""
        if at is None:
            return self.middle(piece)
        ahead = np.array([-math.sin(at[2] * math.pi / 2), math.cos(at[2] * math.pi / 2)]).round()

        def score(o: np.ndarray, t: np.ndarray) -> np.ndarray:
            d = o - at[:2]
            opposite = (t - at[2]) % 4 == 2
            off = np.abs(d @ np.array([-ahead[1], ahead[0]]))
            return np.where(opposite & (d @ ahead > 1.8) & (off < 1.2), -off, -5.0 - np.linalg.norm(d, axis=1))

        return self._along(piece, score)

    def centre(self, piece: Piece) -> np.ndarray | None:
        """Free in the room, where most floor is around it."""
        places = self.site.all_over()
        return self.site.place(piece, places, self._jittered(lambda o, t: self._clearance(o)))

    def hang(self, piece: Piece) -> np.ndarray | None:
        """At any wall that is not bare."""
        edges = [i for i, edge in enumerate(self.site.edges) if edge.side not in self.site.bare]
        return self._along(piece, lambda o, t: 0.5 * self._centred(o, t), edges, spread=3.0)

    def lay(self, piece: Piece) -> np.ndarray | None:
        """A rug on the free floor."""
        return self.site.place(piece, self.site.all_over(), self._jittered(lambda o, t: self._clearance(o)))

    def _along(
        self, piece: Piece, score: Score, edges: list[int] | None = None, spread: float = 0.4
    ) -> np.ndarray | None:
        places = self.site.along_walls(piece, edges)
        return self.site.place(piece, places, self._jittered(score, spread))

    def _jittered(self, score: Score, spread: float = 0.2) -> Score:
        """A little chance, the same for one wall as a whole, so that not every room looks alike."""
        bonus = self.rng.uniform(0.0, spread, 4)
        return lambda o, t: score(o, t) + bonus[t]

    def _centred(self, o: np.ndarray, t: np.ndarray) -> np.ndarray:
        """How near the middle of its wall, plus the wall's length, m."""
        best = np.full(len(o), -math.inf)
        for edge in self.site.edges:
            off = o - edge.start
            along = off @ edge.u
            here = (t == edge.turn) & (np.abs(off @ edge.n) < 0.05) & (along > 0) & (along < edge.length)
            value = 0.3 * edge.length - np.abs(along - 0.5 * edge.length)
            best[here] = np.maximum(best[here], value[here])
        return best

    def _from_doors(self, o: np.ndarray) -> np.ndarray:
        if not self.site.entries:
            return np.zeros(len(o))
        return np.min([np.linalg.norm(o - entry, axis=1) for entry in self.site.entries], axis=0)

    def _to_side(self, piece: Piece, o: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Metres from the piece's nearer end to the next thing along the wall."""
        x0, _, x1, _ = piece.bounds
        result = np.full(len(o), 9.0)
        rows = self.site.obstacles
        for q in np.unique(t):
            here = np.flatnonzero(t == q)
            a = q * math.pi / 2
            u, n = np.array([math.cos(a), math.sin(a)]).round(), np.array([-math.sin(a), math.cos(a)]).round()
            corners = np.stack([rows[:, :2], rows[:, 2:]], axis=1)
            for i in here:
                d = corners - o[i]
                along, across = np.sort(d @ u, axis=1), np.sort(d @ n, axis=1)
                level = (across[:, 0] < 0.3) & (across[:, 1] > 0.1)
                right, left = along[:, 0] - x1, x0 - along[:, 1]
                gaps = np.concatenate([right[level & (right > -0.01)], left[level & (left > -0.01)]])
                result[i] = gaps.min(initial=9.0)
        return result

    def _clearance(self, o: np.ndarray) -> np.ndarray:
        """Distance to the nearest obstacle, m, at most 1.5."""
        r = self.site.obstacles
        dx = np.maximum(0.0, np.maximum(r[:, 0] - o[:, :1], o[:, :1] - r[:, 2]))
        dy = np.maximum(0.0, np.maximum(r[:, 1] - o[:, 1:], o[:, 1:] - r[:, 3]))
        return np.minimum(1.5, np.hypot(dx, dy).min(axis=1))

    def all_of(self, wishes: Sequence[tuple[Callable[[Piece], np.ndarray | None], Piece]]) -> bool:
        """Place every piece in the first order in which all find a place; none of them where no order does."""
        before = self.site.state()
        for order in itertools.permutations(wishes):
            if all(place(piece) is not None for place, piece in order):
                return True
            self.site.restore(before)
        return False

    # ---- things that any room may have

    def pictures(self, most: int) -> None:
        """Up to ``most`` pictures on walls that are not bare, all different until they run out."""
        for _ in range(most):
            if not self._paintings:
                self._paintings = [str(name) for name in self.rng.permutation(decor.PAINTINGS)]
            self.hang(decor.picture(self._paintings.pop(), cm(self.rng, 0.5, 0.9)))

    def extras(self) -> None:
        """A plant, a lamp, pictures and a pendant lamp."""
        if self.chance(0.7):
            self.corner(decor.plant(self.rng, self.style))
        if self.chance(0.5):
            self.corner(living.floor_lamp(self.rng, self.style))
        self.pictures(3 if self.area > 9.0 else 2)
        self.light()

    def light(self) -> None:
        """A lamp from the ceiling at the middle of the room's bounds, or near it."""
        middle = 0.5 * (self.site.low + self.site.high)
        lamp = decor.pendant(self.rng, self.style, self.site.ceiling)
        self.site.place(lamp, self.site.all_over(), lambda o, t: -np.linalg.norm(o - middle, axis=1))

    @property
    def area(self) -> float:
        """Of the room's bounds, m^2."""
        return float(np.prod(self.site.high - self.site.low))


def _living(room: _Room) -> None:
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


def _kitchen(room: _Room) -> None:
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


def _kitchen_run(room: _Room, most: int) -> None:
    """The longest run of modules that fits, with what hangs above it where no window is in the way."""
    first = bool(room.rng.integers(2))
    for modules, hung, other in itertools.product(range(most, 2, -1), (True, False), (False, True)):
        if room.corner(kitchen.kitchen_run(room.rng, room.style, modules, hung, first ^ other)) is not None:
            return


def _dining(room: _Room) -> None:
    rng, style = room.rng, room.style
    if room.centre(living.dining(rng, style, 6 if room.area > 13.0 else 4)) is None:
        room.centre(living.dining(rng, style, 2))
    room.middle(living.sideboard(rng, style))
    room.corner(work.cabinet(rng, style))
    room.extras()


def _bedroom(room: _Room) -> None:
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


def _kids(room: _Room) -> None:
    rng, style = room.rng, room.style
    room.far_corner(bedroom.single_bed(rng, style))
    room.corner(work.desk(rng, style))
    room.corner(work.bookshelf(rng, style))
    room.corner(bedroom.toy_chest(rng, style))
    room.lay(decor.rug(rng, style, 1.2, 1.2))
    if room.chance(0.5):
        room.corner(bedroom.wardrobe(rng, style))
    room.extras()


def _study(room: _Room) -> None:
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


def _bathroom(room: _Room) -> None:
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


def _hall(room: _Room) -> None:
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


def _storage(room: _Room) -> None:
    rng, style = room.rng, room.style
    for _ in range(2):
        room.corner(work.storage_shelf(rng, style))
    room.corner(bathroom.washing_machine(rng, style))
    room.corner(work.boxes(rng, style))
    room.corner(bathroom.hamper(rng, style))
    room.light()


def _studio(room: _Room) -> None:
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


def _living_kitchen(room: _Room) -> None:
    _kitchen_run(room, 5)
    _living(room)


_PROGRAMS = {
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
KINDS = tuple(_PROGRAMS)
"""Kinds of rooms that `furnish` knows; any other is furnished as a hall."""
