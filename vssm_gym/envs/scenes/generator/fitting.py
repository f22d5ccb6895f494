"""Place a piece in a room as people do: at the middle of a wall, in a corner, beside a bed, around a table."""

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np

from vssm_gym.envs.scenes.generator.furniture import decor, living
from vssm_gym.envs.scenes.generator.furniture.pieces import Piece, Style, cm
from vssm_gym.envs.scenes.generator.placement import Score, Site


class Fitting:
    """Furnish a room: hold its site, its random stream and its style, and place pieces by rules."""

    def __init__(self, site: Site, rng: np.random.Generator) -> None:
        self.site, self.rng, self.style = site, rng, Style.draw(rng)
        self._paintings: list[str] = []

    def chance(self, p: float) -> bool:
        """Return True with probability p."""
        return bool(self.rng.uniform() < p)

    # ---- rules of placing: each returns (x, y, turn) or None

    def middle(self, piece: Piece) -> np.ndarray | None:
        """Place the piece at the middle of a wall, long walls first, away from the doors."""
        return self._along(piece, lambda o, t: 0.6 * self._centred(o, t) + 0.25 * self._from_doors(o))

    def corner(self, piece: Piece) -> np.ndarray | None:
        """Place the piece at the end of a wall, or beside what stands there."""
        return self._along(piece, lambda o, t: -self._to_side(piece, o, t) + 0.05 * self._from_doors(o))

    def far_corner(self, piece: Piece) -> np.ndarray | None:
        """Place the piece as `corner`, but away from the doors above all."""
        return self._along(piece, lambda o, t: -self._to_side(piece, o, t) + 0.5 * self._from_doors(o))

    def beside(self, piece: Piece, at: np.ndarray | None) -> np.ndarray | None:
        """Place the piece along a wall, near a place."""
        if at is None:
            return self.corner(piece)
        return self._along(piece, lambda o, t: -np.linalg.norm(o - at[:2], axis=1))

    def facing(self, piece: Piece, at: np.ndarray | None) -> np.ndarray | None:
        """Place the piece at a wall opposite to a placed piece, in its middle line."""
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
        """Place the piece free in the room, where most floor is around it."""
        places = self.site.all_over()
        return self.site.place(piece, places, self._jittered(lambda o, t: self._clearance(o)))

    def hang(self, piece: Piece) -> np.ndarray | None:
        """Hang the piece at any wall that is not bare."""
        edges = [i for i, edge in enumerate(self.site.edges) if edge.side not in self.site.bare]
        return self._along(piece, lambda o, t: 0.5 * self._centred(o, t), edges, spread=3.0)

    def lay(self, piece: Piece) -> np.ndarray | None:
        """Lay a rug on the free floor."""
        return self.site.place(piece, self.site.all_over(), self._jittered(lambda o, t: self._clearance(o)))

    def _along(
        self, piece: Piece, score: Score, edges: list[int] | None = None, spread: float = 0.4
    ) -> np.ndarray | None:
        places = self.site.along_walls(piece, edges)
        return self.site.place(piece, places, self._jittered(score, spread))

    def _jittered(self, score: Score, spread: float = 0.2) -> Score:
        """Add a little noise to a score, the same for one wall as a whole, so that rooms differ."""
        bonus = self.rng.uniform(0.0, spread, 4)
        return lambda o, t: score(o, t) + bonus[t]

    def _centred(self, o: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return how near the middle of its wall a place is, plus the wall's length, m."""
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
        """Return the distance from the piece's nearer end to the next thing along the wall, m."""
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
        """Return the distance to the nearest obstacle, m, at most 1.5."""
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
        """Hang up to ``most`` pictures on walls that are not bare, all different until they run out."""
        for _ in range(most):
            if not self._paintings:
                self._paintings = [str(name) for name in self.rng.permutation(decor.PAINTINGS)]
            self.hang(decor.picture(self._paintings.pop(), cm(self.rng, 0.5, 0.9)))

    def extras(self) -> None:
        """Place a plant, a lamp, pictures and a pendant lamp."""
        if self.chance(0.7):
            self.corner(decor.plant(self.rng, self.style))
        if self.chance(0.5):
            self.corner(living.floor_lamp(self.rng, self.style))
        self.pictures(3 if self.area > 9.0 else 2)
        self.light()

    def light(self) -> None:
        """Hang a lamp from the ceiling at the middle of the room's bounds, or near it."""
        middle = 0.5 * (self.site.low + self.site.high)
        lamp = decor.pendant(self.rng, self.style, self.site.ceiling)
        self.site.place(lamp, self.site.all_over(), lambda o, t: -np.linalg.norm(o - middle, axis=1))

    @property
    def area(self) -> float:
        """Return the area of the room's bounds, m^2."""
        return float(np.prod(self.site.high - self.site.low))
