"""Write a video of one run of navigation: its images, the belief with paths and goal, and the pose estimate.

Static parts are drawn once; a frame draws the moving parts over them. The close-up shows the error of the estimate and
its 95 % region, which are centimetres where the floor plan has metres.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.artist import Artist
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle

from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.eval.video import pictures, writer
from vssm_gym.eval.video.ending import Ending
from vssm_gym.eval.video.navigator_recording import Moment, Recording
from vssm_gym.eval.video.plan_panel import PlanPanel
from vssm_gym.eval.video.writer import CAMERA_PLACE, STATUS_CHARACTERS, Page, Window
from vssm_gym.progress import OnProgress
from vssm_gym.viz.pictures import DASHES, ESTIMATE_COLOUR, GOAL_COLOUR, TRUE_COLOUR
from vssm_gym.viz.text import shortened, visible

ROBOT = HolonomicRobot()
REACHES = (0.16, 1.5)  # m, least and largest half edge of the close-up
CLOSE_CELLS = 120  # of the close-up along its edge
# Places on the page
PLAN_PLACE, CLOSE_UP, GOAL_IMAGE = (
    (0.345, 0.1, 0.635, 0.82),
    (0.02, 0.062, 0.19125, 0.34),
    (0.222, 0.062, 0.098, 0.1307),
)
GOAL: dict[str, Any] = {"facecolor": GOAL_COLOUR, "edgecolor": "black", "alpha": 0.55, "linewidth": 0.8}


def write_video(
    path: Path, recording: Recording, ending: Ending, title: str, on_progress: OnProgress | None = None
) -> None:
    """Write the run as MP4 (H.264), one frame a step; the file appears whole or not at all.

    Args:
        path: of the file, which ends in ``.mp4``.
        recording: of a run that has ended.
        ending: of the run.
        title: names agent and scene.
        on_progress: called with ("video", done, total).
    """
    writer.write_video(path, Sheet(recording, ending, title).draw, len(recording.moments), on_progress)


class Sheet:
    """Lay out the video's page; :meth:`draw` sets its moving parts."""

    def __init__(self, recording: Recording, ending: Ending, title: str) -> None:
        self._recording, self._ending = recording, ending
        self._page, first = Page(), recording.moments[0]
        page, figure = self._page, self._page.figure
        page.head(title, ROBOT.dt)
        self._pictures: list[tuple[Window, np.ndarray]] = []  # the same in every frame
        self._image = page.camera(CAMERA_PLACE, first.rgb.shape)
        self._numbers = page.moves(figure.text(0.02, 0.43, "", fontsize=13))
        self._error = page.moves(figure.text(0.222, 0.4, "", fontsize=10, va="top", linespacing=1.5))
        if recording.goal_rgb is not None:
            window = page.camera(GOAL_IMAGE, recording.goal_rgb.shape)
            self._pictures.append((window, recording.goal_rgb))
            figure.text(0.222, 0.035, "image of the goal", fontsize=9, color="0.35")
        self._close = CloseUp(page, recording)
        self._plan(first)

    def draw(self, i: int) -> UInt8[np.ndarray, "height width 3"]:
        """Draw the frame of moment ``i``."""
        moment, ending = self._recording.moments[i], self._ending
        driven, estimated = self._recording.track.until(moment.seconds), self._recording.estimated(i)
        plan = self._panel.set(moment.plan, driven, moment.path, moment.planar)
        self._estimated.set_data(*pictures.xy_of(estimated))
        self._region.set_data(*pictures.xy_of(moment.region))
        if self._estimate is not None and moment.estimate is not None:
            self._estimate.set_xy(pictures.robot_outline(moment.estimate))
        close = self._close.set(moment, driven, estimated)
        last = i == len(self._recording.moments) - 1
        word = f"      {ending.word}" if last else ""
        self._numbers.set_text(f"{moment.metres:.1f} m      {moment.seconds:.0f} s{word}")
        self._numbers.set_color(ending.colour if last else "black")
        self._error.set_text("\n".join(_facts(moment, ending)))
        status = ending.reason if last and ending.reason else moment.status
        self._status.set_text(shortened(visible(status), STATUS_CHARACTERS))
        return self._page.frame([(self._image, moment.rgb), *self._pictures, plan, close])

    def _plan(self, first: Moment) -> None:
        """Add the floor plan of the belief, with paths, goal and estimate."""
        page, figure, ending = self._page, self._page.figure, self._ending
        bounds = self._recording.bounds(*ending.region)
        self._panel = PlanPanel(page, PLAN_PLACE, bounds, first.plan.resolution, TRUE_COLOUR)
        axes = self._panel.axes
        if ending.goal is not None:
            page.moves(axes.add_patch(Circle(ending.goal, ending.success_radius, **GOAL)))
        self._estimated = page.moves(axes.plot([], [], color=ESTIMATE_COLOUR, linewidth=1.2, linestyle=DASHES)[0])
        self._panel.add_robot(first.planar, TRUE_COLOUR)
        self._estimate: Any = None
        if first.estimate is not None:
            self._estimate = page.moves(pictures.draw_robot(axes, first.estimate, "none"))
            self._estimate.set(edgecolor=ESTIMATE_COLOUR, linewidth=1.3)
        self._region = page.moves(axes.plot([], [], color=ESTIMATE_COLOUR, linewidth=1.3, zorder=8)[0])
        self._status = page.moves(figure.text(0.66, 0.065, "", fontsize=11, ha="center"))
        handles = key_handles(self._recording, ending)
        key = pictures.KEY | {"ncols": len(handles)}
        figure.legend(handles=handles, loc="lower center", bbox_to_anchor=(0.66, 0.005), **key)


class CloseUp:
    """Show the robot, the estimate and its 95 % region in true size, the true position in the middle."""

    def __init__(self, page: Page, recording: Recording) -> None:
        self._reach = reach = _reach_of(recording)
        axes = page.figure.add_axes(CLOSE_UP, xlim=(-reach, reach), ylim=(-reach, reach))
        pictures.bare(axes)
        frame = Rectangle((0.0, 0.0), 1.0, 1.0, transform=axes.transAxes, fill=False, edgecolor="0.6", clip_on=False)
        self._cells = page.window(axes, (CLOSE_CELLS, CLOSE_CELLS), upwards=True)
        page.figure.text(CLOSE_UP[0], 0.035, f"close-up, {2.0 * reach:.2g} m across", fontsize=9, color="0.35")
        estimate: dict[str, Any] = {"color": ESTIMATE_COLOUR, "linewidth": 1.4}
        self._driven = page.moves(axes.plot([], [], color=TRUE_COLOUR, linewidth=1.6)[0])
        self._path = page.moves(axes.plot([], [], color=pictures.PATH_COLOUR, linewidth=2.0)[0])
        self._estimated = page.moves(axes.plot([], [], linestyle=DASHES, **estimate)[0])
        body = Circle((0.0, 0.0), ROBOT.radius, facecolor=(TRUE_COLOUR, 0.25), edgecolor=TRUE_COLOUR)
        page.moves(axes.add_patch(body))
        self._ahead = page.moves(axes.plot([], [], color=TRUE_COLOUR, linewidth=1.6)[0])
        self._estimated_ahead = page.moves(axes.plot([], [], marker="o", markevery=[0], markersize=2.5, **estimate)[0])
        self._region = page.moves(axes.plot([], [], **estimate)[0])
        page.moves(axes.add_patch(frame))

    def set(
        self, moment: Moment, driven: Float[np.ndarray, "n 2"], estimated: Float[np.ndarray, "m 2"]
    ) -> tuple[Window, UInt8[np.ndarray, "rows columns 3"]]:
        """Show one moment; return the picture of the plan around the robot and its place."""
        centre = moment.planar[:2]
        for line, points in (
            (self._driven, driven),
            (self._path, moment.path),
            (self._estimated, estimated),
            (self._region, moment.region),
            (self._ahead, _ahead(moment.planar)),
            (self._estimated_ahead, None if moment.estimate is None else _ahead(moment.estimate)),
        ):
            line.set_data(*pictures.xy_of(None if points is None else points - centre))
        return self._cells, pictures.cell_image(moment.plan.around(centre, self._reach, CLOSE_CELLS))


def key_handles(recording: Recording, ending: Ending) -> list[Artist]:
    """Return the key to a plan: cells, paths, and what the run has of estimate and goal."""
    handles: list[Artist] = [*pictures.cell_handles(), *pictures.path_handles(TRUE_COLOUR)]
    line: dict[str, Any] = {"color": ESTIMATE_COLOUR, "linewidth": 1.3}
    if recording.moments[0].estimate is not None:
        handles.append(Line2D([], [], linestyle=DASHES, label="estimate", **line))
    if any(moment.region is not None for moment in recording.moments):
        ring: dict[str, Any] = {"marker": "o", "linestyle": "", "fillstyle": "none", "markersize": 8}
        handles.append(Line2D([], [], label="its 95 % region", **line | ring))
    if ending.goal is not None:
        dot: dict[str, Any] = {"marker": "o", "linestyle": "", "markersize": 9, "alpha": 0.6}
        handles.append(Line2D([], [], color=GOAL_COLOUR, label="goal region", **dot))
    return handles


def _facts(moment: Moment, ending: Ending) -> list[str]:
    """Return short lines on the distance to the goal and the error of the estimate."""
    facts = []
    if ending.goal is not None:
        facts.append(f"goal {np.hypot(*(moment.planar[:2] - ending.goal)):.1f} m away")
    if moment.error is not None:
        facts.append(f"estimate off by {_length(moment.error)}")
    if moment.region is not None:
        facts.append(f"95 %: up to {_length(_radius(moment))}")
    return facts


def _length(metres: float) -> str:
    return f"{metres:.1f} m" if metres >= 1.0 else f"{100.0 * metres:.0f} cm"


def _radius(moment: Moment) -> float:
    """Return the farthest that the 95 % region reaches from the estimate, m; 0 without one."""
    if moment.region is None or moment.estimate is None:
        return 0.0
    return float(np.linalg.norm(moment.region - moment.estimate[:2], axis=1).max())


def _reach_of(recording: Recording) -> float:
    """Return the half edge of the close-up: it shows error and region of most moments, m."""
    reaches = [(moment.error or 0.0) + _radius(moment) for moment in recording.moments]
    return float(np.clip(1.2 * np.quantile(reaches, 0.95), *REACHES))


def _ahead(planar: Float[np.ndarray, "3"]) -> Float[np.ndarray, "2 2"]:
    """Return the ends of the radius that points ahead, m."""
    return planar[:2] + ROBOT.radius * np.array([[0.0, 0.0], [np.cos(planar[2]), np.sin(planar[2])]])
