"""Define homes drawn by hand: rooms with seeds, doors and windows; built into an apartment and furnished.

A room's number is the seed of its looks and furniture, chosen by hand. Change one and the scene, its hash and its
frozen tasks change: write them again with `built_in.write_built_in`.
"""

from dataclasses import dataclass

import numpy as np

from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.envs.scenes.apartment_parts import CEILING_HEIGHT, XY
from vssm_gym.envs.scenes.generator import looks
from vssm_gym.envs.scenes.generator.floorplan import BuildingPlan, DoorPlan, WindowPlan, build
from vssm_gym.envs.scenes.generator.furnish import furnish


def rect(x0: float, y0: float, x1: float, y1: float) -> tuple[XY, ...]:
    """Return a rectangle, counter-clockwise."""
    return ((x0, y0), (x1, y0), (x1, y1), (x0, y1))


@dataclass(frozen=True)
class RoomSketch:
    """Describe a room of a hand-drawn plan: its kind is its name without a number."""

    name: str
    seed: int
    polygon: tuple[XY, ...]

    @property
    def kind(self) -> str:
        """Return the kind, "bedroom" for "bedroom 2"."""
        return self.name.rstrip(" 0123456789")


@dataclass(frozen=True)
class Home:
    """Describe a hand-drawn plan; doors and windows as in `floorplan`."""

    name: str
    seed: int  # of the facade and the doors
    rooms: tuple[RoomSketch, ...]
    doors: tuple[DoorPlan, ...]
    windows: tuple[WindowPlan, ...]
    height: float = CEILING_HEIGHT

    def apartment(self) -> Apartment:
        """Build walls, looks and furniture."""
        rng = np.random.default_rng(self.seed)
        rooms, bare = [], {}
        for room in self.rooms:
            look = np.random.default_rng([room.seed, 0])
            room_plan, edges = looks.room_plan(look, room.name, room.kind, room.polygon)
            rooms.append(room_plan)
            bare[room.name] = edges
        plan = BuildingPlan(
            self.name,
            tuple(rooms),
            self.doors,
            self.windows,
            facade=looks.facade(rng),
            leaf=looks.leaf(rng),
            entrance=looks.entrance(rng),
            height=self.height,
        )
        return furnish(build(plan), {room.name: room.seed for room in self.rooms}, bare)
