"""Build two scenes that are no homes: `arena` for cars and `hall` for flight.

arena: 5 x 4 m, obstacles 0.25 to 0.6 m high at random places, longest first, so that gaps between them
and to the walls are 0.38 m or more. hall: 25 x 25 x 6 m with columns of turned boxes, textured coarsely
enough for a camera across the hall to see contrast.
"""

import math

import numpy as np
import shapely

from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.envs.scenes.apartment_parts import Box, Furniture, Material
from vssm_gym.envs.scenes.generator.floorplan import BuildingPlan, DoorPlan, RoomPlan, build
from vssm_gym.envs.scenes.generator.furniture.decor import PAINTINGS
from vssm_gym.envs.scenes.generator.furniture.pieces import WHITE, pick, tinted
from vssm_gym.envs.scenes.solids import SolidBox, footprint

ARENA_GAP = 0.38  # m between obstacles, and to the walls; the car is 0.2 m wide
_PLACES_TRIED = 4000  # places tried for the arena's obstacles


def arena() -> Apartment:
    """Build the car arena; all numbers come from one fixed stream."""
    rng = np.random.default_rng(20)
    walls = (
        Material(color=(0.90, 0.82, 0.70), texture="brick", scale=1.0),
        Material(color=(0.97, 0.95, 0.86), texture="wallpaper", scale=1.1),
        Material(color=(0.80, 0.86, 0.93), texture="stripes", scale=1.2),
        Material(color=(0.78, 0.88, 0.90), texture="mosaic", scale=1.4),
    )
    floor = Material(color=(0.80, 0.78, 0.76), texture="checker", scale=2.4)
    apartment = one_room("arena", ((0.0, 0.0), (5.2, 0.0), (5.2, 4.2), (0.0, 4.2)), 2.2, floor, walls, (2.6, 0.0))
    inner = shapely.box(0.1, 0.1, 5.1, 4.1)
    pieces: list[Furniture] = []
    taken: list[shapely.Polygon] = []
    for _ in range(_PLACES_TRIED):
        kind = pick(rng, ("crate", "crate", "tyre stack", "post")) if len(pieces) > 3 else "barrier"
        w, d, h = {
            "crate": (0.32, 0.32, 0.3),
            "barrier": (0.7, 0.12, 0.25),
            "post": (0.14, 0.14, 0.6),
            "tyre stack": (0.28, 0.28, 0.4),
        }[kind]
        x, y = (round(float(v), 2) for v in rng.uniform((0.1, 0.1), (5.1, 4.1)))
        yaw = round(float(rng.uniform(-math.pi / 2, math.pi / 2)), 3)
        look = _look(rng, kind)
        box = Box(center=(x, y, 0.5 * h), size=(w, d, h), yaw=yaw, material=look)
        ground = footprint(SolidBox("", "furniture", box.center, box.size, yaw, look))
        gaps = [ground.distance(other) for other in taken]
        if (
            not inner.contains(ground)
            or inner.exterior.distance(ground) < ARENA_GAP
            or min(gaps, default=9) < ARENA_GAP
        ):
            continue
        taken.append(ground)
        pieces.append(Furniture(name=f"{kind} {len(pieces) + 1}", category=kind, boxes=(box,)))
    return apartment.model_copy(update={"furniture": (*pieces, *pictures(apartment, 0.9, 1.2, 1.3))})


def hall() -> Apartment:
    """Build the flight hall: columns on a jittered lattice, each of two boxes turned against each other."""
    rng = np.random.default_rng(25)
    side, height = 25.2, 6.0
    walls = (
        Material(color=(0.88, 0.66, 0.56), texture="brick", scale=3.0),
        Material(color=(0.97, 0.95, 0.86), texture="wallpaper", scale=4.0),
        Material(color=(0.80, 0.86, 0.93), texture="stripes", scale=4.0),
        Material(color=(0.78, 0.88, 0.90), texture="mosaic", scale=4.5),
    )
    floor = Material(color=(0.86, 0.80, 0.72), texture="checker", scale=6.0)
    corners = ((0.0, 0.0), (side, 0.0), (side, side), (0.0, side))
    apartment = one_room("hall", corners, height, floor, walls, (12.6, 0.0))
    looks = ("brick", "planks", "mosaic", "hexagons", "stripes", "checker", "parquet", "wallpaper")
    columns = []
    for i in range(4):
        for j in range(4):
            x = round(0.5 * side + (i - 1.5) * 5.6 + float(rng.uniform(-0.8, 0.8)), 2)
            y = round(0.5 * side + (j - 1.5) * 5.6 + float(rng.uniform(-0.8, 0.8)), 2)
            width, yaw = round(float(rng.uniform(0.5, 0.9)), 2), round(float(rng.uniform(0.0, math.pi / 2)), 3)
            color = tinted(rng, (0.9, 0.8, 0.7), 0.1)
            look = Material(color=color, texture=looks[(i + 3 * j) % len(looks)], scale=1.5)
            # An octagon of two squares: columns that are round to a camera and boxes to the engine.
            shaft = [
                Box(center=(x, y, 0.5 * height), size=(width, width, height), yaw=turn, material=look)
                for turn in (yaw, round(yaw + math.pi / 4, 3))
            ]
            foot = Box(
                center=(x, y, 0.15),
                size=(round(width + 0.3, 2), round(width + 0.3, 2), 0.3),
                yaw=yaw,
                material=Material(color=(0.7, 0.68, 0.66), texture="granite", scale=0.8),
            )
            name = f"column {4 * i + j + 1}"
            columns.append(Furniture(name=name, category="column", boxes=(*shaft, foot)))
    return apartment.model_copy(update={"furniture": (*columns, *pictures(apartment, 2.4, 3.0, 4.6))})


def one_room(
    name: str,
    polygon: tuple[tuple[float, float], ...],
    height: float,
    floor: Material,
    walls: tuple[Material, ...],
    entrance: tuple[float, float],
) -> Apartment:
    """Build an empty room with walls 0.2 m thick, one material a side, and a closed door in its first one; m."""
    plan = BuildingPlan(
        name,
        (RoomPlan(name, name, polygon, floor, walls),),
        (DoorPlan(entrance, (name, None), 1.0, name),),
        (),
        facade=Material(color=(0.85, 0.80, 0.70), texture="stucco", scale=1.5),
        leaf=Material(color=(0.90, 0.88, 0.82), texture="cabinet", scale=1.8),
        entrance=Material(color=(0.35, 0.42, 0.38), texture="cabinet", scale=1.8),
        height=height,
        outer=0.2,
    )
    apartment = build(plan)
    ceiling = Material(color=(0.93, 0.93, 0.91), texture="planks" if height > 4.0 else "plaster", scale=height)
    return apartment.model_copy(update={"ceiling": ceiling})


def pictures(apartment: Apartment, size: float, middle: float, apart: float) -> list[Furniture]:
    """Hang paintings in a row on every wall, ``size`` m square, clear of the entrance."""
    found: list[Furniture] = []
    low, high = np.min(apartment.rooms[0].polygon, axis=0), np.max(apartment.rooms[0].polygon, axis=0)
    for side in range(4):
        axis = side % 2  # the wall runs along this axis
        length = high[axis] - low[axis]
        count = int((length - 0.6) // apart)
        for k in range(count):
            along = round(float(low[axis] + 0.5 * length + (k - 0.5 * (count - 1)) * apart), 3)
            wall = (low if side < 2 else high)[1 - axis] + (0.115 if side < 2 else -0.115)
            door = apartment.doors[0]
            if side == 0 and abs(along - door.offset - 0.5 * door.width) < 0.5 * (size + door.width) + 0.1:
                continue
            at = (along, round(float(wall), 3)) if axis == 0 else (round(float(wall), 3), along)
            extent = (size, 0.03, size) if axis == 0 else (0.03, size, size)
            look = Material(color=WHITE, texture=PAINTINGS[len(found) % len(PAINTINGS)], scale=size)
            box = Box(center=(*at, middle), size=extent, material=look)
            found.append(Furniture(name=f"picture {len(found) + 1}", category="picture", boxes=(box,)))
    return found


def _look(rng: np.random.Generator, kind: str) -> Material:
    texture, color, scale = {
        "crate": ("planks", (0.80, 0.62, 0.42), 0.3),
        "barrier": ("stripes", pick(rng, [(1.0, 0.45, 0.35), (1.0, 0.8, 0.3)]), 0.5),
        "post": ("stripes", (0.95, 0.6, 0.3), 0.3),
        "tyre stack": ("leather", (0.3, 0.3, 0.32), 0.3),
    }[kind]
    return Material(color=tinted(rng, color, 0.05), texture=texture, scale=scale)
