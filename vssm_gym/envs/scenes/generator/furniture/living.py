"""Draw the furniture of living and dining rooms: sofas, tables, chairs, television, each in its own frame."""

import numpy as np

from vssm_gym.envs.scenes.apartment_parts import Material
from vssm_gym.envs.scenes.generator.furniture.pieces import (
    BLACK,
    STEEL,
    Block,
    Piece,
    Style,
    block,
    cm,
    cushion,
    joined,
    legs,
    one,
    pick,
    tinted,
)

AISLE = 0.48  # m between the parts of one piece that robots pass between


def sofa(rng: np.random.Generator, style: Style, width: float) -> Piece:
    """Draw base, back, two arms and cushions on short feet."""
    cover = Material(color=tinted(rng, style.fabric, 0.04), texture=pick(rng, ["fabric", "leather"]), scale=0.7)
    breadth, arm = 0.9, 0.18
    seat = [
        block(0.0, 0.5 * breadth, 0.1, width, breadth, 0.32, cover),
        block(0.0, 0.125, 0.42, width, 0.25, 0.43, cover),
        *(block(s * 0.5 * (width - arm), 0.25 + 0.325, 0.42, arm, 0.65, 0.2, cover) for s in (-1, 1)),
        *(
            block(s * (0.5 * width - 0.05), y, 0.0, 0.08, 0.08, 0.1, BLACK)
            for s in (-1, 1)
            for y in (0.06, breadth - 0.06)
        ),
    ]
    at = 0.5 * width - arm - 0.24
    seat += [block(s * at, 0.34, 0.42, 0.42, 0.17, 0.36, cushion(rng, 0.5)) for s in (-1, 1)]
    return one("sofa", seat, front=0.3)


def armchair(rng: np.random.Generator, style: Style) -> Piece:
    """Draw a single seat of leather or cloth."""
    cover = Material(color=tinted(rng, style.fabric, 0.15), texture=pick(rng, ["fabric", "leather"]), scale=0.6)
    return one(
        "armchair",
        [
            block(0.0, 0.4, 0.08, 0.8, 0.8, 0.34, cover),
            block(0.0, 0.1, 0.42, 0.8, 0.2, 0.48, cover),
            *(block(s * 0.325, 0.5, 0.42, 0.15, 0.6, 0.18, cover) for s in (-1, 1)),
            *(block(s * 0.34, y, 0.0, 0.08, 0.08, 0.08, BLACK) for s in (-1, 1) for y in (0.06, 0.74)),
            block(0.0, 0.28, 0.42, 0.36, 0.14, 0.32, cushion(rng)),
        ],
        front=0.5,
    )


def coffee_table(rng: np.random.Generator, style: Style, width: float) -> Piece:
    """Draw a table low enough to stop a robot, with a shelf, a book and a bowl."""
    wood, breadth = style.timber(), 0.6
    return one(
        "coffee table",
        [
            block(0.0, 0.5 * breadth, 0.41, width, breadth, 0.04, wood),
            *legs(0.0, 0.5 * breadth, width, breadth, 0.41, 0.06, wood),
            block(0.0, 0.5 * breadth, 0.15, width - 0.12, breadth - 0.12, 0.03, wood),
            block(-0.2, 0.28, 0.45, 0.28, 0.22, 0.03, cushion(rng, 0.3)),
            block(0.22, 0.34, 0.45, 0.16, 0.16, 0.14, Material(color=(0.5, 0.65, 0.75), texture="mosaic", scale=0.25)),
        ],
    )


def lounge(rng: np.random.Generator, style: Style) -> Piece:
    """Draw a sofa with a coffee table before it on a rug."""
    width = cm(rng, 1.8, 2.4)
    look = Material(texture=pick(rng, ["rug", "rug", "plaid", "carpet"]), color=(1.0, 0.95, 0.9), scale=1.5)
    rug = one("rug", [block(0.0, 0.95 + 0.6, 0.0, cm(rng, 2.0, 2.4), 1.2, 0.008, look)])
    table = coffee_table(rng, style, cm(rng, 0.9, 1.2)).moved(0.0, 0.9 + AISLE)
    return joined(rug, sofa(rng, style, width), table, front=0.0)


def television(rng: np.random.Generator, style: Style) -> Piece:
    """Draw a screen and a loudspeaker on a low cabinet."""
    width, screen = cm(rng, 1.4, 1.9), cm(rng, 1.0, 1.3)
    return one(
        "tv stand",
        [
            block(0.0, 0.2, 0.0, width, 0.4, 0.45, style.timber("cabinet", 0.5 * width, dark=True)),
            block(0.0, 0.21, 0.45, width + 0.04, 0.42, 0.03, style.timber(dark=True)),
            block(0.0, 0.18, 0.48, 0.4, 0.2, 0.05, BLACK),
            block(
                0.0, 0.18, 0.53, screen, 0.05, 0.57 * screen, Material(color=(1, 1, 1), texture="screen", scale=screen)
            ),
            block(
                0.5 * width - 0.1,
                0.2,
                0.48,
                0.15,
                0.2,
                0.22,
                Material(color=(0.4, 0.4, 0.42), texture="fabric", scale=0.3),
            ),
        ],
        front=0.3,
    )


def _chair(rng: np.random.Generator, style: Style, y: float, width: float) -> list[Block]:
    """Draw a dining chair that faces +y, its back edge at y."""
    seat = Material(color=tinted(rng, style.fabric, 0.15), texture="fabric", scale=0.5)
    wood, breadth = style.timber(dark=True, scale=0.7), 0.42
    return [
        block(0.0, y + 0.5 * breadth, 0.42, width, breadth, 0.05, seat),
        *legs(0.0, y + 0.5 * breadth, width, breadth, 0.42, 0.05, wood),
        block(0.0, y + 0.02, 0.47, width, 0.04, 0.45, wood),
    ]


def dining(rng: np.random.Generator, style: Style, seats: int) -> Piece:
    """Draw a table and ``seats`` chairs (2, 4 or 6) along its long sides, close enough to close the gaps between them.

    The frame's origin is the middle of the whole piece. Between the rows of chairs a robot passes under the table.
    """
    row = seats // 2
    length, breadth, thick = 0.12 + 0.1 + row * 0.54, 0.95, 0.06  # gaps of 0.1 m between 0.44 m chairs and legs
    wood = style.timber(pick(rng, ["planks", "wood"]), 1.3)
    table = one(
        "dining table",
        [
            block(0.0, 0.0, 0.70, length, breadth, 0.04, wood),
            *legs(0.0, 0.0, length, breadth, 0.70, thick, wood),
            block(0.0, 0.0, 0.74, 0.3, 0.25, 0.12, Material(color=(0.85, 0.6, 0.4), texture="mosaic", scale=0.3)),
            *(
                block(s * 0.27, s * 0.28, 0.74, 0.24, 0.24, 0.02, Material(color=(0.9, 0.92, 0.95)))
                for s in ((-1, 1) if row > 1 else ())
            ),
        ],
    )
    chairs = []
    for side in (False, True):
        for k in range(row):
            chair = one("chair", _chair(rng, style, -0.5 * breadth - 0.24, 0.44))
            chairs.append(chair.moved((k - 0.5 * (row - 1)) * 0.54 * (-1 if side else 1), 0.0, turned=side))
    return joined(table, *chairs, airy=True)


def bistro(rng: np.random.Generator, style: Style) -> Piece:
    """Draw a square table with two chairs, close enough to leave no passage under it."""
    wood = style.timber()
    top = one(
        "table",
        [
            block(0.0, 0.0, 0.70, 0.7, 0.7, 0.04, wood),
            *legs(0.0, 0.0, 0.7, 0.7, 0.70, 0.06, wood),
            block(0.0, 0.0, 0.74, 0.16, 0.16, 0.2, Material(color=(0.4, 0.7, 0.6), texture="leaves", scale=0.3)),
        ],
    )
    chairs = [one("chair", _chair(rng, style, -0.47, 0.42)).moved(0.0, 0.0, turned=turned) for turned in (False, True)]
    return joined(top, *chairs, airy=True)


def sideboard(rng: np.random.Generator, style: Style) -> Piece:
    """Draw a long low cabinet with a vase and books."""
    width = cm(rng, 1.2, 1.8)
    return one(
        "sideboard",
        [
            block(0.0, 0.22, 0.0, width, 0.44, 0.8, style.timber("cabinet", 0.5 * width)),
            block(0.0, 0.225, 0.8, width + 0.04, 0.45, 0.03, style.timber()),
            block(
                -0.3 * width,
                0.2,
                0.83,
                0.18,
                0.18,
                0.28,
                Material(color=tinted(rng, (0.5, 0.6, 0.7), 0.2), texture="stucco", scale=0.3),
            ),
            block(0.25 * width, 0.2, 0.83, 0.3, 0.2, 0.22, Material(color=(1, 1, 1), texture="books", scale=0.4)),
        ],
        front=0.5,
    )


def floor_lamp(rng: np.random.Generator, style: Style) -> Piece:
    """Draw foot, pole and shade."""
    shade = Material(color=tinted(rng, (0.97, 0.90, 0.75), 0.05), texture="fabric", scale=0.4)
    return one(
        "lamp",
        [
            block(0.0, 0.16, 0.0, 0.28, 0.28, 0.03, BLACK),
            block(0.0, 0.16, 0.03, 0.06, 0.06, 1.37, STEEL),
            block(0.0, 0.16, 1.40, 0.3, 0.3, 0.3, shade),
        ],
    )
