"""Draw the furniture of bedrooms and children's rooms, each piece in its own frame."""

import numpy as np

from vssm_gym.envs.scenes.apartment_parts import Material
from vssm_gym.envs.scenes.generator.furniture.pieces import (
    WHITE,
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


def _bed(rng: np.random.Generator, style: Style, width: float, length: float) -> Piece:
    wood, linen = (
        style.timber(dark=True, scale=0.7),
        Material(color=(0.92, 0.92, 0.97), texture="stripes", scale=0.8),
    )
    head = Material(color=style.dark, texture=pick(rng, ["leather", "wood", "wicker"]), scale=0.6)
    cover = Material(color=tinted(rng, style.fabric, 0.15), texture=pick(rng, ["plaid", "fabric", "stripes"]))
    pillows = (-0.25 * width, 0.25 * width) if width > 1.3 else (0.0,)
    return one(
        "bed",
        [
            block(0.0, 0.03, 0.0, width, 0.06, 1.05, head),
            block(0.0, 0.06 + 0.5 * length, 0.15, width, length, 0.2, wood),
            *legs(0.0, 0.06 + 0.5 * length, width - 0.08, length - 0.08, 0.15, 0.08, wood),
            block(0.0, 0.06 + 0.5 * length, 0.35, width - 0.06, length - 0.06, 0.17, linen),
            block(0.0, 0.06 + length - 0.32 * length, 0.52, width - 0.02, 0.62 * length, 0.06, cover),
            *(
                block(x, 0.35, 0.52, 0.56, 0.4, 0.13, Material(color=(0.95, 0.93, 0.88), texture="fabric", scale=0.5))
                for x in pillows
            ),
        ],
    )


def _nightstand(rng: np.random.Generator, style: Style) -> Piece:
    base = Material(color=tinted(rng, (0.7, 0.55, 0.45), 0.2), texture="stucco", scale=0.3)
    return one(
        "nightstand",
        [
            block(0.0, 0.21, 0.0, 0.46, 0.42, 0.5, style.timber("drawers", 0.5, dark=True)),
            block(0.0, 0.2, 0.5, 0.14, 0.14, 0.2, base),
            block(0.0, 0.2, 0.7, 0.24, 0.24, 0.2, Material(color=(1.0, 0.92, 0.72), texture="fabric", scale=0.3)),
        ],
    )


def double_bed(rng: np.random.Generator, style: Style) -> Piece:
    """Draw a bed of 1.4 to 1.8 m between two nightstands, with room to pass on both sides."""
    width = cm(rng, 1.4, 1.8, 0.2)
    side = 0.5 * width + 0.05 + 0.23
    stands = [_nightstand(rng, style).moved(s * side, 0.0) for s in (-1, 1)]
    return joined(_bed(rng, style, width, 2.0), *stands, front=0.5)


def single_bed(rng: np.random.Generator, style: Style) -> Piece:
    """Draw a bed of 0.9 to 1 m with one nightstand at its right."""
    width = cm(rng, 0.9, 1.0)
    stand = _nightstand(rng, style).moved(0.5 * width + 0.05 + 0.23, 0.0)
    return joined(_bed(rng, style, width, 2.0), stand, front=0.4)


def wardrobe(rng: np.random.Generator, style: Style) -> Piece:
    """Draw a wardrobe taller than a person, with a basket on top."""
    width = cm(rng, 1.2, 2.0, 0.2)
    return one(
        "wardrobe",
        [
            block(0.0, 0.29, 0.0, width, 0.58, 2.1, style.timber("cabinet", width)),
            block(0.0, 0.295, 2.1, width + 0.02, 0.59, 0.04, style.timber()),
            block(-0.2, 0.3, 2.14, 0.6, 0.4, 0.26, Material(color=(0.75, 0.6, 0.42), texture="wicker", scale=0.5)),
        ],
        front=0.6,
    )


def dresser(rng: np.random.Generator, style: Style) -> Piece:
    """Draw a chest of drawers with a photograph and a plant."""
    width = cm(rng, 0.9, 1.2)
    return one(
        "dresser",
        [
            block(0.0, 0.22, 0.0, width, 0.43, 0.85, style.timber("drawers", 0.85)),
            block(0.0, 0.225, 0.85, width + 0.04, 0.45, 0.03, style.timber()),
            block(-0.25, 0.15, 0.88, 0.2, 0.1, 0.3, Material(color=WHITE, texture="painting_harbour", scale=0.3)),
            block(0.25, 0.2, 0.88, 0.2, 0.2, 0.22, Material(color=WHITE, texture="leaves", scale=0.3)),
        ],
        front=0.5,
    )


def toy_chest(rng: np.random.Generator, style: Style) -> Piece:
    """Draw a bright box with two blocks on it."""
    look = Material(color=tinted(rng, (0.9, 0.7, 0.4), 0.1), texture="stripes", scale=0.6)
    return one(
        "toy chest",
        [
            block(0.0, 0.2, 0.0, 0.8, 0.4, 0.42, look),
            block(-0.2, 0.2, 0.42, 0.2, 0.2, 0.2, cushion(rng, 0.2)),
            block(0.15, 0.22, 0.42, 0.24, 0.16, 0.16, cushion(rng, 0.2)),
        ],
        front=0.4,
    )
