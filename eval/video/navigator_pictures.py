"""Draw the picture of one run of navigation: the run on the map, the belief at four times of it, the goal's image."""

import textwrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from vssm_gym.eval.report.explore_figures import plan_of
from vssm_gym.eval.video.ending import Ending
from vssm_gym.eval.video.navigator_recording import Moment, Recording
from vssm_gym.eval.video.pictures import (
    KEY,
    PATH_COLOUR,
    bare,
    cell_handles,
    draw_plan,
    draw_scale,
    extent,
    path_handles,
    robot_outline,
)
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.viz import pictures
from vssm_gym.viz.pictures import GOAL_COLOUR, TRUE_COLOUR
from vssm_gym.viz.text import visible

TIMES = (0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0)  # parts of the run at which the belief is shown
WIDTH, TITLE_LINE = 8.2, 0.22  # inches, of the picture and of a line of its title
IMAGES_HEIGHT = 2.2  # inches, of the images at the bottom
TITLE_LETTERS = 56  # of a line of the title
ROBOT_SHARE = 0.06  # of a small panel's longer edge, from the robot's centre to its tip


def run(recording: Recording, m: VoxelMap | None, row: dict[str, Any]) -> Figure:
    """Draw the whole run on a map from above, and below it the belief with the plan at the times :data:`TIMES`.

    Of a run to an image, the image and that of the camera at the end lie at the bottom.

    Args:
        recording: of a run that has ended.
        m: the map that the agent has built or was given; None: an empty plane.
        row: of the run, as a sweep writes it.
    """
    ending, background = Ending.of(row), None if m is None else plan_of(m)
    bounds = recording.bounds(*ending.region)
    tall = float((bounds[1, 1] - bounds[0, 1]) / (bounds[1, 0] - bounds[0, 0]))
    heights = np.clip(WIDTH * tall, 2.0, 7.0), np.clip(WIDTH / len(TIMES) * tall, 1.0, 3.0)
    driven = f"{row['path_length']:.1f} m, {recording.track.seconds[-1]:.0f} s"
    title = [f"{row['agent']}: {driven}, {ending.word}", *textwrap.wrap(visible(ending.reason), TITLE_LETTERS)]
    edges = 0.5 + TITLE_LINE * len(title), 0.6  # inches for titles and keys
    rows_high = [*np.add(heights, edges), *([] if recording.goal_rgb is None else [IMAGES_HEIGHT])]
    figure = Figure(figsize=(WIDTH, float(sum(rows_high))), layout="constrained")
    rows: Any = figure.subfigures(len(rows_high), 1, height_ratios=rows_high)
    axes = rows[0].subplots()
    pictures.draw_background(axes, background)
    bare(axes)
    pictures.draw_run(axes, row, ending.success_radius)
    left, right, bottom, top = extent(bounds)
    axes.set(xlim=(left, right), ylim=(bottom, top), facecolor=pictures.pale(pictures.UNKNOWN_COLOUR).tolist())
    rows[0].suptitle("\n".join(title), fontsize=10)
    draw_scale(axes, bounds)
    rows[0].legend(handles=_run_handles(row, ending), loc="outside lower center", **KEY)
    chosen = [recording.moments[round(part * (len(recording.moments) - 1))] for part in TIMES]
    for panel, moment in zip(rows[1].subplots(1, len(TIMES)), chosen, strict=True):
        _belief(panel, moment, recording, ending, bounds)
    rows[1].legend(handles=[*cell_handles(), *path_handles(TRUE_COLOUR)], loc="outside lower center", **KEY)
    if recording.goal_rgb is not None:
        images = {"image of the goal": recording.goal_rgb, "camera at the end": recording.moments[-1].rgb}
        for panel, (name, image) in zip(rows[2].subplots(1, 2), images.items(), strict=True):
            bare(panel)
            panel.imshow(image)
            panel.set_title(name, fontsize=8)
    return figure


def _belief(axes: Axes, moment: Moment, recording: Recording, ending: Ending, bounds: np.ndarray) -> None:
    """Draw the belief of one moment, with the path so far and the planned one."""
    bare(axes)
    draw_plan(axes, moment.plan, bounds)
    if ending.goal is not None:
        axes.add_patch(Circle(ending.goal, ending.success_radius, facecolor=GOAL_COLOUR, edgecolor="black", lw=0.4))
    axes.plot(*recording.track.until(moment.seconds).T, color=TRUE_COLOUR, linewidth=1.3, zorder=3)
    if moment.path is not None:
        axes.plot(*moment.path.T, color=PATH_COLOUR, linewidth=1.3, zorder=4)
    outline = robot_outline(moment.planar, ROBOT_SHARE * float((bounds[1] - bounds[0]).max()))
    axes.fill(*outline.T, facecolor=TRUE_COLOUR, edgecolor="white", linewidth=0.4, zorder=7)
    axes.set(xlim=bounds[:, 0], ylim=bounds[:, 1])
    axes.set_title(f"{moment.seconds:.0f} s, {moment.metres:.1f} m", fontsize=8)


def _run_handles(row: dict[str, Any], ending: Ending) -> list:
    """Return the key to what the run has."""
    left_out = {
        "estimate": not row["trace"]["estimate"],
        "goal region": ending.goal is None,
        "contact": not row["trace"]["contacts"],
    }
    return [handle for handle in pictures.legend_handles() if not left_out.get(str(handle.get_label()), False)]
