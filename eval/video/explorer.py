"""Write a video of one exploration: its images, map, candidates, planned path and coverage.

Static parts are drawn once; a frame draws the moving parts over them.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from matplotlib.figure import Figure

from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.eval.video import pictures, writer
from vssm_gym.eval.video.explorer_pictures import CANDIDATE, CHOSEN, GAIN_COLOURS, gain_norm, key_handles, label_gain
from vssm_gym.eval.video.explorer_recording import EVERY, Recording
from vssm_gym.eval.video.plan_panel import PlanPanel
from vssm_gym.eval.video.writer import CAMERA_PLACE, STATUS_CHARACTERS, Page
from vssm_gym.progress import OnProgress


def write_video(path: Path, recording: Recording, title: str, on_progress: OnProgress | None = None) -> None:
    """Write the run as MP4 (H.264), several times as fast as it was driven; the file appears whole or not at all.

    Args:
        path: of the file, which ends in ``.mp4``.
        recording: of a run that has ended, with at least one moment.
        title: names agent and scene.
        on_progress: called with ("video", done, total).
    """
    writer.write_video(path, Sheet(recording, title).draw, len(recording.moments), on_progress)


class Sheet:
    """Lay out the video's page; :meth:`draw` sets its moving parts."""

    def __init__(self, recording: Recording, title: str) -> None:
        self._recording = recording
        self._metres = np.array([moment.metres for moment in recording.moments])
        self._coverage = 100.0 * np.array([moment.coverage for moment in recording.moments])
        self._page, first = Page(), recording.moments[0]
        self._moves, figure = self._page.moves, self._page.figure
        self._page.head(title, EVERY * HolonomicRobot().dt)
        self._image = self._page.camera(CAMERA_PLACE, first.rgb.shape)
        self._numbers = self._moves(figure.text(0.02, 0.425, "", fontsize=13))
        self._curve(figure)
        self._plan(figure)

    def draw(self, i: int) -> UInt8[np.ndarray, "height width 3"]:
        """Draw the frame of moment ``i``."""
        moment = self._recording.moments[i]
        driven = self._recording.track.until(moment.seconds)
        plan = self._panel.set(moment.plan, driven, moment.path, moment.planar)
        if self._dots is not None:
            tour = moment.tour
            order = np.empty(0, int) if tour is None else np.argsort(tour.nats)
            self._dots.set_offsets(np.empty((0, 2)) if tour is None else tour.xy[order])
            self._dots.set_array(np.empty(0) if tour is None else 1e-3 * tour.nats[order])
            self._ring.set_data(*pictures.xy_of(None if tour is None else tour.xy[[tour.first]]))
        self._covered.set_data(self._metres[: i + 1], self._coverage[: i + 1])
        self._now.set_data(self._metres[i : i + 1], self._coverage[i : i + 1])
        self._numbers.set_text(
            f"{self._coverage[i]:.0f} % covered      {moment.metres:.1f} m      {moment.seconds:.0f} s"
        )
        self._status.set_text(moment.status[:STATUS_CHARACTERS])
        return self._page.frame([(self._image, moment.rgb), plan])

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
        norm, first = gain_norm(self._recording), self._recording.moments[0]
        place, colour = (0.345, 0.1, 0.57, 0.82), pictures.DRIVEN_COLOUR
        self._panel = PlanPanel(self._page, place, self._recording.bounds(), first.plan.resolution, colour)
        axes = self._panel.axes
        self._dots: Any = None
        if norm is not None:
            dots = axes.scatter([], [], c=[], cmap=GAIN_COLOURS, norm=norm, **CANDIDATE)
            self._dots = self._moves(dots)
            self._ring = self._moves(axes.plot([], [], color=pictures.PATH_COLOUR, **CHOSEN)[0])
            label_gain(figure.colorbar(dots, cax=figure.add_axes((0.93, 0.2, 0.013, 0.62))))
        self._panel.add_robot(first.planar, pictures.ROBOT_COLOUR)
        self._status = self._moves(figure.text(0.63, 0.065, "", fontsize=11, ha="center"))
        handles = key_handles(with_gain=norm is not None)
        figure.legend(handles=handles, loc="lower center", bbox_to_anchor=(0.63, 0.005), **pictures.KEY)
