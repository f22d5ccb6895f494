"""Draw a car's run into the floor plan: its path, its footprint with the front marked, and the target."""

import math

import numpy as np
from PIL import Image, ImageDraw

from vssm_gym.envs.rendering.topdown import PLAN_GOAL, PLAN_PATH, PLAN_ROBOT, ZOOM, TopDown
from vssm_gym.geometry.axes import PlanarPose
from vssm_gym.geometry.car import Car

_NOSE = (245, 245, 250)  # RGB of the mark at the front of the footprint


def draw_run(
    plan: TopDown, path: np.ndarray, car: Car, planar: PlanarPose, goal: np.ndarray, radius: float
) -> np.ndarray:
    """Return the plan with the path of the rear axle, the car's footprint and its target.

    The target is a disc of ``radius`` m, and the footprint's outline with an arrow if the goal has a heading.

    Args:
        plan: the floor plan.
        path: ``(n, 2)`` positions of the rear axle, m.
        car: its dimensions.
        planar: ``(x, y, heading)`` of the rear axle, m and rad.
        goal: ``(2,)`` or ``(3,)``, m and rad.
        radius: of the target, m.

    Returns:
        uint8 image of the plan's size.
    """
    height, width = plan.background.shape[:2]
    image = Image.fromarray(plan.background).resize((width * ZOOM, height * ZOOM), Image.Resampling.NEAREST)
    pen = ImageDraw.Draw(image)

    def at(xy: np.ndarray) -> list[tuple[float, float]]:
        return [(float(column), float(row)) for column, row in plan.pixels(xy).reshape(-1, 2) * ZOOM]

    angle = np.linspace(0.0, 2.0 * math.pi, 33)
    circle = goal[:2] + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    pen.line(at(circle), fill=PLAN_GOAL, width=2 * ZOOM)
    if len(goal) == 3:
        corners = car.corners(goal)
        pen.line(at(np.concatenate([corners, corners[:1]])), fill=PLAN_GOAL, width=2 * ZOOM)
        pen.line(at(_nose(car, goal)), fill=PLAN_GOAL, width=2 * ZOOM)
    if len(path) > 1:
        pen.line(at(path), fill=PLAN_PATH, width=2 * ZOOM, joint="curve")
    pen.polygon(at(car.corners(planar)), fill=PLAN_ROBOT)
    pen.line(at(_nose(car, planar)), fill=_NOSE, width=2 * ZOOM)
    return np.asarray(image.resize((width, height), Image.Resampling.BOX))


def _nose(car: Car, planar: PlanarPose) -> np.ndarray:
    """Return an arrow head inside the footprint: from one side over the front to the other, ``(3, 2)``."""
    c, s = math.cos(planar[2]), math.sin(planar[2])
    front = car.length - car.rear_overhang - 0.02
    forward = np.array([front - 0.1, front, front - 0.1])
    left = np.array([-1.0, 0.0, 1.0]) * 0.35 * car.width
    return planar[:2] + np.stack([c * forward - s * left, s * forward + c * left], axis=-1)
