"""Draw particles in a map at several times, and how many places they are at."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.transforms import Affine2D

from vssm_gym.eval.studies.pose_ambiguity.modes import Spread
from vssm_gym.maps.planar_map import PlanarMap
from vssm_gym.viz.pictures import TRUE_COLOUR

MOMENT_COLUMNS = 3  # of the grid of moments
PARTICLE_ARROW = 0.028  # m, of a particle


@dataclass(frozen=True)
class Moment:
    """Hold what one panel shows."""

    scans: int  # seen so far; 0: the prior
    poses: Float[np.ndarray, "n 3"]  # equally weighted, x, y (m), heading (rad) in the map
    true: Float[np.ndarray, "3"]  # pose in the map, or of the first scan for the prior


def draw(
    m: PlanarMap, frame: Float[np.ndarray, "3"], moments: Sequence[Moment], spreads: Sequence[Spread], particles: int
) -> Figure:
    """Draw the moments over the map, and the measures of all scans below.

    Args:
        m: the map.
        frame: pose of the map in the picture, x, y (m), heading (rad); it turns the picture and nothing else.
        moments: to show.
        spreads: after 0, 1, 2, ... scans.
        particles: of the belief, for the title.
    """
    rows = -(-len(moments) // MOMENT_COLUMNS)
    figure = Figure(figsize=(3.0 * MOMENT_COLUMNS, 3.1 * rows + 2.1), layout="constrained")
    grid = figure.add_gridspec(rows + 1, MOMENT_COLUMNS, height_ratios=[3.1] * rows + [2.1])
    panels = [figure.add_subplot(grid[k // MOMENT_COLUMNS, k % MOMENT_COLUMNS]) for k in range(len(moments))]
    place = Affine2D().rotate(frame[2]).translate(*frame[:2])
    for axes, moment in zip(panels, moments, strict=True):
        _panel(axes, m, place, frame[2], moment, spreads[moment.scans])
    circle = ScalarMappable(Normalize(-180.0, 180.0), "hsv")
    bar = figure.colorbar(circle, ax=panels, ticks=[-180, -90, 0, 90, 180], aspect=40, pad=0.01)
    bar.set_label("heading of a particle, degrees", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    _curves(figure.add_subplot(grid[rows, :]), spreads, [moment.scans for moment in moments])
    figure.suptitle(
        f"Where is the robot? {particles:,} particles in a known map; the ring is the true pose", fontsize=11
    )
    return figure


def _panel(axes: Axes, m: PlanarMap, place: Affine2D, turn: float, moment: Moment, spread: Spread) -> None:
    wall = np.where(m.observed & (np.asarray(m.occupancy) > 0.0), 0.75, 0.0)
    low, cell = np.asarray(m.origin) - 0.5 * float(m.cell_size), float(m.cell_size)
    high = low + cell * np.array(wall.shape)
    image = axes.imshow(
        wall.T, origin="lower", extent=(low[0], high[0], low[1], high[1]), cmap="Greys", vmin=0.0, vmax=1.0
    )
    image.set_transform(place + axes.transData)
    x, y, heading = _placed(moment.poses, place, turn)
    u, v = PARTICLE_ARROW * np.cos(heading), PARTICLE_ARROW * np.sin(heading)
    colour = (np.degrees(heading) + 180.0) % 360.0 - 180.0
    axes.quiver(
        x, y, u, v, colour, cmap="hsv", clim=(-180.0, 180.0), angles="xy", scale_units="xy", scale=1.0, width=0.004,
        headwidth=3.5, headlength=4.0, headaxislength=3.5, alpha=0.55, rasterized=True,
    )  # fmt: skip
    x, y, heading = _placed(moment.true[None], place, turn)
    for colour_of, width in (("white", 3.4), (TRUE_COLOUR, 1.8)):
        axes.plot(x, y, "o", ms=11.0, mfc="none", mec=colour_of, mew=width, zorder=4)
    ahead = np.array([np.cos(heading[0]), np.sin(heading[0])])
    tail, tip = np.array([x[0], y[0]]) + 0.028 * ahead, np.array([x[0], y[0]]) + 0.1 * ahead
    style: dict[str, Any] = {"arrowstyle": "-|>", "color": TRUE_COLOUR, "lw": 1.6, "shrinkA": 0, "shrinkB": 0}
    style["path_effects"] = [withStroke(linewidth=3.2, foreground="white")]
    axes.annotate("", tuple(tip), tuple(tail), arrowprops=style, zorder=5)
    seen = place.transform(low + cell * (np.argwhere(m.observed) + 0.5))
    first, last = seen.min(axis=0) - 0.01, seen.max(axis=0) + 0.01
    axes.set(xlim=(first[0], last[0]), ylim=(first[1], last[1]), aspect="equal", xticks=[], yticks=[])
    after = {0: "before the first scan", 1: "after 1 scan"}.get(moment.scans, f"after {moment.scans} scans")
    places = "1 place" if spread.modes == 1 else f"{spread.modes} places"
    axes.set_title(f"{after}: {places}, {spread.entropy:.1f} nats", fontsize=9)


def _placed(poses: np.ndarray, place: Affine2D, turn: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x, y and heading in the picture."""
    x, y = place.transform(poses[:, :2]).T
    return x, y, poses[:, 2] + turn


def _curves(axes: Axes, spreads: Sequence[Spread], shown: Sequence[int]) -> None:
    scans = np.arange(len(spreads))
    for at in shown:
        axes.axvline(at, color="0.85", lw=0.8, zorder=0)
    axes.plot(scans, [s.at_truth for s in spreads], color=TRUE_COLOUR, lw=1.4, label="mass at the true pose")
    axes.plot(scans, [s.largest for s in spreads], color="0.55", lw=1.0, ls="--", label="mass of the heaviest place")
    axes.set(xlim=(0, scans[-1]), ylim=(0.0, 1.02), xlabel="scans")
    axes.set_ylabel("share of the mass", fontsize=8)
    other = axes.twinx()
    other.step(scans, [s.modes for s in spreads], where="mid", color="tab:purple", lw=1.1, label="places")
    other.plot(scans, [s.entropy for s in spreads], color="tab:orange", lw=1.1, label="entropy, nats")
    other.set_ylim(0.0, None)
    other.set_ylabel("places; nats", fontsize=8)
    for one in (axes, other):
        one.tick_params(labelsize=7)
    lines = [*axes.get_lines()[len(shown) :], *other.get_lines()]
    axes.legend(
        lines,
        [str(line.get_label()) for line in lines],
        fontsize=7,
        loc="lower center",
        bbox_to_anchor=(0.5, 1.0),
        ncols=4,
        frameon=False,
    )
