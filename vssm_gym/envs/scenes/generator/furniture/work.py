"""Draw the furniture of studies, halls and stores: desks, shelves and cabinets, each in its own frame."""

import numpy as np

from vssm_gym.envs.scenes.apartment_parts import Material
from vssm_gym.envs.scenes.generator.furniture.pieces import (
    BLACK,
    STEEL,
    WHITE,
    Piece,
    Style,
    block,
    cm,
    cushion,
    joined,
    one,
    pick,
    tinted,
)


def desk(rng: np.random.Generator, style: Style) -> Piece:
    """Draw a desk of 1.2 m between a drawer block and a side panel that the chair fills: no passage under it."""
    wood, width, breadth = style.timber(scale=0.9), 1.2, 0.65
    screen = Material(color=WHITE, texture="screen", scale=0.6)
    table = one(
        "desk",
        [
            block(0.0, 0.5 * breadth, 0.70, width, breadth, 0.04, wood),
            block(0.38, 0.5 * breadth, 0.0, 0.42, breadth - 0.04, 0.70, style.timber("drawers", 0.7)),
            block(-0.195, 0.075, 0.0, 0.73, 0.15, 0.70, wood),  # a back panel with cables behind it
            block(-0.58, 0.5 * breadth, 0.0, 0.04, breadth - 0.04, 0.70, wood),
            block(-0.2, 0.14, 0.74, 0.2, 0.16, 0.02, BLACK),
            block(-0.2, 0.12, 0.76, 0.06, 0.04, 0.2, BLACK),
            block(-0.2, 0.15, 0.86, 0.6, 0.03, 0.36, screen),
            block(-0.2, 0.45, 0.74, 0.42, 0.14, 0.02, Material(color=(0.5, 0.5, 0.55), texture="checker", scale=0.2)),
            block(0.42, 0.2, 0.74, 0.3, 0.2, 0.22, Material(color=WHITE, texture="books", scale=0.4)),
            block(0.15, 0.12, 0.74, 0.08, 0.08, 0.34, STEEL),
            block(0.15, 0.16, 1.08, 0.22, 0.2, 0.14, Material(color=tinted(rng, (0.9, 0.6, 0.35), 0.1))),
        ],
    )
    cover = Material(color=tinted(rng, (0.3, 0.34, 0.42), 0.1), texture="fabric", scale=0.4)
    chair = one(
        "chair",
        [
            block(-0.195, 0.41, 0.44, 0.52, 0.48, 0.08, cover),
            block(-0.195, 0.70, 0.58, 0.44, 0.06, 0.47, cover),
            block(-0.195, 0.66, 0.52, 0.06, 0.06, 0.06, STEEL),
            block(-0.195, 0.41, 0.07, 0.08, 0.08, 0.37, STEEL),
            block(-0.195, 0.41, 0.0, 0.52, 0.08, 0.07, BLACK),
            block(-0.195, 0.41, 0.0, 0.08, 0.48, 0.07, BLACK),
        ],
    )
    return joined(table, chair, front=0.0)


def bookshelf(rng: np.random.Generator, style: Style) -> Piece:
    """Draw an open shelf, its boards filled with books from one side or the other."""
    width, boards = cm(rng, 0.8, 1.6, 0.2), int(rng.integers(4, 7))
    wood, height = style.timber(dark=bool(rng.integers(2))), 0.06 + 0.36 * boards
    blocks = [
        block(0.0, 0.01, 0.0, width, 0.02, height, wood),
        *(block(s * 0.5 * (width - 0.04), 0.16, 0.0, 0.04, 0.28, height, wood) for s in (-1, 1)),
    ]
    inner = round(width - 0.08, 2)
    blocks += [block(0.0, 0.16, round(0.03 + 0.36 * k, 2), inner, 0.28, 0.03, wood) for k in range(boards + 1)]
    for k in range(boards):
        run = round(inner * (0.6 + 0.1 * int(rng.integers(0, 5))), 2)
        x = pick(rng, (-1, 1)) * 0.5 * (inner - run)
        look = Material(color=tinted(rng, (0.94, 0.92, 0.88), 0.06), texture="books", scale=0.5)
        blocks.append(block(x, 0.13, round(0.06 + 0.36 * k, 2), run, 0.2, cm(rng, 0.22, 0.27, 0.01), look))
    return one("bookshelf", blocks, front=0.5)


def cabinet(rng: np.random.Generator, style: Style) -> Piece:
    """Draw a filing cabinet or a chest, with a box and a picture on it."""
    width, height = cm(rng, 0.8, 1.0), cm(rng, 0.9, 1.1)
    look = pick(
        rng,
        [
            style.timber("drawers", height),
            Material(color=tinted(rng, (0.6, 0.66, 0.7), 0.05), texture="drawers", scale=height),
        ],
    )
    return one(
        "cabinet",
        [
            block(0.0, 0.225, 0.0, width, 0.45, height, look),
            block(-0.2, 0.2, height, 0.3, 0.28, 0.24, Material(color=(0.75, 0.6, 0.42), texture="wicker", scale=0.4)),
            block(0.2, 0.14, height, 0.26, 0.06, 0.26, Material(color=WHITE, texture="painting_map", scale=0.26)),
        ],
        front=0.5,
    )


def shoe_cabinet(rng: np.random.Generator, style: Style) -> Piece:
    """Draw a shallow cabinet for halls."""
    width = cm(rng, 0.8, 1.2)
    return one(
        "shoe cabinet",
        [
            block(0.0, 0.14, 0.0, width, 0.28, 0.85, style.timber("drawers", 0.85)),
            block(0.0, 0.15, 0.85, width + 0.04, 0.3, 0.03, style.timber()),
            block(
                -0.25,
                0.14,
                0.88,
                0.18,
                0.18,
                0.24,
                Material(color=tinted(rng, (0.4, 0.55, 0.5), 0.1), texture="stucco"),
            ),
            block(0.2, 0.14, 0.88, 0.3, 0.2, 0.06, Material(color=(0.8, 0.65, 0.45), texture="wicker", scale=0.3)),
        ],
        front=0.5,
    )


def coat_rack(rng: np.random.Generator, style: Style) -> Piece:
    """Draw a board with two coats at its hooks."""
    coats = [
        Material(color=tinted(rng, c, 0.1), texture=t, scale=0.4)
        for c, t in (((0.35, 0.4, 0.55), "fabric"), ((0.8, 0.5, 0.4), "plaid"))
    ]
    return one(
        "coat rack",
        [
            block(0.0, 0.03, 1.6, 0.8, 0.06, 0.1, style.timber(dark=True)),
            block(-0.2, 0.09, 1.0, 0.25, 0.12, 0.6, coats[0]),
            block(0.2, 0.085, 1.1, 0.25, 0.11, 0.5, coats[1]),
        ],
    )


def bench(rng: np.random.Generator, style: Style) -> Piece:
    """Draw a low chest with a cushion to sit on."""
    width = cm(rng, 0.9, 1.3)
    return one(
        "bench",
        [
            block(0.0, 0.2, 0.0, width, 0.4, 0.4, style.timber("planks", 1.0)),
            block(0.0, 0.2, 0.4, width - 0.04, 0.38, 0.06, cushion(rng, 0.6)),
        ],
        front=0.5,
    )


def storage_shelf(rng: np.random.Generator, style: Style) -> Piece:
    """Draw a metal shelf with boxes."""
    width = cm(rng, 0.8, 1.2, 0.2)
    blocks = [block(s * 0.5 * (width - 0.04), 0.2, 0.0, 0.04, 0.4, 1.8, STEEL) for s in (-1, 1)]
    for k in range(4):
        z = round(0.05 + 0.55 * k, 2)
        blocks.append(block(0.0, 0.2, z, width - 0.08, 0.4, 0.03, STEEL))
        for s in (-1, 1) if k < 3 else ():
            look = Material(
                color=tinted(rng, pick(rng, [(0.75, 0.6, 0.42), (0.5, 0.6, 0.75), (0.7, 0.4, 0.35)]), 0.05),
                texture=pick(rng, ["wicker", "concrete", "cabinet"]),
                scale=0.4,
            )
            w = cm(rng, 0.25, 0.33, 0.01)
            blocks.append(block(s * 0.25 * (width - 0.08), 0.2, round(z + 0.03, 2), w, 0.32, cm(rng, 0.2, 0.4), look))
    return one("storage shelf", blocks, front=0.5)


def boxes(rng: np.random.Generator, style: Style) -> Piece:
    """Draw two cardboard boxes on each other."""
    look = Material(color=(0.75, 0.6, 0.42), texture="stucco", scale=0.5)
    return one("boxes", [block(0.0, 0.25, 0.0, 0.5, 0.5, 0.4, look), block(0.03, 0.23, 0.4, 0.4, 0.4, 0.3, look)])
