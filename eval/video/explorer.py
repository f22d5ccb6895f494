"""Write a video of one exploration: its images, map, candidates, planned path and coverage.

Static parts are drawn once; a frame draws the moving parts over them.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from matplotlib.figure import Figure

from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.eval.video import pictures
from vssm_gym.eval.video.recording import EVERY, Recording
from vssm_gym.eval.video.writer import VIDEO_RATE, Page, Window, write_frames
from vssm_gym.files.atomic import atomic_write
from vssm_gym.progress import OnProgress

_CHARACTERS = 92  # of a status: a line holds no more


def write_video(path: Path, recording: Recording, title: str, on_progress: OnProgress | None = None) -> None:
    """Write the run as MP4 (H.264), several times as fast as it was driven; the file appears whole or not at all.

    Args:
        path: of the file, which ends in ``.mp4``.
        recording: of a run that has ended, with at least one moment.
        title: names agent and scene.
        on_progress: called with ("video", done, total).
    """
    sheet, n = Sheet(recording, title), len(recording.moments)
    with atomic_write(path) as temporary:
        write_frames(temporary, (sheet.draw(i) for i in range(n)), n, on_progress)


class Sheet:
    """Lay out the video's page; :meth:`draw` sets its moving parts."""

    def __init__(self, recording: Recording, title: str) -> None:
        self._recording, self._bounds = recording, recording.bounds()
        self._metres = np.array([moment.metres for moment in recording.moments])
        self._coverage = 100.0 * np.array([moment.coverage for moment in recording.moments])
        self._page = Page()
        self._moves, figure = self._page.moves, self._page.figure
        figure.text(0.02, 0.95, title, fontsize=15, weight="bold")
        speed = EVERY * HolonomicRobot().dt * VIDEO_RATE
        figure.text(0.98, 0.95, f"{speed:g} x as fast as driven", fontsize=10, ha="right", color="0.35")
        self._image_panel(figure)
        self._curve(figure)
        self._plan(figure)

    def draw(self, i: int) -> UInt8[np.ndarray, "height width 3"]:
        """Draw the frame of moment ``i``."""
        moment = self._recording.moments[i]
        self._driven.set_data(*self._recording.driven(moment).T)
        self._path.set_data(*(np.empty((2, 0)) if moment.path is None else moment.path.T))
        self._robot.set_xy(pictures.robot_outline(moment.planar))
        if self._dots is not None:
            tour = moment.tour
            order = np.empty(0, int) if tour is None else np.argsort(tour.nats)
            self._dots.set_offsets(np.empty((0, 2)) if tour is None else tour.xy[order])
            self._dots.set_array(np.empty(0) if tour is None else 1e-3 * tour.nats[order])
            self._ring.set_data(*(np.empty((2, 0)) if tour is None else tour.xy[[tour.first]].T))
        self._covered.set_data(self._metres[: i + 1], self._coverage[: i + 1])
        self._now.set_data(self._metres[i : i + 1], self._coverage[i : i + 1])
        self._numbers.set_text(
            f"{self._coverage[i]:.0f} % covered      {moment.metres:.1f} m      {moment.seconds:.0f} s"
        )
        self._status.set_text(moment.status[:_CHARACTERS])
        plan = pictures.plan_image(moment.plan, self._bounds)
        return self._page.frame([(self._image, moment.rgb), (self._cells, plan)])

    def _image_panel(self, figure: Figure) -> None:
        """Add the robot's image, and the numbers."""
        rgb = self._recording.moments[0].rgb
        axes = figure.add_axes((0.02, 0.475, 0.3, 0.445), xlim=(0, rgb.shape[1]), ylim=(0, rgb.shape[0]))
        pictures.bare(axes)
        self._image = Window(axes, rgb.shape, self._page.size, upwards=False)
        self._numbers = self._moves(figure.text(0.02, 0.425, "", fontsize=13))

    def _curve(self, figure: Figure) -> None:
        """Add the curve of coverage over path length."""
        axes = figure.add_axes((0.06, 0.1, 0.26, 0.28))
        longest = max(float(self._metres[-1]), 1.0)
        axes.set(xlim=(0.0, 1.02 * longest), ylim=(0.0, 102.0), xlabel="driven, m", ylabel="covered, %")
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.3, linewidth=0.5)
        axes.plot(self._metres, self._coverage, color="0.85", linewidth=1.4)
        self._covered = self._moves(axes.plot([], [], color=pictures.DRIVEN_COLOUR, linewidth=2)[0])
        self._now = self._moves(axes.plot([], [], "o", color=pictures.DRIVEN_COLOUR)[0])

    def _plan(self, figure: Figure) -> None:
        """Add the floor plan of the belief, with candidates and the planned path."""
        norm, bounds = pictures.gain_norm(self._recording), self._bounds
        axes = figure.add_axes((0.345, 0.1, 0.57, 0.82), xlim=bounds[:, 0], ylim=bounds[:, 1])
        pictures.bare(axes)
        shape = pictures.plan_image(self._recording.moments[0].plan, bounds).shape
        self._cells = Window(axes, shape, self._page.size, upwards=True)
        self._driven, self._path = (
            self._moves(axes.plot([], [], color=colour, linewidth=width, path_effects=pictures.HALO)[0])
            for colour, width in ((pictures.DRIVEN_COLOUR, 1.6), (pictures.PATH_COLOUR, 2.0))
        )
        self._dots: Any = None
        if norm is not None:
            dots = axes.scatter([], [], c=[], cmap=pictures.GAIN_COLOURS, norm=norm, **pictures.CANDIDATE)
            self._dots = self._moves(dots)
            self._ring = self._moves(axes.plot([], [], color=pictures.PATH_COLOUR, **pictures.CHOSEN)[0])
            pictures.label_gain(figure.colorbar(dots, cax=figure.add_axes((0.93, 0.2, 0.013, 0.62))))
        self._robot = self._moves(pictures.draw_robot(axes, self._recording.moments[0].planar))
        for artist in pictures.draw_scale(axes, bounds):
            self._moves(artist)
        self._status = self._moves(figure.text(0.63, 0.065, "", fontsize=11, ha="center"))
        handles = pictures.plan_handles(with_gain=norm is not None)
        figure.legend(handles=handles, loc="lower center", bbox_to_anchor=(0.63, 0.005), **pictures.KEY)
