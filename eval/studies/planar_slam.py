"""Run SLAM on a log of a laser scanner, beside path integration, and judge both by what the log knows."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vssm_gym.data.laser_logs import LaserLog
from vssm_gym.data.strip_logs import StripLog
from vssm_gym.data.traversals import errors
from vssm_gym.eval.studies.page import Study
from vssm_gym.eval.studies.scan_graph.run import run_scan_graph
from vssm_gym.geometry.planar_poses import relation
from vssm_gym.maps.latent_grid import LatentGrid
from vssm_gym.progress import OnProgress
from vssm_gym.slam.latent_run import LatentRun, run_latent
from vssm_gym.slam.planar_run import PlanarRun, loop_errors, run_scans
from vssm_gym.viz.pictures import svg

INTEGRATED, SLAM, GRAPH = "path integration", "PRISM in the plane", "scan matching, pose graph"
LATENT = "latent grid"
WORSE = 0.01  # m, beyond the error of path integration, from which the summary says so
LATENT_CELL = 6.25  # cells of the occupancy map, of the latent grid's: a chart holds what is around it
HEADER = ("method", "error at the end, m", "mean error, m", "loops: mean, m", "median, m", "turn, deg", "scans/s")
OF_THE_CHARTS = (
    "The latent grid's picture shows where its charts have surfaces: a point for each bearing of each chart that was "
    "observed, darker where the chart knows more."
)
OF_THE_GRAPH = (
    "The pose graph's path is that after its last optimisation: unlike the filter's, its poses know later scans."
)


def run(
    name: str,
    log: LaserLog,
    cell_size: float,
    max_range: float | None = None,
    on_progress: OnProgress | None = None,
    baseline: bool = False,
    latent_passes: int | None = None,
    seed: int = 0,
    drive: dict[str, Any] | None = None,
) -> tuple[Study, PlanarRun, LatentRun | None]:
    """Track and map a log, and compare with its odometry alone, a latent grid, and scan matching with a pose graph.

    Args:
        name: of the log, for the page.
        log: scans and odometry; its poses and loops are read for the judgement alone.
        cell_size: of the map, m.
        max_range: m; farther readings are left out; None: those of the log.
        on_progress: called after every hundred scans.
        baseline: whether to run the pose graph too.
        latent_passes: off-line passes of the latent grid after its on-line one; None: it is not run.
        seed: of its particles.
        drive: what the log was made or taken from; only stored.

    Returns:
        The outcome for a page, the run itself, and that of the latent grid.

    Raises:
        InputError: as :func:`run_scans` does, or GTSAM, which the baseline needs, is not installed.
    """
    classical = run_scan_graph(log, cell_size, max_range, on_progress) if baseline else None  # it may be missing
    found = run_scans(log, cell_size, max_range, on_progress=on_progress)
    estimates = {INTEGRATED: log.path(), SLAM: found.poses}
    latent = None
    if latent_passes is not None:
        latent = run_latent(log, LATENT_CELL * cell_size, max_range, latent_passes, seed=seed, on_progress=on_progress)
        estimates[LATENT] = latent.poses
    if classical:
        estimates[GRAPH] = classical.poses
    figures: dict[str, dict[str, Any]] = {method: judged(log, poses) for method, poses in estimates.items()}
    if classical:
        figures[GRAPH] |= {"scans_per_second": len(log) / classical.seconds, "loops_closed": classical.loops}
    if latent:
        speed = len(log) * len(latent.log_evidence) / latent.seconds
        figures[LATENT] |= {"scans_per_second": speed, "log_evidence": latent.log_evidence}
    figures[SLAM] |= {"scans_per_second": len(log) / found.seconds, "used": float(found.used[1:].mean())}
    study = Study(
        name="slam2d",
        question=f"Where was the robot, and what is there? {name}",
        answer=_answer(figures, len(log)),
        header=HEADER,
        lines=[row_of(method, figures[method]) for method in estimates],
        picture=_picture(log, found, latent, estimates),
        setting={
            "log": name,
            "scans": len(log),
            "cell_size": cell_size,
            "max_range": max_range,
            "latent_passes": latent_passes,
            "latent_cell": None if latent is None else LATENT_CELL * cell_size,
            "seed": seed,
            **(drive or {}),
        },
        figures=figures,
        notes=(
            "The method reads scans and odometry. Errors are distances from the poses of the log, both seen from the "
            "first; in a simulation those are the true ones, in a recording what others have found. Loops are pairs "
            "of scans whose relation the log knows: the difference of the estimated relation from it.",
            *([OF_THE_GRAPH] if classical else []),
            *([OF_THE_CHARTS] if latent else []),
        ),
    )
    return study, found, latent


def judged(log: LaserLog | StripLog, poses: np.ndarray) -> dict[str, Any]:
    """Return the errors of poses, m: at the end, in the mean, and over loops; None where the log does not know."""
    figures: dict[str, Any] = {"end": None, "mean": None, "loops": None}
    if log.poses is not None:
        off = errors(log, poses)
        figures |= {"end": float(off[-1]), "mean": float(off.mean())}
    if isinstance(log, LaserLog) and len(log.loops):
        apart, turn = loop_errors(log, poses).T
        figures["loops"] = {
            "number": len(apart),
            "mean": float(apart.mean()),
            "median": float(np.median(apart)),
            "turn": float(np.degrees(turn.mean())),
        }
    return figures


def row_of(method: str, figures: dict[str, Any]) -> list[str]:
    """Return the row of a method under :data:`HEADER`."""
    cell = lambda value, digits=3: "" if value is None else f"{value:.{digits}f}"
    loops = figures["loops"] or {}
    of_loops = [cell(loops.get("mean")), cell(loops.get("median")), cell(loops.get("turn"), 2)]
    return [method, cell(figures["end"]), cell(figures["mean"]), *of_loops, cell(figures.get("scans_per_second"), 0)]


def _answer(figures: dict[str, dict[str, Any]], scans: int) -> str:
    ours, integrated = figures[SLAM], figures[INTEGRATED]
    said = [f"{scans:,} scans at {ours['scans_per_second']:.0f} a second; {ours['used']:.0%} of the readings fit."]
    if ours["loops"]:
        said.append(
            f"Over {ours['loops']['number']:,} loops it is off by {ours['loops']['mean']:.3f} m, "
            f"path integration by {integrated['loops']['mean']:.3f} m."
        )
    elif ours["end"] is not None:
        said.append(f"At the end it is off by {ours['end']:.4f} m, path integration by {integrated['end']:.3f} m.")
    off = {method: value for method, of in figures.items() if (value := _summary(of)) is not None}
    said += [f"The {method} is off by {off[method]:.4f} m." for method in (LATENT, GRAPH) if method in off]
    if off.get(SLAM, 0.0) > off.get(INTEGRATED, 0.0) + WORSE:
        said.append("It is worse than path integration: smaller cells (--cell) may be needed.")
    return " ".join(said)


def _summary(figures: dict[str, Any]) -> float | None:
    """Return the mean error over the loops, else the error at the end, m."""
    return figures["loops"]["mean"] if figures["loops"] else figures["end"]


def _picture(log: LaserLog, found: PlanarRun, latent: LatentRun | None, estimates: dict[str, np.ndarray]) -> bytes:
    """Draw the map, all paths and that of the log, and beside them the decoded latent map."""
    figure = Figure(figsize=(14.0 if latent else 7.0, 7.0), layout="constrained")
    panels = figure.subplots(1, 2 if latent else 1, squeeze=False)[0]
    axes, m = panels[0], found.m
    occupied = np.where(m.observed, np.where(np.asarray(m.occupancy) > 0.0, 1.0, 0.15), 0.5)
    low, cell = np.asarray(m.origin), float(m.cell_size)
    left, bottom = low - 0.5 * cell  # cells are centred
    right, top = low + cell * (np.array(occupied.shape) - 0.5)
    axes.imshow(occupied.T, origin="lower", extent=(left, right, bottom, top), cmap="Greys", vmin=0.0, vmax=1.0)
    axes.plot(*estimates[INTEGRATED][:, :2].T, color="tab:orange", lw=0.8, label=INTEGRATED)
    if log.poses is not None:
        axes.plot(*relation(log.poses[:1], log.poses)[:, :2].T, color="tab:green", lw=1.6, label="the log's own poses")
    if GRAPH in estimates:
        axes.plot(*estimates[GRAPH][:, :2].T, color="tab:red", lw=0.8, label=GRAPH)
    axes.plot(*found.poses[:, :2].T, color="tab:blue", lw=0.8, label=SLAM)
    if latent:
        _draw_charts(panels[1], latent.model.m, log.max_range)
        panels[1].plot(*latent.poses[:, :2].T, color="tab:purple", lw=0.8, label=LATENT)
    seen = np.argwhere(m.observed)
    first, last = low + cell * seen.min(axis=0), low + cell * seen.max(axis=0)
    for axes in panels:
        axes.set(xlim=(first[0], last[0]), ylim=(first[1], last[1]), xlabel="x, m", ylabel="y, m", aspect="equal")
        axes.legend(loc="upper left", fontsize=8)
    return svg(figure)


def _draw_charts(axes: Axes, m: LatentGrid, max_range: float) -> None:
    """Draw a point where each observed chart has a surface, darker where it knows more."""
    known = m.observed
    chart, spread = np.asarray(m.chart)[known], np.asarray(m.spread)[known]
    bearing = 2.0 * np.pi * np.arange(chart.shape[-1]) / chart.shape[-1]
    ends = np.asarray(m.centres())[known][:, None] + chart[..., None] * np.stack([np.cos(bearing), np.sin(bearing)], -1)
    share = np.clip(1.0 - spread / np.asarray(m.decoder.prior_std), 0.0, 1.0) * (chart < max_range)
    x, y = ends.reshape(-1, 2).T
    axes.scatter(x, y, s=1.0, c="black", alpha=0.3 * share.ravel(), linewidths=0.0, rasterized=True)
