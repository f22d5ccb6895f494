"""Draw the furniture of bathrooms, each piece in its own frame."""

import numpy as np

from vssm_gym.envs.scenes.apartment_parts import Material
from vssm_gym.envs.scenes.generator.furniture.pieces import (
    CERAMIC,
    STEEL,
    WHITE,
    Piece,
    Style,
    block,
    cm,
    cushion,
    one,
    pick,
    tinted,
)

GLASS = Material(color=(0.80, 0.88, 0.90), texture="marble", scale=1.5)


def bathtub(rng: np.random.Generator, style: Style) -> Piece:
    """Draw a tub of 1.5 to 1.7 m with a tiled front."""
    w, d = cm(rng, 1.5, 1.7, 0.1), 0.72
    tiles = Material(color=tinted(rng, (0.55, 0.75, 0.8), 0.1), texture="mosaic", scale=0.6)
    return one(
        "bathtub",
        [
            block(0.0, 0.04, 0.0, w, 0.08, 0.56, CERAMIC),
            block(0.0, d - 0.04, 0.0, w, 0.08, 0.56, CERAMIC),
            *(block(s * 0.5 * (w - 0.08), 0.5 * d, 0.0, 0.08, d - 0.16, 0.56, CERAMIC) for s in (-1, 1)),
            block(0.0, 0.5 * d, 0.0, w - 0.16, d - 0.16, 0.12, CERAMIC),
            block(0.0, 0.04, 0.56, 0.08, 0.06, 0.19, STEEL),
            block(0.0, d + 0.0025, 0.06, w - 0.04, 0.005, 0.44, tiles),
        ],
        front=0.5,
    )


def shower(rng: np.random.Generator, style: Style) -> Piece:
    """Draw a tray of 0.9 m with a screen at one side; its rim stops robots."""
    side = pick(rng, (-1, 1))
    return one(
        "shower",
        [
            block(0.0, 0.45, 0.0, 0.9, 0.9, 0.15, CERAMIC),
            block(side * 0.44, 0.45, 0.15, 0.02, 0.9, 1.85, GLASS),
            block(0.0, 0.03, 1.1, 0.05, 0.06, 0.95, STEEL),
            block(0.0, 0.16, 2.05, 0.2, 0.3, 0.03, STEEL),
        ],
        front=0.5,
    )


def toilet(rng: np.random.Generator, style: Style) -> Piece:
    """Draw bowl, seat and cistern."""
    return one(
        "toilet",
        [
            block(0.0, 0.385, 0.0, 0.36, 0.43, 0.4, CERAMIC),
            block(0.0, 0.395, 0.4, 0.4, 0.45, 0.04, Material(color=(0.96, 0.96, 0.94))),
            block(0.0, 0.085, 0.0, 0.4, 0.17, 0.82, CERAMIC),
        ],
        front=0.5,
    )


def vanity(rng: np.random.Generator, style: Style, w: float) -> Piece:
    """Draw a basin in a cabinet of width w under a mirror."""
    body = Material(color=tinted(rng, (0.55, 0.65, 0.7), 0.12), texture="cabinet", scale=w)
    return one(
        "vanity",
        [
            block(0.0, 0.225, 0.0, w, 0.45, 0.8, body),
            block(
                0.0, 0.24, 0.8, w + 0.04, 0.48, 0.05, Material(color=(0.95, 0.95, 0.95), texture="marble", scale=0.8)
            ),
            block(-0.06, 0.25, 0.85, 0.36, 0.28, 0.02, CERAMIC),
            block(-0.06, 0.05, 0.85, 0.06, 0.06, 0.2, STEEL),
            block(round(0.5 * w - 0.1, 3), 0.2, 0.85, 0.08, 0.1, 0.15, cushion(rng, 0.15)),
            block(0.0, 0.02, 1.15, w - 0.1, 0.04, 0.8, Material(color=(0.85, 0.9, 0.92), texture="window", scale=1.6)),
        ],
        front=0.5,
    )


def washing_machine(rng: np.random.Generator, style: Style) -> Piece:
    """Draw a washing machine with a packet and folded linen on it."""
    return one(
        "washing machine",
        [
            block(0.0, 0.3, 0.0, 0.6, 0.6, 0.85, Material(color=WHITE, texture="oven", scale=0.85)),
            block(-0.12, 0.25, 0.85, 0.25, 0.25, 0.25, Material(color=(0.4, 0.6, 0.85), texture="stripes", scale=0.3)),
            block(0.16, 0.3, 0.85, 0.2, 0.35, 0.12, cushion(rng, 0.3)),
        ],
        front=0.5,
    )


def hamper(rng: np.random.Generator, style: Style) -> Piece:
    """Draw a laundry basket."""
    look = Material(color=tinted(rng, (0.85, 0.68, 0.48), 0.05), texture="wicker", scale=0.5)
    return one("hamper", [block(0.0, 0.22, 0.0, 0.42, 0.42, 0.6, look)])


def towels(rng: np.random.Generator, style: Style) -> Piece:
    """Draw towels at a rail on the wall."""
    return one(
        "towel",
        [block(0.0, 0.03, 0.9, 0.6, 0.06, 0.6, Material(color=(0.9, 0.55, 0.45), texture="stripes", scale=0.6))],
    )
