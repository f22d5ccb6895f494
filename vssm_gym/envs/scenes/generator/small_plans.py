"""Define the four small built-in homes, one table each (`homes` defines the format)."""

from vssm_gym.envs.scenes.generator.floorplan import DoorPlan, WindowPlan
from vssm_gym.envs.scenes.generator.homes import Home, RoomSketch, rect

FERN = Home(  # one room
    "fern",
    6,
    (RoomSketch("studio", 51, rect(0.0, 0.0, 5.6, 4.4)),),
    (DoorPlan((0.62, 0.0), ("studio", None), 0.9, "studio"),),
    (WindowPlan((1.9, 4.4), 1.6), WindowPlan((4.2, 4.4), 1.4)),
)

IVY = Home(  # a studio around its bathroom
    "ivy",
    7,
    (
        RoomSketch("studio", 61, ((2.2, 0.0), (6.6, 0.0), (6.6, 5.0), (0.0, 5.0), (0.0, 2.4), (2.2, 2.4))),
        RoomSketch("bathroom", 62, rect(0.0, 0.0, 2.2, 2.4)),
    ),
    (
        DoorPlan((2.9, 0.0), ("studio", None), 0.9, "studio"),
        DoorPlan((2.2, 1.8), ("bathroom", "studio"), 0.85, "bathroom"),
    ),
    (
        WindowPlan((1.6, 5.0), 1.5),
        WindowPlan((4.6, 5.0), 1.6),
        WindowPlan((6.6, 2.6), 1.4),
        WindowPlan((1.0, 0.0), 0.6, 0.6, 1.5),
    ),
)

MOSS = Home(  # two rooms and a bathroom
    "moss",
    8,
    (
        RoomSketch("living kitchen", 71, ((0.0, 0.0), (7.2, 0.0), (7.2, 1.6), (4.6, 1.6), (4.6, 5.8), (0.0, 5.8))),
        RoomSketch("bathroom", 72, rect(4.6, 1.6, 7.2, 3.5)),
        RoomSketch("bedroom", 75, rect(4.6, 3.5, 8.2, 7.0)),
    ),
    (
        DoorPlan((7.2, 0.8), ("living kitchen", None), 0.95, "living kitchen"),
        DoorPlan((6.6, 1.6), ("bathroom", "living kitchen"), 0.85, "bathroom"),
        DoorPlan((4.6, 4.1), ("bedroom", "living kitchen"), 0.9, "bedroom"),
    ),
    (
        WindowPlan((1.4, 0.0), 1.4),
        WindowPlan((3.6, 0.0), 1.4),
        WindowPlan((0.0, 3.0), 1.6),
        WindowPlan((2.3, 5.8), 1.3),
        WindowPlan((7.2, 2.5), 0.7, 0.7, 1.5),
        WindowPlan((5.5, 7.0), 1.2),
        WindowPlan((8.2, 5.2), 1.3),
    ),
)

REED = Home(  # a narrow flat: the living room's arm leads past the bathroom to the bedroom
    "reed",
    9,
    (
        RoomSketch("living kitchen", 81, ((0.0, 0.0), (4.8, 0.0), (4.8, 2.3), (6.8, 2.3), (6.8, 4.0), (0.0, 4.0))),
        RoomSketch("bathroom", 82, rect(4.8, 0.0, 6.8, 2.3)),
        RoomSketch("bedroom", 83, rect(6.8, 0.0, 10.2, 4.0)),
    ),
    (
        DoorPlan((5.8, 4.0), ("living kitchen", None), 0.95, "living kitchen"),
        DoorPlan((5.4, 2.3), ("bathroom", "living kitchen"), 0.85, "bathroom"),
        DoorPlan((6.8, 3.0), ("bedroom", "living kitchen"), 0.9, "bedroom"),
    ),
    (
        WindowPlan((1.3, 0.0), 1.4),
        WindowPlan((3.5, 0.0), 1.4),
        WindowPlan((2.6, 4.0), 1.4),
        WindowPlan((5.8, 0.0), 0.6, 0.6, 1.5),
        WindowPlan((8.5, 0.0), 1.5),
        WindowPlan((10.2, 2.0), 1.4),
    ),
)
