"""Paint the walls of a maze for a camera: a colour and a texture for each, drawn by the maze's name.

The painted boxes are those of the maze with another look. The maze's own content, its hash and its tasks stay as they
are, and the same name has the same paint for ever.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vssm_gym.envs.scenes.apartment_parts import Material
from vssm_gym.envs.scenes.solids import SolidBox

# RGB of wall paints: few, so that walls of one colour stand in several places, as in a building
PAINTS = (
    (0.86, 0.84, 0.78),
    (0.55, 0.63, 0.72),
    (0.73, 0.42, 0.34),
    (0.48, 0.60, 0.45),
    (0.88, 0.74, 0.44),
    (0.42, 0.40, 0.44),
)
COVERINGS = ("plaster", "stucco", "brick", "wood", "wallpaper", "tiles")
COVERING_SIDE = 0.2  # m, of a tile of a texture: its coarse parts are some centimetres wide


def painted(boxes: Sequence[SolidBox], name: str) -> list[SolidBox]:
    """Return the boxes in their order, all but floor and ceiling with a paint of their own.

    Args:
        boxes: of a maze.
        name: of the maze; it seeds the paint.
    """
    rng = np.random.default_rng(list(hashlib.sha256(f"{name}|paint".encode()).digest()))
    found = []
    for box in boxes:
        if box.kind not in ("floor", "ceiling"):
            color, texture = PAINTS[rng.integers(len(PAINTS))], COVERINGS[rng.integers(len(COVERINGS))]
            box = replace(box, material=Material(color=color, texture=texture, scale=COVERING_SIDE))
        found.append(box)
    return found
