"""Define furniture: blocks in a piece's own frame, parts (one `Furniture` each), pieces placed as one.

The frame of a piece: origin on the floor at the middle of its back, x to the right along the wall as seen from the
wall, y away from the wall into the room, z up; metres. Sizes are whole centimetres, so that places compare exactly.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from vssm_gym.envs.scenes.apartment_parts import Material
from vssm_gym.envs.scenes.free_space import STEP_HEIGHT

Color = tuple[float, float, float]
T = TypeVar("T")

WHITE: Color = (1.0, 1.0, 1.0)  # RGB in [0, 1], as all colours of pieces
BLACK = Material(color=(0.15, 0.15, 0.16))  # of screens, hobs and feet
STEEL = Material(color=(0.80, 0.82, 0.85), texture="metal", scale=0.8)
CERAMIC = Material(color=(0.97, 0.97, 0.99))  # of sinks and baths
LOW_BLOCK = 0.5  # m: a block that begins below it and ends above STEP_HEIGHT stops a ground robot


@dataclass(frozen=True)
class Block:
    """Define an upright box in the piece's frame: from ``low`` to ``high`` (x, y, z)."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    material: Material


@dataclass(frozen=True)
class PiecePart:
    """Define one article of furniture: a ``category`` and its blocks."""

    category: str
    blocks: tuple[Block, ...]

    @property
    def on_floor(self) -> tuple[float, float, float, float] | None:
        """Return (x0, y0, x1, y1) of what stops a ground robot; None for rugs and what hangs."""
        low = [b for b in self.blocks if b.low[2] < LOW_BLOCK and b.high[2] > STEP_HEIGHT]
        if not low:
            return None
        return (
            min(b.low[0] for b in low),
            min(b.low[1] for b in low),
            max(b.high[0] for b in low),
            max(b.high[1] for b in low),
        )


@dataclass(frozen=True)
class Piece:
    """Define parts that are placed together.

    ``front``: metres before the whole piece that stay free, to open or to use it. ``airy``: robots pass under it
    or into its nooks, so everything else keeps the width of a passage from it.
    """

    parts: tuple[PiecePart, ...]
    front: float = 0.0
    airy: bool = False

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Return (x0, y0, x1, y1) of all blocks."""
        blocks = [b for part in self.parts for b in part.blocks]
        return (
            min(b.low[0] for b in blocks),
            min(b.low[1] for b in blocks),
            max(b.high[0] for b in blocks),
            max(b.high[1] for b in blocks),
        )

    @property
    def on_floor(self) -> np.ndarray:
        """Return what stops a ground robot, (n, 4).

        Parts that overlap, as a chair and its table, count as one rectangle.
        """
        merged: list[tuple[float, ...]] = []
        for part in self.parts:
            rect: tuple[float, ...] | None = part.on_floor
            if rect is None:
                continue
            met = [r for r in merged if r[0] < rect[2] and rect[0] < r[2] and r[1] < rect[3] and rect[1] < r[3]]
            merged = [r for r in merged if r not in met]
            rows = np.array([rect, *met])
            merged.append((*rows[:, :2].min(axis=0).tolist(), *rows[:, 2:].max(axis=0).tolist()))
        return np.array(merged).reshape(-1, 4)

    def moved(self, x: float, y: float, turned: bool = False) -> "Piece":
        """Return the piece shifted by (x, y); first turned by half a turn about its origin if asked."""
        return Piece(tuple(_moved(part, x, y, turned) for part in self.parts), self.front, self.airy)


def _moved(part: PiecePart, x: float, y: float, turned: bool) -> PiecePart:
    blocks = []
    for b in part.blocks:
        xs, ys = (b.low[0], b.high[0]), (b.low[1], b.high[1])
        if turned:
            xs, ys = (-xs[1], -xs[0]), (-ys[1], -ys[0])
        low = (round(xs[0] + x, 4), round(ys[0] + y, 4), b.low[2])
        high = (round(xs[1] + x, 4), round(ys[1] + y, 4), b.high[2])
        blocks.append(Block(low, high, b.material))
    return PiecePart(part.category, tuple(blocks))


def block(x: float, y: float, z: float, w: float, d: float, h: float, material: Material) -> Block:
    """Return a block of w x d x h centred at (x, y) with its underside at z."""
    low, high = (x - 0.5 * w, y - 0.5 * d, z), (x + 0.5 * w, y + 0.5 * d, z + h)
    return Block(tuple(round(v, 4) for v in low), tuple(round(v, 4) for v in high), material)  # type: ignore[arg-type]


def legs(x: float, y: float, w: float, d: float, top: float, thick: float, material: Material) -> list[Block]:
    """Return four legs at the corners of a w x d rectangle centred at (x, y)."""
    dx, dy = 0.5 * (w - thick), 0.5 * (d - thick)
    return [block(x + i * dx, y + j * dy, 0.0, thick, thick, top, material) for i in (-1, 1) for j in (-1, 1)]


def one(category: str, blocks: Sequence[Block], front: float = 0.0, airy: bool = False) -> Piece:
    """Return a piece of a single part."""
    return Piece((PiecePart(category, tuple(blocks)),), front, airy)


def joined(*pieces: Piece, front: float = 0.0, airy: bool = False) -> Piece:
    """Join pieces that keep their places relative to each other."""
    return Piece(tuple(part for piece in pieces for part in piece.parts), front, airy)


def cm(rng: np.random.Generator, low: float, high: float, step: float = 0.05) -> float:
    """Draw a length in [low, high] on a grid of ``step`` m from ``low``."""
    return round(low + step * int(rng.integers(0, round((high - low) / step) + 1)), 3)


def pick(rng: np.random.Generator, options: Sequence[T]) -> T:
    """Draw one of the options."""
    return options[int(rng.integers(len(options)))]


def tinted(rng: np.random.Generator, color: Color, spread: float = 0.06) -> Color:
    """Vary a colour: a little lighter or darker and off in hue; two digits."""
    r, g, b = (float(np.clip(c + d, 0.05, 1.0)) for c, d in zip(color, rng.uniform(-spread, spread, 3), strict=True))
    return (round(r, 2), round(g, 2), round(b, 2))


# RGB in [0, 1] of which each piece draws one.
WOODS: tuple[Color, ...] = ((0.78, 0.60, 0.40), (0.55, 0.38, 0.25), (0.88, 0.72, 0.52), (0.40, 0.27, 0.19))
# The same of covers.
FABRICS: tuple[Color, ...] = (
    (0.42, 0.52, 0.62),
    (0.55, 0.62, 0.42),
    (0.66, 0.40, 0.25),
    (0.70, 0.35, 0.30),
    (0.80, 0.72, 0.58),
    (0.35, 0.40, 0.55),
    (0.62, 0.50, 0.60),
    (0.85, 0.62, 0.30),
)


@dataclass(frozen=True)
class Style:
    """Define what a room's furniture has in common: two woods and a colour of upholstery."""

    wood: Color
    dark: Color
    fabric: Color

    @classmethod
    def draw(cls, rng: np.random.Generator) -> "Style":
        """Draw a style at random."""
        return cls(tinted(rng, pick(rng, WOODS), 0.03), tinted(rng, pick(rng, WOODS[1::2]), 0.03), pick(rng, FABRICS))

    def timber(self, texture: str = "wood", scale: float = 0.8, dark: bool = False) -> Material:
        """Return the wood of this room with a texture such as cabinet or drawers."""
        return Material(color=self.dark if dark else self.wood, texture=texture, scale=scale)


def cushion(rng: np.random.Generator, scale: float = 0.4) -> Material:
    """Draw a patterned cover in any colour."""
    return Material(
        color=tinted(rng, pick(rng, [(0.9, 0.8, 0.65), (0.8, 0.85, 0.95), (0.95, 0.7, 0.5), (0.7, 0.85, 0.7)])),
        texture=pick(rng, ["plaid", "stripes", "wallpaper", "mosaic"]),
        scale=scale,
    )
