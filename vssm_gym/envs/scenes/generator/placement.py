"""Find where a piece may stand in a room: `Site` holds what has been placed, and the rules of docs/scenes.md.

A place is refused where a block would meet another one, a wall, a door's swing or a window; where a gap would be left
that is neither closed (<= CLOSED) nor a passage (>= PASSAGE); or where the room's doors would no longer be joined by
free floor wide enough to drive on. Rooms are axis-parallel and pieces stand in quarter turns, so that all of this is
comparison of numbers: the same on every machine.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from vssm_gym.envs.scenes.apartment_parts import ROUNDING, Box, Furniture
from vssm_gym.envs.scenes.free_space import STEP_HEIGHT
from vssm_gym.envs.scenes.generator.furniture.pieces import LOW_BLOCK, Block, Piece
from vssm_gym.envs.scenes.generator.ground import BACK_GAP, Ground
from vssm_gym.envs.scenes.generator.quarter_turns import contains, gaps, overlap, overlap3, turned, turned3

CLOSED, PASSAGE = 0.11, 0.47  # m: gaps between two things are at most the one or at least the other
WIDE_DISC = 0.21  # m, radius of the disc that reaches every door of a room
_CELL = 0.02  # m, grid on which passages are traced
_POCKET = 0.15  # m^2 of floor that a piece may cut off
_TRIES = 12  # places that would block a passage, after which a piece is given up

Score = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Origins (n, 2) and quarter turns (n,) of places to what they are worth (n,); the highest is taken."""


class Site:
    """Hold one room while it is being furnished.

    Args:
        name: of the room; its furniture is named after it.
        ground: the floor and what stands there before.
        ceiling: height, m.
        bare: edges of the room whose walls stay without pictures.
    """

    def __init__(self, name: str, ground: Ground, ceiling: float, bare: frozenset[int]) -> None:
        self.name, self.bare, self.ceiling = name, bare, ceiling
        self.low, self.high = ground.corners.min(axis=0), ground.corners.max(axis=0)
        self.edges, self.entries, self.closed, self._margin = ground.edges, ground.entries, ground.closed, ground.margin
        self.solids = ground.solids  # (n, 6) low and high corners of the placed blocks
        low = (self.solids[:, 2] < LOW_BLOCK) & (self.solids[:, 5] > STEP_HEIGHT)
        self.obstacles = self.solids[low][:, [0, 1, 3, 4]]  # (n, 4) obstacles of a ground robot
        self.airy = np.zeros(len(self.obstacles), dtype=bool)
        self.fronts = np.zeros((0, 4))
        self._inside = contains(ground.corners)
        self.furniture: list[Furniture] = []
        self._names: dict[str, int] = {}

    # ---- places

    def along_walls(self, piece: Piece, edges: list[int] | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return places with the piece's back to a wall, every 5 cm and flush with both ends."""
        x0, _, x1, _ = piece.bounds
        origins, turns = [], []
        for i, edge in enumerate(self.edges):
            if edges is not None and i not in edges:
                continue
            # The ends of the edge lie on the centre lines of the walls that meet it.
            first, last = self._margin - x0, edge.length - self._margin - x1
            if last < first:
                continue
            at = np.unique(np.round(np.concatenate([np.arange(first, last, 0.05), [last]]), 4))
            origins.append(edge.start + at[:, None] * edge.u + BACK_GAP * edge.n)
            turns.append(np.full(len(at), edge.turn))
        if not origins:
            return np.zeros((0, 2)), np.zeros(0, dtype=int)
        return np.round(np.concatenate(origins), 4), np.concatenate(turns)

    def all_over(self) -> tuple[np.ndarray, np.ndarray]:
        """Return places on a grid of 0.1 m, along x and along y."""
        xs, ys = (np.arange(a + 0.3, b - 0.3, 0.1) for a, b in zip(self.low, self.high, strict=True))
        grid = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1).reshape(-1, 2)
        return np.round(np.concatenate([grid, grid]), 4), np.repeat([0, 1], len(grid))

    def place(self, piece: Piece, places: tuple[np.ndarray, np.ndarray], score: Score) -> np.ndarray | None:
        """Put the piece at the best place that the rules allow; None if there is none.

        Returns:
            (x, y) of its origin and its quarter turns.
        """
        origins, turns = places
        if not len(origins):
            return None
        good = self._allowed(piece, origins, turns)
        origins, turns = origins[good], turns[good]
        if not len(origins):
            return None
        worth = score(origins, turns)
        occupied = np.concatenate([self.solids, self.closed])
        blocks = np.array([[*b.low, *b.high] for part in piece.parts for b in part.blocks])
        refused: list[int] = []
        for i in np.argsort(-worth, kind="stable").tolist():
            # Places lie side by side: where one would block a passage, so would its neighbours.
            if any(np.abs(origins[i] - origins[j]).sum() < 0.12 and turns[i] == turns[j] for j in refused):
                continue
            shift = np.array([*origins[i], 0.0, *origins[i], 0.0])
            if overlap3(turned3(blocks, turns[i]) + shift, occupied).any():
                continue
            if self._keeps_passages(piece, origins[i], int(turns[i])):
                self._add(piece, origins[i], int(turns[i]))
                return np.array([*origins[i], turns[i]])
            refused.append(i)
            if len(refused) == _TRIES:
                break
        return None

    def state(self) -> dict[str, Any]:
        """Return what has been placed so far, for `restore`."""
        return self.__dict__ | {"furniture": list(self.furniture), "_names": dict(self._names)}

    def restore(self, state: dict[str, Any]) -> None:
        """Remove what was placed after `state`."""
        self.__dict__.update(state | {"furniture": list(state["furniture"]), "_names": dict(state["_names"])})

    # ---- rules

    def _allowed(
        self, piece: Piece, origins: Float[np.ndarray, "n 2"], turns: Int[np.ndarray, "n"]
    ) -> Bool[np.ndarray, "n"]:
        good = np.zeros(len(origins), dtype=bool)
        lying = piece.on_floor
        for q in np.unique(turns):
            where = np.flatnonzero(turns == q)
            moved = origins[where]
            rects = turned(np.array([piece.bounds]), q)[None] + np.tile(moved, 2)[:, None]
            ok = self._inside(rects[:, 0, :2]) & self._inside(rects[:, 0, 2:])
            ok &= self._inside(0.5 * (rects[:, 0, :2] + rects[:, 0, 2:]))
            if len(lying):
                low = turned(lying, q)[None] + np.tile(moved, 2)[:, None]
                gap = gaps(low, self.obstacles)
                closed = np.where(self.airy, -1.0, CLOSED)  # nothing stands close to a piece that robots pass under
                if piece.airy:
                    closed = np.full(len(self.airy), -1.0)
                ok &= ((gap <= closed) | (gap >= PASSAGE)).all(axis=(1, 2))
                ok &= ~overlap(low, self.fronts).any(axis=(1, 2))
            if piece.front > 0.0:
                x0, _, x1, y1 = piece.bounds
                ahead = turned(np.array([[x0, y1, x1, y1 + piece.front]]), q)[None] + np.tile(moved, 2)[:, None]
                ok &= ~overlap(ahead, self.obstacles).any(axis=(1, 2))
            good[where] = ok
        return good

    def _keeps_passages(self, piece: Piece, origin: np.ndarray, turn: int) -> bool:
        """Return True if a disc of radius WIDE_DISC still reaches all doors, and little floor is cut off from them."""
        rects = piece.on_floor
        if not len(rects):
            return True
        rects = turned(rects, turn) + np.tile(origin, 2)
        shape = np.ceil((self.high - self.low) / _CELL).astype(int)
        blocked = np.zeros(shape + 2, dtype=bool)
        blocked[[0, -1]] = blocked[:, [0, -1]] = True
        centres = [self.low[k] + _CELL * (np.arange(shape[k]) + 0.5) for k in range(2)]
        grid = np.stack(np.meshgrid(*centres, indexing="ij"), axis=-1)
        blocked[1:-1, 1:-1] = ~self._inside(grid.reshape(-1, 2)).reshape(shape)
        for x0, y0, x1, y1 in np.concatenate([self.obstacles, rects]):
            a, b = np.floor((np.array([x0, y0]) - self.low) / _CELL + ROUNDING).astype(int) + 1
            c, d = np.ceil((np.array([x1, y1]) - self.low) / _CELL - ROUNDING).astype(int) + 1
            blocked[max(a, 0) : max(c, 0), max(b, 0) : max(d, 0)] = True
        free = ndimage.distance_transform_edt(~blocked) * _CELL > WIDE_DISC
        parts, _ = ndimage.label(free)
        if not self.entries:
            return bool(parts.max() == 1)
        doors = set()
        for entry in self.entries:
            i, j = np.floor((entry - self.low) / _CELL).astype(int) + 1
            near = parts[max(i - 12, 0) : i + 13, max(j - 12, 0) : j + 13]
            doors.add(int(near[near > 0].min()) if (near > 0).any() else 0)
        if 0 in doors or len(doors) > 1:
            return False
        lost = (parts > 0) & (parts != doors.pop())
        return bool(lost.sum() * _CELL**2 <= _POCKET)

    def _add(self, piece: Piece, origin: np.ndarray, turn: int) -> None:
        shift4, shift6 = np.tile(origin, 2), np.array([*origin, 0.0, *origin, 0.0])
        rects = piece.on_floor
        self.obstacles = np.concatenate([self.obstacles, turned(rects, turn) + shift4])
        self.airy = np.concatenate([self.airy, np.full(len(rects), piece.airy)])
        if piece.front > 0.0:
            x0, _, x1, y1 = piece.bounds
            ahead = turned(np.array([[x0, y1, x1, y1 + piece.front]]), turn) + shift4
            self.fronts = np.concatenate([self.fronts, ahead])
        for part in piece.parts:
            blocks = turned3(np.array([[*b.low, *b.high] for b in part.blocks]), turn) + shift6
            if blocks[:, 5].max() > STEP_HEIGHT:  # rugs lie under the rest
                self.solids = np.concatenate([self.solids, blocks])
            count = self._names[part.category] = self._names.get(part.category, 0) + 1
            name = f"{self.name} {part.category}" + (f" {count}" if count > 1 else "")
            made = tuple(_box(row, b) for row, b in zip(blocks, part.blocks, strict=True))
            self.furniture.append(Furniture(name=name, category=part.category, boxes=made))


def _box(row: np.ndarray, b: Block) -> Box:
    center = tuple(round(float(0.5 * (row[k] + row[k + 3])), 4) for k in range(3))
    size = tuple(round(float(row[k + 3] - row[k]), 4) for k in range(3))
    return Box(center=center, size=size, material=b.material)  # type: ignore[arg-type]
