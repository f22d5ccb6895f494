"""Move every surface of a scene's walls and blocks outwards, or inwards: corridors become narrower, or wider.

    thickness' = thickness + 2 offset,    block' = block + 2 offset in both horizontal directions

Centre lines stay. Grown walls are longer by the offset at both ends, so that gaps narrow as corridors do; shrunk ones
keep their ends, so that joints stay closed.
"""

import math

import numpy as np

from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.envs.scenes.apartment_parts import Box, Wall
from vssm_gym.errors import InputError

LEAST_WALL = 0.002  # m, of a shrunk wall's thickness and of a shrunk block


def with_wall_offset(apartment: Apartment, offset: float) -> Apartment:
    """Return the scene with another wall thickness, under a name of its own; the scene itself for 0.

    Args:
        apartment: without doors and windows.
        offset: m that surfaces move outwards.

    Raises:
        InputError: an offset that is not finite or that leaves a wall without thickness; a door or a window.
    """
    if isinstance(offset, bool) or not isinstance(offset, int | float) or not math.isfinite(offset):
        raise InputError(apartment.name, "wall_offset", f"a finite number of metres, not {offset!r:.80}")
    if offset == 0.0:
        return apartment
    if apartment.doors or apartment.windows:
        raise InputError(apartment.name, "wall_offset", "walls without doors and windows")
    boxes = [box for piece in apartment.furniture for box in piece.boxes]
    thinnest = min([wall.thickness for wall in apartment.walls] + [min(box.size[:2]) for box in boxes], default=1.0)
    if thinnest + 2.0 * offset < LEAST_WALL:
        least = 0.5 * (LEAST_WALL - thinnest)
        raise InputError(apartment.name, "wall_offset", f"{least:g} m at least, for its thinnest wall; not {offset:g}")
    furniture = [
        piece.model_copy(update={"boxes": tuple(_block(box, offset) for box in piece.boxes)})
        for piece in apartment.furniture
    ]
    return apartment.model_copy(
        update={
            "name": f"{apartment.name}{1e3 * offset:+g}mm",
            "walls": tuple(_wall(wall, offset) for wall in apartment.walls),
            "furniture": tuple(furniture),
        }
    )


def _wall(wall: Wall, offset: float) -> Wall:
    start, end = np.array(wall.start), np.array(wall.end)
    beyond = max(offset, 0.0) * (end - start) / wall.length
    places = {"start": tuple((start - beyond).tolist()), "end": tuple((end + beyond).tolist())}
    return wall.model_copy(update={**places, "thickness": wall.thickness + 2.0 * offset})


def _block(box: Box, offset: float) -> Box:
    x, y, z = box.size
    return box.model_copy(update={"size": (x + 2.0 * offset, y + 2.0 * offset, z)})
