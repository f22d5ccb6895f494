"""Run SLAM with a latent grid on the strip images of a drive, beside path integration, and judge both."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vssm_gym.data.strip_logs import StripLog
from vssm_gym.eval.studies.page import Study
from vssm_gym.eval.studies.planar_slam import HEADER, INTEGRATED, LATENT, judged, row_of
from vssm_gym.geometry.planar_poses import relation
from vssm_gym.maps.latent_grid import LatentGrid
from vssm_gym.model.latent_strips import COLOURS
from vssm_gym.progress import OnProgress
from vssm_gym.slam.latent_run import LatentRun, run_strips
from vssm_gym.viz.pictures import svg

STRIP_CELL = 10.0  # cells of an occupancy map, of the grid's: a colour changes slowly from place to place
RING = 0.38  # radius of a drawn chart, cells


def run(
    name: str,
    log: StripLog,
    cell_size: float,
    passes: int,
    seed: int = 0,
    drive: dict[str, Any] | None = None,
    on_progress: OnProgress | None = None,
) -> tuple[Study, LatentRun]:
    """Track a drive by its strips and learn their charts.

    Args:
        name: of the drive, for the page.
        log: strips and odometry; its poses are read for the judgement alone.
        cell_size: of an occupancy map of the place, m; the latent grid's cells are :data:`STRIP_CELL` times as large.
        passes: off-line passes after the on-line one.
        seed: of the particles.
        drive: what the log was made from; only stored.
        on_progress: called after every hundred strips.

    Raises:
        InputError: as :func:`run_strips` does.
    """
    found = run_strips(log, STRIP_CELL * cell_size, passes, seed=seed, on_progress=on_progress)
    estimates = {INTEGRATED: log.path(), LATENT: found.poses}
    figures = {method: judged(log, poses) for method, poses in estimates.items()}
    speed = len(log) * len(found.log_evidence) / found.seconds
    figures[LATENT] |= {"scans_per_second": speed, "log_evidence": found.log_evidence}
    said = f"{len(log):,} strips at {speed:.0f} a second."
    if log.poses is not None:
        off, integrated = figures[LATENT]["end"], figures[INTEGRATED]["end"]
        said += f" At the end it is off by {off:.4f} m, path integration by {integrated:.3f} m."
    study = Study(
        name="slam2d",
        question=f"Where was the robot, and what is there? {name}, seen by a camera",
        answer=said,
        header=HEADER,
        lines=[row_of(method, figures[method]) for method in estimates],
        picture=_picture(log, found),
        setting={"log": name, "scans": len(log), "latent_cell": STRIP_CELL * cell_size, "latent_passes": passes}
        | {"seed": seed}
        | (drive or {}),
        figures=figures,
        notes=(
            "The method reads strips of pixels and odometry, no range. Errors are distances from the true poses, both "
            "seen from the first. Each ring is a chart: the colours around its cell, on the side where they are seen.",
        ),
    )
    return study, found


def _picture(log: StripLog, found: LatentRun) -> bytes:
    """Draw all paths, and beside them the decoded latent map."""
    figure = Figure(figsize=(14.0, 7.0), layout="constrained")
    panels = figure.subplots(1, 2)
    paths = [(INTEGRATED, log.path(), "tab:orange", 0.8)]
    if log.poses is not None:
        paths.append(("true poses", relation(log.poses[:1], log.poses), "tab:green", 1.6))
    paths.append((LATENT, found.poses, "tab:purple", 0.8))
    for label, poses, colour, width in paths:
        panels[0].plot(*poses[:, :2].T, color=colour, lw=width, label=label)
    panels[0].legend(loc="upper left", fontsize=8)
    _draw_colours(panels[1], found.model.m)
    for axes in panels:
        axes.set(xlabel="x, m", ylabel="y, m", aspect="equal")
    return svg(figure)


def _draw_colours(axes: Axes, m: LatentGrid) -> None:
    """Draw each observed chart as a ring of its colours."""
    known = m.observed
    charts = np.asarray(m.chart)[known]
    colours = np.clip(charts.reshape(len(charts), COLOURS, -1).transpose(0, 2, 1), 0.0, 1.0)
    columns = colours.shape[1]
    bearing = 2.0 * np.pi * np.arange(columns) / columns
    ring = RING * float(m.cell_size) * np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    points = np.asarray(m.centres())[known][:, None] + ring
    x, y = points.reshape(-1, 2).T
    axes.scatter(x, y, s=6.0, c=colours.reshape(-1, COLOURS), linewidths=0.0, rasterized=True)
