"""Draw what all rooms share: rugs, plants, pictures, pendant lamps, each piece in its own frame."""

import numpy as np

from vssm_gym.envs.scenes.apartment_parts import Material
from vssm_gym.envs.scenes.generator.furniture.pieces import BLACK, WHITE, Piece, Style, block, cm, one, pick, tinted
from vssm_gym.envs.textures.motifs import PICTURES

PAINTINGS = tuple(sorted(name for name in PICTURES if name.startswith("painting")))


def plant(rng: np.random.Generator, style: Style) -> Piece:
    """Draw pot, stem and two tiers of leaves."""
    pot, crown = cm(rng, 0.3, 0.4), cm(rng, 0.4, 0.65)
    soil = Material(color=tinted(rng, (0.72, 0.42, 0.3), 0.12), texture="stucco", scale=0.5)
    return one(
        "plant",
        [
            block(0.0, 0.5 * pot, 0.0, pot, pot, 0.35, soil),
            block(0.0, 0.5 * pot, 0.35, 0.06, 0.06, 0.2, Material(color=(0.42, 0.28, 0.18), texture="wood", scale=0.4)),
            block(
                0.0, 0.5 * pot, 0.55, pot - 0.02, pot - 0.02, crown, Material(color=WHITE, texture="leaves", scale=0.55)
            ),
            block(
                0.0,
                0.5 * pot,
                round(0.55 + crown, 2),
                round(0.66 * pot, 2),
                round(0.66 * pot, 2),
                0.3,
                Material(color=(0.9, 1.0, 0.85), texture="leaves", scale=0.5),
            ),
        ],
    )


def rug(rng: np.random.Generator, style: Style, width: float, breadth: float) -> Piece:
    """Draw a rug thinner than the step that stops a robot; its frame's origin is its middle."""
    look = Material(
        color=tinted(rng, (0.88, 0.86, 0.82), 0.1), texture=pick(rng, ["rug", "rug", "plaid", "carpet"]), scale=width
    )
    return one("rug", [block(0.0, 0.0, 0.0, width, breadth, 0.008, look)])


def picture(painting: str, size: float) -> Piece:
    """Draw a square painting, one of `PAINTINGS`, its middle 1.5 m above the floor."""
    look = Material(color=WHITE, texture=painting, scale=size)
    return one("picture", [block(0.0, 0.015, round(1.5 - 0.5 * size, 3), size, 0.03, size, look)])


def wall_shelf(rng: np.random.Generator, style: Style) -> Piece:
    """Draw a board with books and a pot on the wall."""
    width = cm(rng, 0.6, 1.0)
    return one(
        "wall shelf",
        [
            block(0.0, 0.11, 1.4, width, 0.22, 0.03, style.timber()),
            block(
                -0.12, 0.1, 1.43, round(0.5 * width, 2), 0.18, 0.22, Material(color=WHITE, texture="books", scale=0.4)
            ),
            block(
                round(0.36 * width, 2), 0.1, 1.43, 0.14, 0.14, 0.2, Material(color=WHITE, texture="leaves", scale=0.3)
            ),
        ],
    )


def pendant(rng: np.random.Generator, style: Style, ceiling: float) -> Piece:
    """Draw a lamp that hangs from the ceiling, above all heads; its frame's origin is its middle."""
    shade = Material(color=tinted(rng, (0.97, 0.88, 0.70), 0.05), texture=pick(rng, ["fabric", "wicker"]), scale=0.4)
    low = round(ceiling - 0.45, 3)
    return one(
        "pendant lamp",
        [block(0.0, 0.0, low, 0.36, 0.36, 0.22, shade), block(0.0, 0.0, low + 0.22, 0.03, 0.03, 0.22, BLACK)],
    )
