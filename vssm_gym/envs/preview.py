"""Draw a preview of a scene: its furnished plan beside two camera images from viewpoints chosen by what they show."""

import math

import numpy as np
import shapely
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from vssm_gym.envs.rendering.raycast import RaycastCamera
from vssm_gym.envs.rendering.topdown import PLAN_ROBOT, TopDown
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.envs.tasks.mazes import is_maze
from vssm_gym.geometry.axes import Matrix4

CAMERA_HEIGHT = 1.4  # m
CAMERA_PITCH = math.radians(12.0)  # rad, its pitch: furniture stands below the camera
HFOV = math.radians(78.0)  # rad
VIEW_POSITIONS, VIEW_HEADINGS = 48, 16  # viewpoints tried in a room
ENOUGH = 4  # rays of the coarse image that must meet a thing for it to count as seen
TOO_CLOSE = 0.9  # m; things as close as this spoil a view
FAR_ENOUGH = 8.0  # m; beyond, distance makes a view no better
VIEWPOINTS_APART = 1.5  # m between the two viewpoints
TICKS, TICKS_APART = (1, 2, 5, 10, 20, 50), 22.0  # metres between two numbers along a plan, and pixels at least
TICK_SIZE, TICK_COLOUR = 10, (60, 60, 60)  # of these numbers: pixels, RGB
_GAP = 4  # pixels between the pictures


def preview(apartment: Apartment, height: int = 360) -> UInt8[np.ndarray, "height width 3"]:
    """Draw the plan, north up, and beside it two camera images one above the other.

    The images are taken in the two largest rooms (both in the one room of a studio, at least VIEWPOINTS_APART from each
    other where it is large enough), each from where most pieces of furniture are seen that the other does not show.
    Blue dots in the plan mark the viewpoints, their angles the field of view; numbers along it are metres of the
    scene's frame, x below and y on the left. The width follows the plan's proportions.
    A maze is drawn as its plan alone, since it is a world of two dimensions.

    Args:
        apartment: the scene.
        height: pixels, at least 64.

    Raises:
        InputError: a scene in which no robot fits, which therefore has no viewpoint.
    """
    if is_maze(apartment):
        return TopDown(apartment.boxes(), height, height, margin=0.02).background
    robot = HolonomicRobot()
    space = FreeSpace.from_apartment(apartment, robot.radius, robot.height)
    boxes = apartment.boxes()
    view_height = (height - _GAP) // 2
    config = CameraConfig(view_height * 4 // 3, view_height, HFOV)
    camera = RaycastCamera(boxes, config.intrinsics())
    coarse = RaycastCamera(boxes, CameraConfig(40, 30, HFOV).intrinsics())
    names = np.array([box.name if box.kind == "furniture" else "" for box in boxes])

    # A room is large by its floor far from walls: corridors come last.
    rooms = sorted(space.rooms.values(), key=lambda room: (room.buffer(-0.8).area, room.area), reverse=True)
    poses: list[Matrix4] = []
    seen: set[str] = set()
    for room in (rooms * 2)[:2]:
        positions = _apart(_positions(space, room), poses if room is rooms[0] else [])
        pose, shown = _best_view(coarse, names, positions, seen)
        poses.append(pose)
        seen |= shown
    views = [camera.render(pose)[0] for pose in poses]

    low, high = np.split(np.array(shapely.union_all(list(space.rooms.values())).bounds), 2)
    aspect = float(np.clip((high[0] - low[0]) / (high[1] - low[1]), 0.5, 2.0))
    plan = TopDown(boxes, height, round(aspect * height))
    picture = np.full((height, round(aspect * height) + _GAP + config.width, 3), 255, dtype=np.uint8)
    picture[:, : round(aspect * height)] = _with_metres(_with_cameras(plan, poses), plan, low, high)
    picture[:view_height, -config.width :] = views[0]
    picture[height - view_height :, -config.width :] = views[1]
    return picture


def _positions(space: FreeSpace, room: shapely.Polygon) -> Float[np.ndarray, "n 2"]:
    """Return about VIEW_POSITIONS viewpoints spread over the free space well inside a room, or of all rooms."""
    inside_doors = space.largest.intersection(room.buffer(-0.5))
    area = inside_doors if inside_doors.area > 0.01 else space.largest
    shapely.prepare(area)
    x0, y0, x1, y1 = area.bounds
    step = math.sqrt(area.area / VIEW_POSITIONS)
    grid = np.stack(np.meshgrid(np.arange(x0, x1, step), np.arange(y0, y1, step), indexing="ij"), axis=-1)
    inside = grid[shapely.contains_xy(area, grid[..., 0], grid[..., 1])]
    return inside if len(inside) else shapely.get_coordinates(area.representative_point())


def _apart(positions: Float[np.ndarray, "n 2"], poses: list[Matrix4]) -> Float[np.ndarray, "m 2"]:
    """Return the positions VIEWPOINTS_APART from all that were chosen, or the farthest one where there are none."""
    if not poses:
        return positions
    taken = np.array([pose[:2, 3] for pose in poses])
    away = np.linalg.norm(positions[:, None] - taken, axis=-1).min(axis=1)
    return positions[away >= min(VIEWPOINTS_APART, float(away.max()))]


def _best_view(
    coarse: RaycastCamera, names: np.ndarray, positions: Float[np.ndarray, "n 2"], known: set[str]
) -> tuple[Matrix4, set[str]]:
    """Return the pose that shows most pieces not in ``known``, then the deepest view, and the pieces it shows."""
    best: tuple[float, Matrix4, set[str]] = (-math.inf, np.eye(4), set())
    for x, y in positions:
        for heading in 2.0 * math.pi * np.arange(VIEW_HEADINGS) / VIEW_HEADINGS:
            T_world_cam = _look(x, y, heading)
            depth, box = coarse.first_boxes(T_world_cam)
            met, count = np.unique(names[box[box >= 0]], return_counts=True)
            shown = set(met[count >= ENOUGH].tolist()) - {""}
            # A near object hides the room: distance counts as much as a handful of pieces.
            score = len(shown - known) + 8.0 * float(np.clip(depth, 0.0, FAR_ENOUGH).mean()) / FAR_ENOUGH
            score -= 20.0 * float((depth < TOO_CLOSE).mean())
            if score > best[0]:
                best = (score, T_world_cam, shown)
    return best[1], best[2]


def _look(x: float, y: float, heading: float) -> Matrix4:
    """Return the camera pose at (x, y, CAMERA_HEIGHT), looking along ``heading`` and CAMERA_PITCH below the horizon."""
    c, s, cd, sd = math.cos(heading), math.sin(heading), math.cos(CAMERA_PITCH), math.sin(CAMERA_PITCH)
    right, down, forward = (s, -c, 0.0), (-c * sd, -s * sd, -cd), (c * cd, s * cd, -sd)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([right, down, forward])
    T[:3, 3] = (x, y, CAMERA_HEIGHT)
    return T


def _with_cameras(plan: TopDown, poses: list[Matrix4]) -> UInt8[np.ndarray, "height width 3"]:
    """Draw a dot at each camera and the borders of its field of view into the plan."""
    image = Image.fromarray(plan.background)
    pen = ImageDraw.Draw(image)
    for T in poses:
        edges = math.atan2(T[1, 2], T[0, 2]) + np.array([-0.5, 0.5]) * HFOV
        tips = T[:2, 3] + np.stack([np.cos(edges), np.sin(edges)], axis=-1)
        left, eye, right = (tuple(p) for p in plan.pixels(np.stack([tips[0], T[:2, 3], tips[1]])))
        pen.line([left, eye, right], fill=PLAN_ROBOT, width=2)
        pen.ellipse([eye[0] - 4, eye[1] - 4, eye[0] + 4, eye[1] + 4], fill=PLAN_ROBOT)
    return np.asarray(image)


def _with_metres(
    image: UInt8[np.ndarray, "height width 3"],
    plan: TopDown,
    low: Float[np.ndarray, "2"],
    high: Float[np.ndarray, "2"],
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw the scene's coordinates along the lower and the left edge of the plan, at whole metres."""
    picture = Image.fromarray(image)
    pen, font, height = ImageDraw.Draw(picture), ImageFont.load_default(TICK_SIZE), len(image)
    corners = plan.pixels(np.array([low, high]))
    scale = float((corners[1, 0] - corners[0, 0]) / (high[0] - low[0]))
    every = next(metres for metres in TICKS if metres * scale >= TICKS_APART or metres == TICKS[-1])
    for axis in (0, 1):
        for metres in np.arange(math.ceil(low[axis] / every) * every, high[axis] + 1e-9, every):
            at = float(plan.pixels(np.where(np.arange(2) == axis, metres, low))[axis])
            line = [(at, height - 5), (at, height)] if axis == 0 else [(0, at), (5, at)]
            pen.line(line, fill=TICK_COLOUR)
            place, anchor = ((at, height - 6), "mb") if axis == 0 else ((7, at), "lm")
            pen.text(
                place, f"{metres:g}", fill=TICK_COLOUR, font=font, anchor=anchor, stroke_width=1, stroke_fill="white"
            )
    return np.asarray(picture)
