"""Import ROS occupancy maps (``map_server``: a YAML and its image): every cell that is not free becomes wall.

    p = (255 - grey) / 255 (negate: grey / 255);  occupied: p > occupied_thresh;  free: p < free_thresh

and unknown between. The floor is the free cells, in world coordinates ``origin + R(yaw) resolution (column, row)`` with
rows counted from the image's bottom. Only cells beside the floor and those that the floor surrounds become walls, since
others are out of reach. Source of the format: http://wiki.ros.org/map_server.
"""

import math
import zlib
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import shapely
import yaml
from jaxtyping import Bool, Int
from pydantic import BaseModel, ConfigDict, Field
from scipy import ndimage

from vssm_gym.envs.scenes.apartment import MAX_EXTENT, Apartment
from vssm_gym.envs.scenes.apartment_parts import CEILING_HEIGHT, Coordinate, Room, Wall
from vssm_gym.envs.scenes.importers.map_image import read_grey
from vssm_gym.envs.scenes.importers.plan_looks import floor_material, wall_material
from vssm_gym.envs.scenes.importers.rectangles import Rectangle, cover
from vssm_gym.envs.validation import validated
from vssm_gym.errors import InputError
from vssm_gym.files.json_file import read_bytes

MAP_YAML_BYTES = 1 << 16  # largest file
LEAST_PIECE = 0.5  # m^2; smaller pieces of floor are noise of the scanner
MAP_ROOMS, MAP_WALLS = 300, 20_000  # most of a map
WALL_BAND = 3  # cells that a wall may reach beyond the floor's border
LOOK_BLOCK = 6.0  # m; walls in one block of the map have one look

Threshold = Annotated[float, Field(ge=0, le=1)]


class MapFile(BaseModel):
    """Hold the YAML's fields; ``origin`` is the pose (x, y m, yaw rad) of the image's lower left corner."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    image: str = Field(min_length=1, max_length=255)
    resolution: Annotated[float, Field(ge=0.005, le=1.0)]
    origin: tuple[Coordinate, Coordinate, Annotated[float, Field(ge=-7, le=7)]]
    negate: bool = False
    occupied_thresh: Threshold = 0.65
    free_thresh: Threshold = 0.196
    mode: Literal["trinary", "scale", "raw"] = "trinary"


class _PlainLoader(yaml.BaseLoader):
    """Load YAML of strings, lists and mappings only: no aliases, which can make gigabytes of a few lines."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("aliases are not allowed")
        return super().compose_node(parent, index)


def import_ros_map(path: Path) -> Apartment:
    """Return the `Apartment` of a map's YAML; raise InputError naming the file and the field that is wrong."""
    settings = _settings(path)
    free, unknown = _cells(settings, _image_path(path, settings.image))
    labels, count = ndimage.label(free)  # joined through sides, not corners: a robot does not pass a corner
    areas = np.bincount(labels.ravel(), minlength=count + 1)[1:] * settings.resolution**2
    kept = [int(i) + 1 for i in np.argsort(-areas, kind="stable") if areas[i] >= LEAST_PIECE][:MAP_ROOMS]
    if not kept:
        raise InputError(
            path, "image", f"at least {LEAST_PIECE} m^2 of connected free cells; found {areas.max(initial=0.0):.2f}"
        )
    is_kept = np.zeros(count + 1, dtype=bool)
    is_kept[kept] = True
    floor = is_kept[labels]
    _check_extent(floor, settings, path)
    notes = []
    if dropped := len(areas) - len(kept):
        least = min(areas[label - 1] for label in kept) if len(kept) == MAP_ROOMS else LEAST_PIECE
        notes.append(f"{dropped} pieces of floor of less than {least:.1f} m^2 were left out")
    walls = _walls(floor, settings, path, unknown, notes)
    pieces = _pieces(np.where(floor, labels, 0))
    rooms = [
        # The smaller first: where one lies within another, the floor is its own.
        validated(Room, _room(pieces[label], number, settings), path, at="image")
        for number, label in reversed(list(enumerate(kept, 1)))
    ]
    content = {"name": path.stem, "rooms": rooms, "walls": walls, "ceiling_height": CEILING_HEIGHT, "notes": notes}
    return validated(Apartment, content, path)


def _settings(path: Path) -> MapFile:
    content = read_bytes(path, MAP_YAML_BYTES)
    try:
        data = yaml.load(content.decode("utf-8"), _PlainLoader)  # a BaseLoader: it builds nothing but strings
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise InputError(path, "file", f"the YAML of a ROS map ({reason:.120})") from error
    if not isinstance(data, dict):
        raise InputError(path, "file", f"a mapping of fields; found {type(data).__name__}")
    return validated(MapFile, data, path)


def _image_path(path: Path, image: str) -> Path:
    """Return the path of the image, which lies in the YAML's folder or below it."""
    folder = path.parent.resolve()
    inside = not Path(image).is_absolute() and "\0" not in image and (folder / image).resolve().is_relative_to(folder)
    if not inside:
        raise InputError(path, "image", f"a path relative to this file and inside its folder; found {image!r}")
    if not (folder / image).is_file():
        raise InputError(path, "image", f"an existing file; found {image!r}")
    return path.parent / image


def _cells(settings: MapFile, image: Path) -> tuple[Bool[np.ndarray, "nx ny"], Bool[np.ndarray, "nx ny"]]:
    """Return free and unknown cells, indexed by column and by row from the bottom, within a rim that is neither."""
    grey, opacity = read_grey(image)
    if settings.mode == "raw":
        occupancy = np.where(grey <= 100.0, grey / 100.0, np.nan)  # percent; 255 is unknown
    else:
        occupancy = (grey if settings.negate else 255.0 - grey) / 255.0
    if settings.mode == "scale":
        occupancy = np.where(opacity > 0.0, occupancy, np.nan)
    free = occupancy < settings.free_thresh
    unknown = ~free & ~(occupancy > settings.occupied_thresh)
    if not free.any():
        raise InputError(image, "image", "free cells; found none")
    return tuple(np.pad(cells[::-1].T, WALL_BAND) for cells in (free, unknown))  # type: ignore[return-value]


def _walls(floor: np.ndarray, settings: MapFile, path: Path, unknown: np.ndarray, notes: list[str]) -> list[Wall]:
    solid = ~floor
    parts, _ = ndimage.label(solid)
    surrounded = solid & (parts != parts[0, 0])  # the rim is outside
    beside, near = _grown(floor, 1) & solid, _grown(floor, WALL_BAND) & solid
    rectangles = cover(surrounded | beside, surrounded | near, MAP_WALLS)
    if len(rectangles) > MAP_WALLS:
        raise InputError(path, "image", f"a map of at most {MAP_WALLS:,} walls; found more: reduce its resolution")
    share = float((unknown & beside).sum() / beside.sum())
    if share > 0.005:
        notes.append(f"{share:.0%} of the cells around the floor are unknown; they became wall: robots stay on the map")
    return [_wall(rectangle, settings) for rectangle in rectangles]


def _world(cells: Any, settings: MapFile) -> np.ndarray:
    """Return world coordinates ``(..., 2)`` m of corners of cells."""
    x, y, yaw = settings.origin
    turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
    return (np.asarray(cells, dtype=np.float64) - WALL_BAND) * settings.resolution @ turn + (x, y)


def _wall(rectangle: Rectangle, settings: MapFile) -> Wall:
    i0, i1, j0, j1 = rectangle
    middle = ((i0 + i1) / 2, (j0 + j1) / 2)
    # All walls run in the same direction: walls that cross at right angles would be prolonged to close a corner, which
    # here is closed already.
    start, end = _world([(i0, middle[1]), (i1, middle[1])], settings).tolist()
    thickness = (j1 - j0) * settings.resolution
    block = [int(c * settings.resolution // LOOK_BLOCK) for c in middle]
    material = wall_material("", f"block {zlib.crc32(repr(block).encode())}")
    return Wall(start=start, end=end, thickness=thickness, height=CEILING_HEIGHT, front=material, back=material)


def _room(rectangles: Int[np.ndarray, "n 4"], number: int, settings: MapFile) -> dict[str, Any]:
    """Return a piece of floor with what it surrounds.

    Its outline runs half a cell inside the walls, in straight lines.
    """
    i0, i1, j0, j1 = rectangles.T
    outline = shapely.union_all(shapely.box(i0, j0, i1, j1)).buffer(0.6, join_style="mitre").simplify(0.5)
    corners = _world(shapely.get_coordinates(outline.exterior)[:-1], settings).tolist()
    name = f"Area {number}"
    return {"name": name, "kind": "area", "polygon": corners, "floor": floor_material("area", name)}


def _pieces(labels: Int[np.ndarray, "nx ny"]) -> dict[int, Int[np.ndarray, "n 4"]]:
    """Return rectangles (i0, i1, j0, j1) of each label above 0: its runs along j, those equal side by side joined.

    One pass serves all labels, so that many rooms within each other cost no more than one.
    """
    edges = np.flatnonzero(np.diff(labels.ravel(), prepend=0, append=0))  # the rim is 0: no run goes round its end
    label = labels.ravel()[edges[:-1]]
    runs = np.column_stack([label, *np.divmod(edges[:-1], labels.shape[1]), edges[1:] - edges[:-1]])[label > 0]
    runs = runs[np.lexsort(runs[:, [1, 3, 2, 0]].T)]  # by label, j0 and length, then i
    same = (np.diff(runs[:, [0, 2, 3]], axis=0) == 0).all(axis=1) & (np.diff(runs[:, 1]) == 1)
    first = np.flatnonzero(np.concatenate([[True], ~same]))
    last = np.append(first[1:], len(runs)) - 1
    label, i0, j0, length = runs[first].T
    rectangles = np.column_stack([i0, runs[last, 1] + 1, j0, j0 + length])
    names, starts = np.unique(label, return_index=True)
    return dict(zip(names.tolist(), np.split(rectangles, starts[1:]), strict=True))


def _grown(cells: Bool[np.ndarray, "nx ny"], by: int) -> Bool[np.ndarray, "nx ny"]:
    """Return the cells and all within ``by`` of them, diagonally too."""
    wide = ndimage.maximum_filter1d(cells.view(np.uint8), 2 * by + 1, axis=0, mode="constant")
    return ndimage.maximum_filter1d(wide, 2 * by + 1, axis=1, mode="constant").view(bool)


def _check_extent(floor: Bool[np.ndarray, "nx ny"], settings: MapFile, path: Path) -> None:
    """Raise InputError for what no apartment may be, before any work on it."""
    for axis in range(2):
        found = np.flatnonzero(floor.any(axis=1 - axis))
        if (across := (found[-1] + 1 - found[0]) * settings.resolution) > MAX_EXTENT:
            raise InputError(path, "image", f"a floor of at most {MAX_EXTENT:g} m across; found {across:.1f}")
