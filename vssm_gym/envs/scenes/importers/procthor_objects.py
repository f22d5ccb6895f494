"""Convert ProcTHOR objects to upright boxes of their assets' sizes, in the world frame."""

import math
from collections import defaultdict
from collections.abc import Mapping

import numpy as np

from vssm_gym.envs.scenes.apartment_parts import Box, Furniture, Wall
from vssm_gym.envs.scenes.importers.procthor_format import HOUSE_OBJECTS, Asset, House, HouseObject
from vssm_gym.envs.scenes.importers.procthor_looks import object_material
from vssm_gym.errors import InputError

MOUNTED = 0.05  # m above the floor from which an object at a wall counts as hanging on it
NOTED_TILT = math.radians(1.0)  # rad, tilt of an object from which on it is noted


def furniture_of(
    house: House, assets: Mapping[str, Asset], walls: list[Wall], source: object, notes: list[str]
) -> list[Furniture]:
    """Return one piece of furniture an object, children included, with unique names.

    Sentences about approximations are appended to ``notes``. Raises InputError naming ``source`` for an asset that the
    database does not have: leaving the object out would have robots drive through it.
    """
    pieces: list[Furniture] = []
    used: dict[str, int] = defaultdict(int)

    def add(item: HouseObject, field: str, shift: np.ndarray | None) -> None:
        if item.assetId not in assets:
            raise InputError(source, f"{field}.assetId", f"an asset of the asset database; found {item.assetId!r}")
        asset = assets[item.assetId]
        if len(pieces) >= HOUSE_OBJECTS:
            raise InputError(source, field, f"at most {HOUSE_OBJECTS:,} objects with all their children")
        if sum(extent > 0.0 for extent in (asset.boundingBox.x, asset.boundingBox.y, asset.boundingBox.z)) < 2:
            expected = f"an asset with a size; {item.assetId!r} has none in the asset database"
            raise InputError(source, f"{field}.assetId", expected)
        box, tilt = _box(item, asset)
        if shift is None:  # a top-level object: it may hang on a wall
            shift = _out_of_wall(box, walls)
        center = (box.center[0] + float(shift[0]), box.center[1] + float(shift[1]), box.center[2])
        used[item.id] += 1
        name = item.id if used[item.id] == 1 else f"{item.id} #{used[item.id]}"
        if tilt > NOTED_TILT:
            notes.append(f"{name} is tilted by {math.degrees(tilt):.0f} degrees: it became the upright box around it")
        pieces.append(
            Furniture(name=name, category=asset.objectType, boxes=(box.model_copy(update={"center": center}),))
        )
        for i, child in enumerate(item.children):
            add(child, f"{field}.children[{i}]", shift)

    for i, item in enumerate(house.objects):
        add(item, f"objects[{i}]", None)
    return pieces


def _box(item: HouseObject, asset: Asset) -> tuple[Box, float]:
    """Return the object's upright box and its tilt (rad, 0 where the asset stands on one of its faces).

    Unity turns about z, then x, then y. Whatever is not yaw is applied to the asset's extents and bounded by an
    upright box: exact for quarter turns, an outer bound for any other tilt.
    """
    extents = np.array([asset.boundingBox.x, asset.boundingBox.y, asset.boundingBox.z])
    x, z = math.radians(item.rotation.x), math.radians(item.rotation.z)
    turn_x = np.array([[1, 0, 0], [0, math.cos(x), -math.sin(x)], [0, math.sin(x), math.cos(x)]])
    turn_z = np.array([[math.cos(z), -math.sin(z), 0], [math.sin(z), math.cos(z), 0], [0, 0, 1]])
    tilt = max(abs(math.remainder(angle, math.pi / 2)) for angle in (x, z))
    bound = np.abs(turn_x @ turn_z) @ extents
    if max(abs(math.remainder(angle, 2 * math.pi)) for angle in (x, z)) < NOTED_TILT:
        bound = extents  # physics at rest leaves hundredths of a degree
    width, height, breadth = (max(float(extent), 1e-3) for extent in bound)  # sheets of paper have no thickness
    size = (width, breadth, height)
    yaw = math.remainder(-math.radians(item.rotation.y), 2 * math.pi)
    material = object_material(asset.assetId, asset.objectType, size)
    center = (item.position.x, item.position.z, item.position.y)
    return Box(center=center, size=size, yaw=yaw, material=material), tilt


def _out_of_wall(box: Box, walls: list[Wall]) -> np.ndarray:
    """Return the shift (2,) m that keeps a hanging object on the wall's surface now that the wall has thickness.

    Pictures and televisions hang 5 mm off the wall's plane in the file; without the shift the wall would swallow them.
    What stands on the floor stays where it is: its back runs 25 mm into the wall.
    """
    if box.center[2] - box.size[2] / 2 < MOUNTED:
        return np.zeros(2)
    for wall in walls:
        c, s = math.cos(wall.yaw), math.sin(wall.yaw)
        dx, dy = box.center[0] - wall.start[0], box.center[1] - wall.start[1]
        along, across = c * dx + s * dy, c * dy - s * dx
        turn = box.yaw - wall.yaw
        reach = (abs(math.sin(turn)) * box.size[0] + abs(math.cos(turn)) * box.size[1]) / 2
        if 0 <= along <= wall.length and -0.05 < abs(across) - reach < wall.thickness / 2:
            return np.array([-s, c]) * math.copysign(wall.thickness / 2, across)
    return np.zeros(2)
