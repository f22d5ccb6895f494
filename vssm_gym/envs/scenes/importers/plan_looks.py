"""Choose the looks of rooms of which a floor plan gives only the kind.

Floors and walls by kind, pictures on the walls.
"""

import zlib

from vssm_gym.envs.scenes.apartment_parts import Box, Furniture, Material

WALL_PICTURE = (1.2, 0.8, 0.03)  # m: widest, tallest, thickness
WALL_PICTURE_HEIGHT = 1.5  # m, height of a picture's centre

RGB = tuple[float, float, float]
# Words in a room's kind -> floor (texture, m a tile, colour) and wall.
Look = tuple[str, float, RGB]
_LOOKS: tuple[tuple[tuple[str, ...], Look, Look], ...] = (
    (("kitchen",), ("tiles", 1.2, (0.82, 0.78, 0.72)), ("subway", 1.2, (0.92, 0.92, 0.88))),
    (("bath", "toilet", "shower", "laundry"), ("mosaic", 0.9, (0.70, 0.80, 0.84)), ("tiles", 1.2, (0.84, 0.92, 0.94))),
    (("bed", "child", "guest"), ("carpet", 1.5, (0.66, 0.62, 0.72)), ("wallpaper", 1.2, (0.88, 0.85, 0.92))),
    (("living", "lounge", "dining"), ("parquet", 2.0, (0.78, 0.60, 0.42)), ("stucco", 1.8, (0.94, 0.90, 0.80))),
    (("office", "study", "studio"), ("planks", 1.6, (0.66, 0.50, 0.36)), ("wainscot", 1.5, (0.82, 0.88, 0.84))),
    (("hall", "corridor", "entr", "stair"), ("laminate", 1.6, (0.74, 0.62, 0.48)), ("plaster", 2.0, (0.92, 0.88, 0.8))),
    (("stor", "garage", "basement", "balcony"), ("concrete", 2.0, (0.7, 0.7, 0.7)), ("brick", 1.4, (0.8, 0.6, 0.5))),
)
_FLOORS: tuple[Look, ...] = (
    ("planks", 1.6, (0.74, 0.56, 0.40)),
    ("laminate", 1.6, (0.80, 0.68, 0.52)),
    ("parquet", 2.0, (0.68, 0.50, 0.36)),
    ("carpet", 1.5, (0.60, 0.66, 0.70)),
)
_WALLS: tuple[Look, ...] = (
    ("plaster", 2.0, (0.93, 0.88, 0.78)),
    ("stucco", 1.8, (0.84, 0.90, 0.90)),
    ("wallpaper", 1.2, (0.92, 0.86, 0.80)),
    ("plaster", 2.0, (0.84, 0.90, 0.82)),
)
_PICTURES = ("mountains", "blocks", "circles", "harbour", "flowers", "map")


def _hash(name: str) -> int:
    return zlib.crc32(name.encode())


def floor_material(kind: str, name: str) -> Material:
    """Return the floor of a room: by the words in its ``kind``, else one chosen by a hash of its ``name``."""
    texture, scale, color = (
        next((look[1] for look in _LOOKS if any(word in kind for word in look[0])), None)
        or (_FLOORS[_hash(name) % len(_FLOORS)])
    )
    return Material(texture=texture, scale=scale, color=color)


def wall_material(kind: str, name: str) -> Material:
    """Return the walls of a room, chosen like its floor."""
    texture, scale, color = (
        next((look[2] for look in _LOOKS if any(word in kind for word in look[0])), None)
        or (_WALLS[_hash(name) % len(_WALLS)])
    )
    return Material(texture=texture, scale=scale, color=color)


def picture(name: str, x: float, y: float, yaw: float, width: float) -> Furniture:
    """Return a picture ``width`` m wide; ``(x, y)`` m is its centre, ``yaw`` rad the direction of its width."""
    number = _hash(name)
    texture = f"painting_{_PICTURES[number % len(_PICTURES)]}"
    size = (width, WALL_PICTURE[2], min(WALL_PICTURE[1], 0.75 * width))
    box = Box(
        center=(x, y, WALL_PICTURE_HEIGHT),
        size=size,
        yaw=yaw,
        material=Material(color=(1, 1, 1), texture=texture, scale=width),
    )
    return Furniture(name=name, category="picture", boxes=(box,))
