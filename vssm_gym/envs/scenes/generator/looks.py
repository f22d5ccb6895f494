"""Choose floors and walls by kind of room: textures that a tracker can track, with some walls left bare."""

import numpy as np

from vssm_gym.envs.scenes.apartment_parts import XY, Material
from vssm_gym.envs.scenes.generator.floorplan import RoomPlan
from vssm_gym.envs.scenes.generator.furniture.pieces import Color, pick, tinted

Choice = tuple[str, Color, float]  # texture, colour, scale

_WOODEN: tuple[Choice, ...] = (
    ("planks", (0.85, 0.66, 0.46), 1.8),
    ("laminate", (0.80, 0.62, 0.45), 1.6),
    ("parquet", (0.72, 0.52, 0.36), 1.6),
    ("planks", (0.62, 0.46, 0.34), 2.0),
)
_STONE: tuple[Choice, ...] = (
    ("checker", (0.95, 0.92, 0.86), 1.8),
    ("tiles", (0.82, 0.74, 0.66), 1.6),
    ("granite", (0.80, 0.78, 0.75), 1.0),
)
_WET: tuple[Choice, ...] = (
    ("hexagons", (0.80, 0.86, 0.88), 1.0),
    ("mosaic", (0.72, 0.80, 0.82), 1.0),
    ("tiles", (0.85, 0.85, 0.82), 1.2),
)
_SOFT: tuple[Choice, ...] = (("carpet", (0.78, 0.74, 0.70), 1.2), ("carpet", (0.66, 0.70, 0.76), 1.2), *_WOODEN[:3])
_FLOORS = {"kitchen": _STONE, "bathroom": _WET, "storage": _STONE, "bedroom": _SOFT, "kids room": _SOFT}

_PAINT: tuple[Choice, ...] = (
    ("plaster", (0.95, 0.90, 0.80), 2.0),
    ("plaster", (0.72, 0.80, 0.88), 2.0),
    ("plaster", (0.74, 0.82, 0.70), 2.0),
    ("stucco", (0.93, 0.87, 0.78), 1.6),
    ("plaster", (0.93, 0.86, 0.62), 2.0),
    ("stucco", (0.88, 0.78, 0.74), 1.6),
)
_PAPER: tuple[Choice, ...] = (
    ("wallpaper", (0.97, 0.95, 0.86), 1.3),
    ("stripes", (0.80, 0.86, 0.93), 1.5),
    ("wainscot", (0.93, 0.90, 0.84), 2.6),
    ("wallpaper", (0.85, 0.95, 0.85), 1.3),
    ("brick", (0.85, 0.62, 0.52), 1.2),
)
_TILED: tuple[Choice, ...] = (
    ("subway", (0.85, 0.92, 0.90), 1.0),
    ("tiles", (0.78, 0.88, 0.90), 1.2),
    ("mosaic", (0.70, 0.84, 0.86), 1.0),
)


def _material(rng: np.random.Generator, choice: Choice) -> Material:
    texture, color, scale = choice
    return Material(color=tinted(rng, color, 0.04), texture=texture, scale=scale)


def room_plan(
    rng: np.random.Generator, name: str, kind: str, polygon: tuple[XY, ...]
) -> tuple[RoomPlan, frozenset[int]]:
    """Return the room with a floor, one paint, one wall of another look, and the edges that are bare.

    About every third room has one wall of plain paint without pictures.
    """
    floor = _material(rng, pick(rng, _FLOORS.get(kind, _WOODEN)))
    wet = kind in ("bathroom", "kitchen")
    paint = _material(rng, pick(rng, _TILED if kind == "bathroom" else _PAINT))
    accent = _material(rng, pick(rng, _TILED if wet else _PAPER))
    walls = [paint] * len(polygon)
    special = int(rng.integers(len(polygon)))
    walls[special] = accent
    bare: frozenset[int] = frozenset()
    if rng.uniform() < 0.35:
        edge = (special + 1 + int(rng.integers(len(polygon) - 1))) % len(polygon)
        walls[edge] = Material(color=tinted(rng, (0.92, 0.90, 0.86), 0.03), scale=2.0)
        bare = frozenset({edge})
    return RoomPlan(name, kind, polygon, floor, tuple(walls)), bare


def facade(rng: np.random.Generator) -> Material:
    """Draw the material of the house's outside."""
    return _material(rng, pick(rng, [("brick", (0.75, 0.45, 0.36), 1.2), ("stucco", (0.85, 0.80, 0.70), 1.5)]))


def leaf(rng: np.random.Generator) -> Material:
    """Draw the material of the doors between rooms."""
    color = pick(rng, [(0.90, 0.88, 0.82), (0.78, 0.60, 0.42), (0.62, 0.46, 0.32)])
    return Material(color=tinted(rng, color, 0.03), texture="cabinet", scale=1.8)


def entrance(rng: np.random.Generator) -> Material:
    """Draw the material of the door to the outside."""
    color = pick(rng, [(0.45, 0.30, 0.22), (0.35, 0.42, 0.38), (0.50, 0.28, 0.25)])
    return Material(color=tinted(rng, color, 0.03), texture="cabinet", scale=1.8)
