"""Draw the image of the ball, and where each posterior has the camera."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from vssm_gym.eval.studies.pose_flow.ball import COLOUR, DISTANCE, RADIUS, true_pose
from vssm_gym.model.emission import RGBD
from vssm_gym.viz import pictures

SHOWN_POSES = 250  # draws of each posterior
CAMERA_ARROW = 0.35  # m, of a viewing direction
AXES_REACH = 1.15 * DISTANCE  # m, of the axes
AXES_TICKS = (-1.0, 0.0, 1.0)  # m


def draw(image: RGBD, poses: Mapping[str, Float[np.ndarray, "n 4 4"]]) -> bytes:
    """Draw the image and the posteriors side by side, as SVG.

    Args:
        image: what the camera sees.
        poses: draws of ``T_world_cam`` by family.
    """
    figure = Figure(figsize=(3.4 * (1 + len(poses)), 3.7), layout="constrained")
    seen = figure.add_subplot(1, 1 + len(poses), 1)
    hit = np.asarray(image.hit)[..., None]
    seen.imshow(np.where(hit, np.asarray(image.rgb), 1.0))
    seen.set(xticks=[], yticks=[], title="image")
    for number, (name, T) in enumerate(poses.items(), 2):
        axes: Any = figure.add_subplot(1, 1 + len(poses), number, projection="3d")
        _draw_poses(axes, T[:SHOWN_POSES])
        axes.set_title(name, y=0.97)  # the zoomed box leaves no room above
    return pictures.svg(figure)


def _draw_poses(axes: Any, T: Float[np.ndarray, "n 4 4"]) -> None:
    """Draw the ball, an arrow for each camera, from its place along its line of sight, and the true camera."""
    u, v = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 25), np.linspace(0.0, np.pi, 13))
    ball = RADIUS * np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)])
    axes.plot_surface(*ball, color=tuple(COLOUR), linewidth=0.0)
    at, ahead = T[:, :3, 3], CAMERA_ARROW * T[:, :3, 2]
    axes.quiver(*at.T, *ahead.T, color=pictures.ESTIMATE_COLOUR, linewidth=0.6, alpha=0.6, arrow_length_ratio=0.3)
    axes.plot(*at.T, ".", color=pictures.ESTIMATE_COLOUR, markersize=2)
    true = true_pose()
    axes.quiver(
        *true[:3, 3],
        *(2.0 * CAMERA_ARROW * true[:3, 2]),
        color=pictures.TRUE_COLOUR,
        linewidth=2.0,
        arrow_length_ratio=0.3,
    )
    axes.set(xlim=(-AXES_REACH, AXES_REACH), ylim=(-AXES_REACH, AXES_REACH), zlim=(-AXES_REACH, AXES_REACH), xlabel="m")
    axes.set(xticks=AXES_TICKS, yticks=AXES_TICKS, zticks=AXES_TICKS)
    axes.set_box_aspect((1.0, 1.0, 1.0), zoom=1.15)
    axes.tick_params(labelsize=7)
