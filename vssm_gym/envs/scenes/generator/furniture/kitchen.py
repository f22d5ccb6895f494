"""Draw the furniture of kitchens: a run of modules along a wall, what hangs above it, islands."""

import numpy as np

from vssm_gym.envs.scenes.apartment_parts import Material
from vssm_gym.envs.scenes.generator.furniture.pieces import (
    BLACK,
    STEEL,
    WHITE,
    Block,
    Piece,
    PiecePart,
    Style,
    block,
    one,
    pick,
    tinted,
)

MODULE = 0.6  # m


def kitchen_run(rng: np.random.Generator, style: Style, modules: int, hung: bool, reverse: bool) -> Piece:
    """Draw ``modules`` (3 or more) of 0.6 m: counters, a sink, a stove, and from four on a fridge at one end.

    ``hung``: with wall cabinets and a hood above them; ``reverse``: the fridge at the left end.
    """
    front = Material(color=tinted(rng, pick(rng, [(0.8, 0.86, 0.84), (0.9, 0.88, 0.82), (0.55, 0.62, 0.7)]), 0.05))
    doors = front.model_copy(update={"texture": "cabinet", "scale": 0.6})
    drawers = front.model_copy(update={"texture": "drawers", "scale": 0.78})
    top = Material(color=(0.75, 0.72, 0.7), texture=pick(rng, ["granite", "wood", "marble"]), scale=0.6)
    order = ["counter"] * modules
    order[1] = "sink"
    order[modules - 2 if modules > 3 else 2] = "stove"
    if modules >= 4:
        order[-1] = "fridge"
    if modules >= 5:
        order[2] = "drawers"
    if reverse:
        order.reverse()
    counter: list[Block] = []
    parts: list[PiecePart] = []
    for k, kind in enumerate(order):
        x = round((k - 0.5 * (modules - 1)) * MODULE, 3)
        if kind == "fridge":
            parts.append(_fridge(rng, x))
            continue
        if kind == "stove":
            parts.append(_stove(rng, x))
            if hung:
                parts.append(_hood(x))
            continue
        counter += [
            block(x, 0.29, 0.08, MODULE, 0.58, 0.78, drawers if kind == "drawers" else doors),
            block(x, 0.265, 0.0, MODULE, 0.53, 0.08, BLACK),
            block(x, 0.3, 0.86, MODULE, 0.6, 0.04, top),
        ]
        if kind == "sink":
            counter += [
                block(x, 0.3, 0.9, 0.5, 0.4, 0.01, STEEL),
                block(x, 0.06, 0.9, 0.06, 0.06, 0.25, STEEL),
                block(x, 0.17, 1.11, 0.06, 0.16, 0.04, STEEL),
            ]
        elif kind == "counter":
            counter.append(_appliance(rng, x))
        if hung and kind != "sink":
            hanging = front.model_copy(update={"texture": "cabinet", "scale": 0.65})
            parts.append(PiecePart("wall cabinet", (block(x, 0.165, 1.45, MODULE, 0.33, 0.65, hanging),)))
    return Piece((PiecePart("counter", tuple(counter)), *parts), front=0.7)


def _appliance(rng: np.random.Generator, x: float) -> Block:
    looks = [
        (0.5, 0.36, 0.3, Material(color=(0.9, 0.9, 0.92), texture="oven", scale=0.5)),
        (0.18, 0.18, 0.24, Material(color=tinted(rng, (0.75, 0.3, 0.28), 0.1), texture="metal", scale=0.3)),
        (0.3, 0.25, 0.1, Material(color=(1.0, 0.7, 0.3), texture="mosaic", scale=0.25)),
        (0.34, 0.22, 0.26, Material(color=(0.8, 0.65, 0.45), texture="wicker", scale=0.3)),
    ]
    w, d, h, look = pick(rng, looks)
    return block(x, 0.24, 0.9, w, d, h, look)


def _stove(rng: np.random.Generator, x: float) -> PiecePart:
    pot = Material(color=tinted(rng, (0.8, 0.35, 0.3), 0.15), texture="metal", scale=0.3)
    oven = Material(color=WHITE, texture="oven", scale=0.88)
    return PiecePart(
        "stove",
        (
            block(x, 0.29, 0.0, MODULE, 0.58, 0.88, oven),
            block(x, 0.3, 0.88, MODULE, 0.6, 0.02, BLACK),
            block(x - 0.1, 0.38, 0.9, 0.22, 0.22, 0.13, pot),
        ),
    )


def _hood(x: float) -> PiecePart:
    return PiecePart(
        "cooker hood", (block(x, 0.22, 1.6, MODULE, 0.43, 0.1, STEEL), block(x, 0.135, 1.7, 0.26, 0.26, 0.7, STEEL))
    )


def _fridge(rng: np.random.Generator, x: float) -> PiecePart:
    body = Material(color=tinted(rng, (0.86, 0.88, 0.9), 0.05), texture="metal", scale=1.2)
    return PiecePart(
        "fridge",
        (
            block(x, 0.31, 0.0, MODULE, 0.62, 1.8, body),
            block(x - 0.24, 0.64, 0.75, 0.04, 0.04, 0.35, BLACK),
            block(x - 0.24, 0.64, 1.25, 0.04, 0.04, 0.35, BLACK),
            block(x + 0.05, 0.6225, 1.3, 0.2, 0.005, 0.2, Material(color=WHITE, texture="painting_map", scale=0.2)),
        ),
    )


def island(rng: np.random.Generator, style: Style, length: float) -> Piece:
    """Draw a free-standing block to work at, with a board and a bowl; its frame's origin is its middle."""
    return one(
        "island",
        [
            block(0.0, 0.0, 0.0, length - 0.04, 0.56, 0.87, style.timber("planks", 1.0)),
            block(0.0, 0.0, 0.87, length, 0.6, 0.04, Material(color=(0.95, 0.95, 0.95), texture="marble")),
            block(-0.2, 0.0, 0.91, 0.3, 0.25, 0.03, style.timber(scale=0.3)),
            block(0.3, 0.05, 0.91, 0.2, 0.2, 0.18, Material(color=(0.5, 0.6, 0.8), texture="hexagons", scale=0.2)),
        ],
    )


def bin_(rng: np.random.Generator, style: Style) -> Piece:
    """Draw a waste bin with a lid."""
    look = Material(color=tinted(rng, (0.55, 0.6, 0.62), 0.08), texture="metal", scale=0.5)
    return one("bin", [block(0.0, 0.16, 0.0, 0.3, 0.3, 0.6, look), block(0.0, 0.16, 0.6, 0.32, 0.32, 0.04, BLACK)])
