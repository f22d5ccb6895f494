"""Define the large built-in homes: floor plans drawn by hand, one table each (`homes` defines the format)."""

from vssm_gym.envs.scenes.generator.floorplan import DoorPlan, WindowPlan
from vssm_gym.envs.scenes.generator.homes import Home, RoomSketch, rect
from vssm_gym.envs.scenes.generator.small_plans import FERN, IVY, MOSS, REED

BIRCH = Home(  # a corridor from end to end with rooms on both sides; living room and kitchen are joined twice
    "birch",
    1,
    (
        RoomSketch("living room", 1, rect(0.0, 0.0, 5.4, 4.2)),
        RoomSketch("kitchen", 2, rect(5.4, 0.0, 8.4, 4.2)),
        RoomSketch("study", 3, rect(8.4, 0.0, 11.2, 4.2)),
        RoomSketch("hall", 4, rect(0.0, 4.2, 11.2, 5.6)),
        RoomSketch("bedroom", 5, rect(0.0, 5.6, 4.0, 9.2)),
        RoomSketch("bathroom", 6, rect(4.0, 5.6, 6.3, 9.2)),
        RoomSketch("kids room", 7, rect(6.3, 5.6, 9.3, 9.2)),
        RoomSketch("storage", 8, rect(9.3, 5.6, 11.2, 9.2)),
    ),
    (
        DoorPlan((11.2, 4.9), ("hall", None), 0.95, "hall"),
        DoorPlan((4.3, 4.2), ("living room", "hall"), 1.2),
        DoorPlan((5.4, 3.4), ("living room", "kitchen"), 1.0),
        DoorPlan((7.8, 4.2), ("kitchen", "hall"), 0.9, "kitchen"),
        DoorPlan((9.0, 4.2), ("study", "hall"), 0.9, "study"),
        DoorPlan((3.4, 5.6), ("bedroom", "hall"), 0.9, "bedroom"),
        DoorPlan((4.6, 5.6), ("bathroom", "hall"), 0.85, "bathroom"),
        DoorPlan((6.9, 5.6), ("kids room", "hall"), 0.9, "kids room"),
        DoorPlan((9.9, 5.6), ("storage", "hall"), 0.85, "storage"),
    ),
    (
        WindowPlan((1.5, 0.0), 1.5),
        WindowPlan((3.9, 0.0), 1.5),
        WindowPlan((6.9, 0.0), 1.2, 1.0, 1.2),
        WindowPlan((9.8, 0.0), 1.3),
        WindowPlan((2.0, 9.2), 1.4),
        WindowPlan((5.15, 9.2), 0.7, 0.7, 1.5),
        WindowPlan((7.8, 9.2), 1.3),
        WindowPlan((0.0, 2.1), 1.4),
        WindowPlan((0.0, 4.9), 0.8),
    ),
)

CEDAR = Home(  # no corridor: everything opens to an L-shaped living room
    "cedar",
    2,
    (
        RoomSketch("living room", 11, ((0.0, 0.0), (6.2, 0.0), (6.2, 9.4), (3.6, 9.4), (3.6, 4.6), (0.0, 4.6))),
        RoomSketch("kitchen", 12, rect(6.2, 0.0, 9.8, 3.6)),
        RoomSketch("bathroom", 13, rect(6.2, 3.6, 9.8, 5.8)),
        RoomSketch("bedroom", 14, rect(0.0, 4.6, 3.6, 9.4)),
        RoomSketch("bedroom 2", 15, rect(6.2, 5.8, 9.8, 9.4)),
    ),
    (
        DoorPlan((4.9, 9.4), ("living room", None), 0.95, "living room"),
        DoorPlan((6.2, 0.8), ("living room", "kitchen"), 1.1),
        DoorPlan((6.2, 4.2), ("living room", "bathroom"), 0.85, "bathroom"),
        DoorPlan((3.6, 5.2), ("living room", "bedroom"), 0.9, "bedroom"),
        DoorPlan((6.2, 6.4), ("living room", "bedroom 2"), 0.9, "bedroom 2"),
    ),
    (
        WindowPlan((1.6, 0.0), 1.8),
        WindowPlan((4.4, 0.0), 1.5),
        WindowPlan((0.0, 2.3), 1.5),
        WindowPlan((8.0, 0.0), 1.2, 1.0, 1.2),
        WindowPlan((9.8, 1.8), 1.1, 1.0, 1.2),
        WindowPlan((9.8, 4.7), 0.7, 0.7, 1.5),
        WindowPlan((0.0, 7.0), 1.6),
        WindowPlan((8.0, 9.4), 1.4),
        WindowPlan((9.8, 7.6), 1.2),
    ),
    height=2.7,
)

ELM = Home(  # an L-shaped house around a long hall; the living room wraps around the kitchen
    "elm",
    3,
    (
        RoomSketch("hall", 21, rect(4.2, 0.0, 5.6, 10.8)),
        RoomSketch("bathroom", 22, rect(0.0, 0.0, 4.2, 2.4)),
        RoomSketch("bedroom", 23, rect(0.0, 2.4, 4.2, 6.6)),
        RoomSketch("kids room", 24, rect(0.0, 6.6, 4.2, 10.8)),
        RoomSketch("kitchen", 25, rect(5.6, 0.0, 8.6, 3.2)),
        RoomSketch("living room", 26, ((8.6, 0.0), (11.4, 0.0), (11.4, 6.6), (5.6, 6.6), (5.6, 3.2), (8.6, 3.2))),
        RoomSketch("study", 27, rect(5.6, 6.6, 8.8, 10.8)),
    ),
    (
        DoorPlan((4.9, 0.0), ("hall", None), 0.95, "hall"),
        DoorPlan((4.2, 1.83), ("hall", "bathroom"), 0.85, "bathroom"),
        DoorPlan((4.2, 3.0), ("hall", "bedroom"), 0.9, "bedroom"),
        DoorPlan((4.2, 7.2), ("hall", "kids room"), 0.9, "kids room"),
        DoorPlan((5.6, 0.62), ("hall", "kitchen"), 0.9, "kitchen"),
        DoorPlan((5.6, 5.2), ("hall", "living room"), 1.4),
        DoorPlan((8.6, 1.4), ("kitchen", "living room"), 1.1),
        DoorPlan((5.6, 10.2), ("hall", "study"), 0.9, "study"),
    ),
    (
        WindowPlan((2.1, 0.0), 0.7, 0.7, 1.5),
        WindowPlan((0.0, 4.5), 1.6),
        WindowPlan((0.0, 8.7), 1.6),
        WindowPlan((2.1, 10.8), 1.3),
        WindowPlan((7.1, 0.0), 1.2, 1.0, 1.2),
        WindowPlan((10.0, 0.0), 1.5),
        WindowPlan((11.4, 2.0), 1.6),
        WindowPlan((11.4, 4.9), 1.6),
        WindowPlan((10.1, 6.6), 1.4),
        WindowPlan((7.2, 10.8), 1.5),
        WindowPlan((8.8, 8.7), 1.3),
        WindowPlan((4.9, 10.8), 0.8),
    ),
)

MAPLE = Home(  # a deep house: a wide hall in its middle, a cupboard cut out of it
    "maple",
    4,
    (
        RoomSketch("living room", 31, rect(0.0, 0.0, 5.6, 4.4)),
        RoomSketch("kitchen", 32, rect(5.6, 0.0, 9.2, 4.4)),
        RoomSketch("bathroom", 33, rect(0.0, 4.4, 2.6, 7.2)),
        RoomSketch("hall", 34, ((2.6, 4.4), (9.2, 4.4), (9.2, 5.8), (7.0, 5.8), (7.0, 7.2), (2.6, 7.2))),
        RoomSketch("storage", 35, rect(7.0, 5.8, 9.2, 7.2)),
        RoomSketch("bedroom", 36, rect(0.0, 7.2, 4.8, 11.2)),
        RoomSketch("kids room", 37, rect(4.8, 7.2, 9.2, 11.2)),
    ),
    (
        DoorPlan((9.2, 5.1), ("hall", None), 0.95, "hall"),
        DoorPlan((4.2, 4.4), ("living room", "hall"), 1.4),
        DoorPlan((5.6, 3.0), ("living room", "kitchen"), 1.0),
        DoorPlan((6.2, 4.4), ("kitchen", "hall"), 0.9, "kitchen"),
        DoorPlan((2.6, 5.0), ("bathroom", "hall"), 0.85, "bathroom"),
        DoorPlan((7.0, 6.5), ("storage", "hall"), 0.85),
        DoorPlan((3.2, 7.2), ("bedroom", "hall"), 0.9, "bedroom"),
        DoorPlan((5.4, 7.2), ("kids room", "hall"), 0.9, "kids room"),
    ),
    (
        WindowPlan((1.5, 0.0), 1.6),
        WindowPlan((4.1, 0.0), 1.6),
        WindowPlan((0.0, 2.2), 1.5),
        WindowPlan((7.4, 0.0), 1.2, 1.0, 1.2),
        WindowPlan((9.2, 2.2), 1.2, 1.0, 1.2),
        WindowPlan((0.0, 5.8), 0.7, 0.7, 1.5),
        WindowPlan((2.4, 11.2), 1.6),
        WindowPlan((7.0, 11.2), 1.5),
        WindowPlan((9.2, 9.2), 1.2),
    ),
    height=2.5,
)

WALNUT = Home(  # a hall with a bend; living room, kitchen and hall form a ring
    "walnut",
    5,
    (
        RoomSketch("hall", 41, ((3.2, 0.0), (4.8, 0.0), (4.8, 3.4), (11.4, 3.4), (11.4, 4.7), (3.2, 4.7))),
        RoomSketch("kitchen", 42, rect(0.0, 0.0, 3.2, 3.4)),
        RoomSketch("living room", 43, ((0.0, 3.4), (3.2, 3.4), (3.2, 4.7), (5.4, 4.7), (5.4, 8.3), (0.0, 8.3))),
        RoomSketch("bedroom", 44, rect(4.8, 0.0, 8.4, 3.4)),
        RoomSketch("study", 45, rect(8.4, 0.0, 11.4, 3.4)),
        RoomSketch("bathroom", 46, rect(5.4, 4.7, 7.6, 8.3)),
        RoomSketch("bedroom 2", 47, rect(7.6, 4.7, 11.4, 8.3)),
    ),
    (
        DoorPlan((4.0, 0.0), ("hall", None), 0.95, "hall"),
        DoorPlan((3.2, 2.8), ("kitchen", "hall"), 0.9, "kitchen"),
        DoorPlan((1.2, 3.4), ("kitchen", "living room"), 1.0),
        DoorPlan((4.3, 4.7), ("living room", "hall"), 1.2),
        DoorPlan((5.4, 3.4), ("bedroom", "hall"), 0.9, "bedroom"),
        DoorPlan((9.0, 3.4), ("study", "hall"), 0.9, "study"),
        DoorPlan((7.0, 4.7), ("bathroom", "hall"), 0.85, "bathroom"),
        DoorPlan((8.2, 4.7), ("bedroom 2", "hall"), 0.9, "bedroom 2"),
    ),
    (
        WindowPlan((1.6, 0.0), 1.2, 1.0, 1.2),
        WindowPlan((0.0, 1.7), 1.0, 1.0, 1.2),
        WindowPlan((0.0, 5.9), 1.8),
        WindowPlan((1.5, 8.3), 1.5),
        WindowPlan((4.0, 8.3), 1.3),
        WindowPlan((6.6, 0.0), 1.5),
        WindowPlan((9.9, 0.0), 1.4),
        WindowPlan((6.5, 8.3), 0.7, 0.7, 1.5),
        WindowPlan((9.5, 8.3), 1.6),
        WindowPlan((11.4, 4.05), 0.7),
    ),
)

HOMES = {home.name: home for home in (BIRCH, CEDAR, ELM, MAPLE, WALNUT, FERN, IVY, MOSS, REED)}
"""Hand-drawn homes by name; `oak` is a file that was drawn by hand, box by box."""
