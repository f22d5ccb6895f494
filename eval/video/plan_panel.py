"""Lay out the floor plan of a growing belief on a page of a video, with the robot's paths on it."""

import numpy as np
from jaxtyping import Float, UInt8

from vssm_gym.eval.video import pictures
from vssm_gym.eval.video.plans import CroppedPlan
from vssm_gym.eval.video.writer import Page, Place, Window


class PlanPanel:
    """Show the belief of one moment after the other within fixed ``bounds`` (m).

    Artists that are added to ``axes`` between :meth:`__init__` and :meth:`add_robot` lie between paths and robot.
    """

    def __init__(
        self, page: Page, place: Place, bounds: Float[np.ndarray, "2 2"], resolution: float, driven: str
    ) -> None:
        """Add the plan, whose cells have edges of ``resolution`` m, and the paths; ``driven`` is a colour."""
        self._page, self._bounds = page, bounds
        self.axes = axes = page.figure.add_axes(place, xlim=bounds[:, 0], ylim=bounds[:, 1])
        pictures.bare(axes)
        columns, rows = np.ceil((bounds[1] - bounds[0]) / resolution - 1e-6).astype(int).tolist()
        self._cells = page.window(axes, (rows, columns), upwards=True)
        self._driven, self._path = (
            page.moves(axes.plot([], [], color=colour, linewidth=width, path_effects=pictures.HALO)[0])
            for colour, width in ((driven, 1.6), (pictures.PATH_COLOUR, 2.0))
        )

    def add_robot(self, planar: Float[np.ndarray, "3"], colour: str) -> None:
        """Add the robot and the scale, above all that was added before."""
        self._robot = self._page.moves(pictures.draw_robot(self.axes, planar, colour))
        for artist in pictures.draw_scale(self.axes, self._bounds):
            self._page.moves(artist)

    def set(
        self,
        plan: CroppedPlan,
        driven: Float[np.ndarray, "n 2"],
        path: Float[np.ndarray, "m 2"] | None,
        planar: Float[np.ndarray, "3"],
    ) -> tuple[Window, UInt8[np.ndarray, "rows columns 3"]]:
        """Show one moment; return the picture of the plan and its place, for the page's frame."""
        self._driven.set_data(*driven.T)
        self._path.set_data(*pictures.xy_of(path))
        self._robot.set_xy(pictures.robot_outline(planar))
        return self._cells, pictures.plan_image(plan, self._bounds)
