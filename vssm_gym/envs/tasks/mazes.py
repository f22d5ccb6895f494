"""Load mazes of the unit square: apartments of one floor whose walls are cut by the plane of a laser scanner.

A maze is an :class:`Apartment` of 1 m x 1 m, in the same JSON format and made of the same solid boxes as any other; the
2D world is its cut at the scanner's height. Seven are built in. A maze never changes under its name: another one gets
another version, and the frozen tasks hold the hash of the maze they were made for.
"""

import hashlib
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import shapely
from jaxtyping import Float

from vssm_gym.envs.physics.planar import clearance, rectangles
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.apartment_parts import ROUNDING
from vssm_gym.envs.scenes.free_space import STEP_HEIGHT, FreeSpace
from vssm_gym.envs.scenes.scene import ASSETS, Apartment, load_scene
from vssm_gym.envs.scenes.wall_offset import with_wall_offset
from vssm_gym.envs.tasks.navigation import Footprint, Split, Task, TaskSampler, TaskSet, load, save
from vssm_gym.errors import InputError

FOLDER = ASSETS / "mazes"
# The first is for learning how the robot moves, the others for evaluation, as in DVBF-LM.
MAZES = ("pillars-v1", "rings-v1", "rooms-v1", "serpentine-v1", "slanted-v1", "spiral-v1", "tree-v1")
# Success within two body lengths is then success within 0.05 m. It drives where it looks.
ROBOT = HolonomicRobot(
    body_length=0.025, height=0.1, camera_height=0.05, max_turn=math.radians(30.0), max_offset=0.0, max_step=0.02
)
GRID_SIDE = 5  # starts and goals lie on a grid of 5 x 5 positions
MOST_RECTANGLES = 2000  # of a maze that someone brings: a scan's time grows with them


@dataclass(frozen=True)
class Maze:
    """Hold a maze's geometry twice, as rectangles for rays and as free space for shortest paths.

    Attributes:
        apartment: the maze as it stands in its file.
        rectangles: ``(m, 6)`` cut of everything solid, see :mod:`vssm_gym.envs.physics.planar`.
        sampler: free space, shortest paths and the check of tasks.
    """

    apartment: Apartment
    rectangles: Float[np.ndarray, "m 6"]
    sampler: TaskSampler

    @property
    def name(self) -> str:
        """Return the name of the maze, with its version."""
        return self.apartment.name

    @property
    def space(self) -> FreeSpace:
        """Return the connected free space of the robot's centre."""
        return self.sampler.space

    @cached_property
    def tasks(self) -> TaskSet:
        """Return every ordered pair of the 5 x 5 grid's free positions.

        From the frozen file, or made in about a second.
        """
        path = FOLDER / "tasks" / f"{self.name}.json"
        if path.is_file():
            frozen = load(path)
            if frozen.scene_hash == self.apartment.content_hash() and frozen.robot == Footprint.of(ROBOT):
                return frozen
        return grid_tasks(self)


def load_maze(spec: str | Path | Apartment, wall_offset: float = 0.0) -> Maze:
    """Return the maze of a built-in name ("spiral-v1"), of a JSON file in our format, or of an :class:`Apartment`.

    Args:
        spec: name, path or apartment.
        wall_offset: m that every surface moves outwards; corridors are narrower by twice as much, and wider below 0.
            Another name then belongs to the maze ("spiral-v1+10mm"), and its tasks are made anew.

    Raises:
        InputError: what :func:`load_scene` refuses; a floor beyond the unit square or open at its border; walls that do
            not stand on the floor; free space in several parts, or none; what :func:`with_wall_offset` refuses.
    """
    if not isinstance(spec, str | Path | Apartment):
        raise InputError(f"{spec!r:.80}", "scene", "a maze's name, the path of a JSON file or an Apartment")
    if isinstance(spec, str) and spec not in MAZES and not Path(spec).is_file():
        raise InputError(spec, "scene", f"a maze ({', '.join(MAZES)}) or the path of an existing JSON file")
    apartment = with_wall_offset(load_scene(FOLDER / f"{spec}.json" if spec in MAZES else spec), wall_offset)
    floor = _floor(apartment)
    if not is_maze(apartment):
        west, south, east, north = floor.bounds
        found = f"found x from {west:g} to {east:g}, y from {south:g} to {north:g}"
        raise InputError(apartment.name, "rooms", f"a maze within the unit square; {found}")
    cut = _plane(apartment)
    sampler = TaskSampler(apartment, ROBOT)
    # Points a quarter radius apart within 3/4 radius of a wall: nowhere along the border can the robot's centre pass.
    border = shapely.get_coordinates(shapely.segmentize(floor.boundary, 0.25 * ROBOT.radius))
    if max(clearance(x, y, cut) for x, y in border) > 0.75 * ROBOT.radius:
        raise InputError(apartment.name, "walls", "walls all along the border of the floor")
    if (parts := len(sampler.space.region.geoms)) > 1:
        raise InputError(apartment.name, "walls", f"free space in one connected part; the robot finds {parts}")
    return Maze(apartment, cut, sampler)


def is_maze(apartment: Apartment) -> bool:
    """Return True if the floor lies within the unit square: a scene for a maze's robot, and for no larger one."""
    west, south, east, north = _floor(apartment).bounds
    return bool(min(west, south) >= -ROUNDING and max(east, north) <= 1.0 + ROUNDING)


def grid_tasks(maze: Maze) -> TaskSet:
    """Return every ordered pair of the free positions of the grid ``((i + 1/2) / 5, (j + 1/2) / 5)``, row by row.

    Start headings are uniform, from streams seeded by the maze's name: the same maze has the same tasks.

    Raises:
        InputError: fewer than two of the 25 positions are free.
    """
    split: Split = "train" if maze.name.startswith(MAZES[0]) else "test"  # with any wall offset
    centres = (np.arange(GRID_SIDE) + 0.5) / GRID_SIDE
    places = [(x, y) for y in centres.round(4).tolist() for x in centres.round(4).tolist()]
    free = [place for place in places if maze.space.contains(np.array(place))]
    if len(free) < 2:
        raise InputError(
            maze.name, "walls", f"two free positions of the {GRID_SIDE} x {GRID_SIDE} grid; found {len(free)}"
        )
    key = hashlib.sha256(f"{maze.name}|grid".encode()).digest()
    heading = np.random.default_rng(list(key)).uniform(-np.pi, np.pi, len(free) ** 2).round(4).tolist()
    pairs = [(start, goal) for start in free for goal in free if start != goal]
    made: list[Task] = []
    for i, (start, goal) in enumerate(pairs):
        task = maze.sampler.task((*start, heading[i]), goal, i)
        made.append(task.model_copy(update={"geodesic": round(task.geodesic, 6)}))
    tasks = TaskSet(
        scene=maze.name,
        scene_hash=maze.apartment.content_hash(),
        robot=Footprint.of(ROBOT),
        split=split,
        tasks=tuple(made),
    )
    return tasks.model_copy(update={"hash": tasks.content_hash()})


def freeze(folder: Path = FOLDER / "tasks") -> list[Path]:
    """Write the task files of the built-in mazes; only for a new version of a maze."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}.json" for name in MAZES]
    for name, path in zip(MAZES, paths, strict=True):
        save(grid_tasks(load_maze(name)), path)
    return paths


def _floor(apartment: Apartment) -> shapely.Geometry:
    return shapely.union_all([shapely.Polygon(room.polygon) for room in apartment.rooms])


def _plane(apartment: Apartment) -> Float[np.ndarray, "m 6"]:
    """Cut the maze at the scanner's height.

    Raise InputError for obstacles of the robot that the scanner would not see.
    """
    boxes = apartment.boxes()
    for box in boxes:
        low, high = box.center[2] - 0.5 * box.size[2], box.center[2] + 0.5 * box.size[2]
        if high > STEP_HEIGHT and low < ROBOT.height and not low < ROBOT.camera_height < high:
            expected = (
                f"walls and blocks that the plane at {ROBOT.camera_height} m cuts; {box.name!r} does not reach it"
            )
            raise InputError(apartment.name, box.kind, expected)
    cut = rectangles(boxes, ROBOT.camera_height)
    if len(cut) > MOST_RECTANGLES:
        raise InputError(apartment.name, "walls", f"at most {MOST_RECTANGLES} walls and blocks; found {len(cut)}")
    return cut
