"""Make a small textured hall with four columns, for the tests of flight."""

from vssm_gym.envs.scenes.scene import Apartment, Box, Furniture, Material, Room, Wall

FLOOR = Material(texture="planks", scale=2.0)
WALL = Material(texture="stucco", scale=2.0)
COLUMN = Material(texture="marble", scale=1.0)


def hall(width: float = 12.0, spacing: float = 5.0, ceiling: float = 5.0) -> Apartment:
    """Return a square hall around the origin, with columns 0.5 m thick on a grid."""
    half = 0.5 * width
    corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
    lines = zip(corners, [*corners[1:], corners[0]], strict=True)
    walls = tuple(Wall(start=a, end=b, thickness=0.2, height=ceiling, front=WALL, back=WALL) for a, b in lines)
    n = int((half - 1.0) / spacing)
    places = [(spacing * i, spacing * j) for i in range(-n, n + 1) for j in range(-n, n + 1) if i and j]
    columns = tuple(
        Furniture(
            name=f"column {k}",
            category="column",
            boxes=(Box(center=(x, y, 0.5 * ceiling), size=(0.5, 0.5, ceiling), material=COLUMN),),
        )
        for k, (x, y) in enumerate(places)
    )
    room = Room(name="hall", kind="hall", polygon=tuple(corners), floor=FLOOR)
    return Apartment(name="test_hall", rooms=(room,), walls=walls, furniture=columns, ceiling_height=ceiling)
