"""Write a video of a policy's run in the simulator next to its imagined run of the same task.

Each side shows the camera's image and the floor plan with the robot's path, its pose estimate, and its scan as rays.
The run that ends first is held until the other ends.
"""

import textwrap
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from vssm_gym.eval.video import pictures as run_pictures
from vssm_gym.eval.video import writer
from vssm_gym.eval.video.writer import VIDEO_RATE, Page, Window
from vssm_gym.progress import OnProgress
from vssm_gym.training.recording import ROBOT, PolicyRun, PolicyRuns
from vssm_gym.viz import pictures

RAY_COLOUR = "#3a8fd0"
LABELLED_MARGIN = 0.4  # m, margin of the plans, which holds the scale
LETTERS = 42  # of a line next to the image
HEADS = "in the simulator", "imagined in the learned map"
SEEN = "its camera's image", "the map rendered from there; the policy sees the scan alone"


def write_video(path: Path, both: PolicyRuns, on_progress: OnProgress | None = None) -> None:
    """Write the two runs as MP4 (H.264), one frame a step; the file appears whole or not at all.

    Args:
        path: of the file, which ends in ``.mp4``.
        both: runs that have ended.
        on_progress: called with ("video", done, total).
    """
    writer.write_video(path, Sheet(both).draw, len(both), on_progress)


class Sheet:
    """Lay out the page of both runs; :meth:`draw` draws its frames."""

    def __init__(self, both: PolicyRuns) -> None:
        self._page = page = Page()
        figure = page.figure
        figure.text(0.02, 0.955, f"{both.label} in {both.scene}, task {both.task.id}", fontsize=15, weight="bold")
        figure.text(
            0.98, 0.955, f"{ROBOT.dt * VIDEO_RATE:g} x as fast as driven", fontsize=10, ha="right", color="0.35"
        )
        corners = np.array([run.plan.bounds for run in (both.real, both.imagined)])
        bounds = np.stack([corners[:, 0].min(axis=0) - LABELLED_MARGIN, corners[:, 1].max(axis=0) + LABELLED_MARGIN])
        runs = zip((both.real, both.imagined), HEADS, SEEN, (0.02, 0.515), strict=True)
        self._sides = [Side(page, both, run, bounds, head, caption, left) for run, head, caption, left in runs]
        figure.legend(handles=_handles(), loc="lower center", **run_pictures.KEY)

    def draw(self, i: int) -> UInt8[np.ndarray, "height width 3"]:
        """Draw frame number ``i``."""
        return self._page.frame([side.set(i) for side in self._sides])


class Side:
    """Lay out one run's half of the page, with its left edge at ``left``."""

    def __init__(
        self, page: Page, both: PolicyRuns, run: PolicyRun, bounds: np.ndarray, head: str, caption: str, left: float
    ) -> None:
        self._run, figure = run, page.figure
        image = run.moments[0].image
        self._window = page.camera((left, 0.665, 0.1875, 0.25), image.shape)
        text_left = left + 0.2
        figure.text(text_left, 0.89, head, fontsize=13, weight="bold")
        figure.text(text_left, 0.667, textwrap.fill(caption, LETTERS), fontsize=9, color="0.35", va="bottom")
        axes = figure.add_axes((left, 0.055, 0.465, 0.595), xlim=bounds[:, 0], ylim=bounds[:, 1])
        run_pictures.bare(axes)
        run_pictures.draw_plan(axes, run.plan, run.plan.bounds)
        axes.set(xlim=bounds[:, 0], ylim=bounds[:, 1])
        axes.set_facecolor(to_hex(pictures.UNKNOWN_COLOUR.tolist()))
        goal = Circle(both.task.goal, both.success_radius, facecolor=pictures.GOAL_COLOUR, edgecolor="black", alpha=0.6)
        axes.add_patch(goal)
        axes.plot(*both.task.start[:2], "o", color=pictures.TRUE_COLOUR, markersize=5)
        run_pictures.draw_scale(axes, bounds)
        self._rays = page.moves(axes.add_collection(LineCollection([], colors=RAY_COLOUR, linewidths=0.6, alpha=0.55)))
        halo = run_pictures.HALO
        self._path = page.moves(axes.plot([], [], color=pictures.TRUE_COLOUR, linewidth=1.8, path_effects=halo)[0])
        self._estimate = page.moves(
            axes.plot([], [], color=pictures.ESTIMATE_COLOUR, linewidth=1.2, linestyle=pictures.DASHES)[0]
        )
        self._robot = page.moves(run_pictures.draw_robot(axes, run.moments[0].planar))
        self._robot.set_facecolor(pictures.TRUE_COLOUR)
        self._estimated_robot = page.moves(run_pictures.draw_robot(axes, run.moments[0].estimate))
        self._estimated_robot.set(facecolor="none", edgecolor=pictures.ESTIMATE_COLOUR)
        self._words = page.moves(figure.text(text_left, 0.875, "", fontsize=11, va="top", linespacing=1.35))

    def set(self, i: int) -> tuple[Window, UInt8[np.ndarray, "rows columns 3"]]:
        """Show moment ``i``, or the last one; return the image and its place."""
        run = self._run
        i = min(i, len(run.moments) - 1)
        moment, path = run.moments[i], run.path("planar", i + 1)
        self._rays.set_segments([[moment.planar[:2], end] for end in moment.hits])
        self._path.set_data(*path.T)
        self._estimate.set_data(*run.path("estimate", i + 1).T)
        self._robot.set_xy(run_pictures.robot_outline(moment.planar))
        self._estimated_robot.set_xy(run_pictures.robot_outline(moment.estimate))
        driven = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
        off = float(np.linalg.norm(moment.estimate[:2] - moment.planar[:2]))
        ended = i == len(run.moments) - 1
        numbers = f"{moment.seconds:.1f} s, {driven:.1f} m driven\nestimate off by {100.0 * off:.0f} cm"
        contact = f"{moment.collisions} step{'' if moment.collisions == 1 else 's'}"
        said = textwrap.fill(run.ending if ended else moment.status, LETTERS)
        self._words.set_text(f"{numbers}\n{contact} in contact\n{said}")
        self._words.set_color("black" if not ended else "#0b6e4f" if run.success else "#b3261e")
        return self._window, moment.image


def _handles() -> list:
    """Return the key to both plans."""
    dot = {"marker": "o", "linestyle": "", "markersize": 9, "alpha": 0.6}
    return [
        *run_pictures.cell_handles(),
        Line2D([], [], color=pictures.TRUE_COLOUR, linewidth=1.8, label="path"),
        Line2D([], [], color=pictures.ESTIMATE_COLOUR, linewidth=1.2, linestyle=pictures.DASHES, label="estimate"),
        Line2D([], [], color=RAY_COLOUR, linewidth=1.0, label="scan"),
        Line2D([], [], color=pictures.GOAL_COLOUR, label="goal region", **dot),  # type: ignore[arg-type]
    ]
