"""Draw a floor plan of the apartment with a robot, its path and its goal."""

import math
from collections.abc import Sequence

import numpy as np
import shapely
from PIL import Image, ImageDraw

from vssm_gym.envs.scenes.solids import SolidBox, footprint
from vssm_gym.geometry.axes import PlanarPose

PLAN_CUT = 1.2  # m: boxes that begin higher (wall cupboards, lintels) are left out
PICTURE = 360  # pixels, height of a rendered picture and width of its plan
FLATTEST = 2  # width over height of a camera's picture at most
ZOOM = 2  # pictures are drawn this many times larger, then reduced, for smooth edges
_INK = {"wall": (58, 60, 66), "door": (176, 126, 74), "window": (150, 190, 220)}  # RGB
PLAN_PATH, PLAN_ROBOT, PLAN_GOAL = (214, 60, 48), (24, 92, 196), (28, 150, 72)  # RGB
PLAN_REFERENCE = (150, 206, 170)  # RGB of a path to follow
PLAN_LEGEND = {"path": PLAN_PATH, "robot": PLAN_ROBOT, "goal": PLAN_GOAL}


class TopDown:
    """Draw the plan of ``boxes`` fitted into ``height`` x ``width`` pixels, north (world y) up.

    The background is drawn once; :meth:`draw` adds what moves.
    """

    def __init__(self, boxes: Sequence[SolidBox], height: int, width: int, margin: float = 0.2) -> None:
        corners = np.concatenate([_corners(box) for box in boxes if box.kind == "wall"])
        low, high = corners.min(axis=0) - margin, corners.max(axis=0) + margin
        self._scale = min(width / (high[0] - low[0]), height / (high[1] - low[1]))  # pixels a metre
        centre = 0.5 * (low + high)
        self._left = centre[0] - 0.5 * width / self._scale
        self._top = centre[1] + 0.5 * height / self._scale
        self._size = (width, height)
        image = Image.new("RGB", (width * ZOOM, height * ZOOM), "white")
        pen = ImageDraw.Draw(image)
        layers = {"floor": 0, "furniture": 1, "door": 2, "wall": 3, "window": 4}
        shown = [box for box in boxes if box.kind in layers and box.center[2] - 0.5 * box.size[2] < PLAN_CUT]
        for box in sorted(shown, key=lambda b: (layers[b.kind], b.center[2] + 0.5 * b.size[2])):
            self._box(pen, box)
        self.background = np.asarray(image.resize((width, height), Image.Resampling.BOX))

    def _box(self, pen: ImageDraw.ImageDraw, box: SolidBox) -> None:
        outline = [tuple(p) for p in self.pixels(_corners(box)) * ZOOM]
        tint = tuple(int(255 * c) for c in box.material.color)
        if box.kind == "floor":
            pen.polygon(outline, fill=tuple(int(200 + 0.2 * c) for c in tint))
        elif box.kind == "furniture":
            pen.polygon(outline, fill=tint, outline=tuple(c // 2 for c in tint))
        else:
            pen.polygon(outline, fill=_INK[box.kind])

    def pixels(self, xy: np.ndarray) -> np.ndarray:
        """Return image coordinates (column, row) of world positions ``(..., 2)``, m."""
        xy = np.asarray(xy, dtype=np.float64)
        return np.stack([(xy[..., 0] - self._left) * self._scale, (self._top - xy[..., 1]) * self._scale], axis=-1)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Return the world's lowest and highest x, and lowest and highest y, of the image's edges, m."""
        width, height = (side / self._scale for side in self._size)
        return self._left, self._left + width, self._top - height, self._top

    def draw(
        self,
        path: np.ndarray,
        robot: PlanarPose,
        robot_radius: float,
        goal: np.ndarray | None = None,
        goal_radius: float = 0.0,
        reference: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the plan with the path ``(n, 2)``, the robot with its direction of view, and a goal's disc, if any.

        ``reference`` ``(m, 2)`` is a path to follow, which is drawn below the others.

        Returns:
            uint8 ``(height, width, 3)``.
        """
        width, height = self._size
        image = Image.fromarray(self.background).resize((width * ZOOM, height * ZOOM), Image.Resampling.NEAREST)
        pen = ImageDraw.Draw(image)
        if reference is not None:
            line = [tuple(p) for p in self.pixels(reference) * ZOOM]
            pen.line(line, fill=PLAN_REFERENCE, width=2 * ZOOM, joint="curve")
        if goal is not None:
            goal_at, radius = self.pixels(goal) * ZOOM, goal_radius * self._scale * ZOOM
            pen.ellipse(_circle(goal_at, radius), outline=PLAN_GOAL, width=2 * ZOOM)
            pen.ellipse(_circle(goal_at, 2.0 * ZOOM), fill=PLAN_GOAL)
        if len(path) > 1:
            pen.line([tuple(p) for p in self.pixels(path) * ZOOM], fill=PLAN_PATH, width=2 * ZOOM, joint="curve")
        at, radius = self.pixels(robot[:2]) * ZOOM, max(robot_radius * self._scale, 4.0) * ZOOM
        pen.ellipse(_circle(at, radius), fill=PLAN_ROBOT)
        ahead = at + 2.2 * radius * np.array([math.cos(robot[2]), -math.sin(robot[2])])
        pen.line([tuple(at), tuple(ahead)], fill=PLAN_ROBOT, width=2 * ZOOM)
        return np.asarray(image.resize((width, height), Image.Resampling.BOX))


def at_height(rgb: np.ndarray, height: int) -> np.ndarray:
    """Return a camera's image, uint8 ``(H, W, 3)``, at another height.

    Pixels are repeated, not smoothed: the picture shows what the agent sees. An image flatter than ``FLATTEST`` is
    stretched vertically: a scan of one row would be invisible otherwise.
    """
    width = min(height * rgb.shape[1] // rgb.shape[0], FLATTEST * height)
    rows = (np.arange(height) * rgb.shape[0]) // height
    columns = (np.arange(width) * rgb.shape[1]) // width
    return rgb[rows[:, None], columns[None]]


def _corners(box: SolidBox) -> np.ndarray:
    return shapely.get_coordinates(footprint(box))[:4]


def _circle(at: np.ndarray, radius: float) -> tuple[float, float, float, float]:
    return (at[0] - radius, at[1] - radius, at[0] + radius, at[1] + radius)
