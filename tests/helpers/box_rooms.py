"""Make random box layouts and a two-room apartment, for tests of free space, geodesics, tasks and the survey."""

import hypothesis.strategies as st
import numpy as np
import shapely
from shapely import Polygon
from shapely.affinity import rotate

from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.scenes.scene import Apartment, Box, Door, Furniture, Material, Room, Wall

ROOM = shapely.box(0.0, 0.0, 5.0, 4.0)
PLAIN = Material()


def free_space(obstacles: list[Polygon], radius: float = 0.0, floor: Polygon = ROOM) -> FreeSpace:
    """Return free space of one room with anonymous obstacles."""
    named = [(f"box {i}", shape) for i, shape in enumerate(obstacles)]
    return FreeSpace("test", floor, named, radius, {"room": floor})


def _box(x: float, y: float, width: float, depth: float, degrees: float) -> Polygon:
    return rotate(shapely.box(x - width / 2, y - depth / 2, x + width / 2, y + depth / 2), degrees)


# Up to six boxes, upright or turned, that may overlap each other and the room's border.
layouts = st.lists(
    st.builds(
        _box,
        st.floats(0.5, 4.5),
        st.floats(0.5, 3.5),
        st.floats(0.1, 1.5),
        st.floats(0.1, 1.5),
        st.sampled_from([0.0, 0.0, 30.0, 45.0, 77.0]),
    ),
    max_size=6,
)
seeds = st.integers(0, 2**32 - 1)


def furniture(
    name: str, center: tuple[float, float, float], size: tuple[float, float, float], yaw: float = 0.0
) -> Furniture:
    """Return a piece of furniture of one box."""
    return Furniture(name=name, category="box", boxes=(Box(center=center, size=size, yaw=yaw, material=PLAIN),))


def two_rooms(openness: float = 1.0, leaves: int = 0, pieces: tuple[Furniture, ...] = ()) -> Apartment:
    """Return rooms "west" [0,3]x[0,4] and "east" [3,6]x[0,4], walls 0.1 m, a 0.9 m door at y in [1.5, 2.4]."""
    corners = [(0.0, 0.0), (6.0, 0.0), (6.0, 4.0), (0.0, 4.0)]
    lines = [*zip(corners, [*corners[1:], corners[0]], strict=True), ((3.0, 0.0), (3.0, 4.0))]
    walls = tuple(Wall(start=a, end=b, thickness=0.1, height=2.5, front=PLAIN, back=PLAIN) for a, b in lines)
    west, east = ((0.0, 0.0), (3.0, 0.0), (3.0, 4.0), (0.0, 4.0)), ((3.0, 0.0), (6.0, 0.0), (6.0, 4.0), (3.0, 4.0))
    door = Door(wall=4, offset=1.5, width=0.9, height=2.0, openness=openness, leaves=leaves, rooms=("west", "east"))  # type: ignore[arg-type]
    return Apartment(
        name="two_rooms",
        rooms=(
            Room(name="west", kind="living", polygon=west, floor=PLAIN),
            Room(name="east", kind="bedroom", polygon=east, floor=PLAIN),
        ),
        walls=walls,
        doors=(door,),
        furniture=pieces,
        ceiling_height=2.5,
    )


def random_points(space: FreeSpace, seed: int, n: int) -> np.ndarray:
    """Draw free positions of the largest component, slightly inside."""
    return space.sample(np.random.default_rng(seed), n, margin=1e-3)
