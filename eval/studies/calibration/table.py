"""Arrange the rows of the table as a study: lines, one picture, one sentence, and how everything was measured."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vssm_gym.eval.metrics.pose_calibration import REGION
from vssm_gym.eval.studies.page import Study
from vssm_gym.slam.states import tidy
from vssm_gym.viz import pictures

HEADER = (
    "row",
    "runs",
    "frames",
    "lost",
    "NEES / dim",
    "inside 95 %",
    "segments",
    "error, cm",
    "stated, cm",
    "v inside 95 %",
    "ω inside 95 %",
)
ENOUGH_SEGMENTS = 40  # segments from which on the share inside the region is known to about 7 points
NOTES = (
    "NEES / dim: e^T Sigma^-1 e over the dimension of the pose (3 on the floor, 6 in space), averaged over the tracked "
    "frames of a run after the first, then over runs; 1 where the covariances are right, above 1 where they are too "
    "small. In brackets the 95 % bootstrap interval over runs: frames of one run are correlated, runs are not.",
    "Inside 95 %: the share of poses inside their 95 % region, counted over segments with the interval of Clopper "
    "and Pearson. A run is cut into consecutive segments of 4 s (walks, recordings), 5 s (robots) or 3 s (cars) "
    "that share no image and no command; a flight has one, its first 5 s, because the IMU is calibrated at rest, "
    "and its curve is begun three more times at other speeds. The filter starts anew at the first frame of each, "
    "where it is given the true pose (and, if it learns a map, an empty one), and only the residual at the "
    "segment's last frame is counted. Noise is drawn anew for every image and step, so that these residuals are "
    "independent given the scene; segments in a learned map share its errors, those of a curve that is flown its "
    "start, those of one drive of a car its gain and trim, and the exposure of a Kinect changes over 3 s. "
    "Segments that end lost are left out; the figures hold their number.",
    "Error: RMSE of the location over all tracked frames of all runs, the first pose known. Stated: the root of the "
    "mean variance of the location that the filter states at the same frames. Velocity: the share of components inside "
    "their 95 % band, linear (v) and angular (ω), of states that hold one.",
    "Filters are built by the functions that their agents and commands call, with default options; no factor is "
    "fitted. Robots know their noise level. A drive that meets an obstacle is dropped and drawn anew; in the row with "
    "contacts, one that meets none is.",
)


def study_of(rows: Mapping[str, Mapping[str, Any]], setting: Mapping[str, Any], notices: tuple[str, ...]) -> Study:
    """Return the study of the rows measured so far.

    Args:
        rows: label of each row to its summary (see :func:`errors.summarise`), at least one.
        setting: what is needed to repeat the study.
        notices: problems of recordings.
    """
    described = [f"{name}: {row['about']}" for name, row in rows.items()]
    return Study(
        name="calibration",
        question="Are the covariances of the filters right?",
        answer=_answer(rows),
        header=HEADER,
        lines=[line_of(name, row) for name, row in rows.items()],
        picture=_picture(rows),
        setting=dict(setting),
        figures={"rows": {name: dict(row) for name, row in rows.items()}, "notices": list(notices)},
        notes=(*NOTES, f"Rows: {'; '.join(described)}.", *notices),
    )


def line_of(name: str, row: Mapping[str, Any]) -> list[str]:
    """Return the cells of a row, in the order of :data:`HEADER`."""
    segments, velocity = row["segments"], row["velocity"] or {}
    counted = f"{segments['count']}" + f" ({segments['ended_lost']} lost)" * bool(segments["ended_lost"])
    return [
        name,
        str(row["runs"]),
        str(row["frames"]),
        str(row["lost"]),
        _nees(row["nees"]),
        _share(segments),
        counted,
        _centimetres(row["error_m"]),
        _centimetres(row["std_m"]),
        _percent(velocity.get("linear")),
        _percent(velocity.get("angular")),
    ]


def _nees(interval: Mapping[str, Any]) -> str:
    if interval["mean"] is None:
        return "-"
    bounds = "" if interval["low"] is None else f" [{_short(interval['low'])}, {_short(interval['high'])}]"
    return _short(interval["mean"]) + bounds


def _share(segments: Mapping[str, Any]) -> str:
    if segments["share"] is None:
        return "-"
    return f"{segments['share']:.0%} [{100 * segments['low']:.0f}, {100 * segments['high']:.0f}]"


def _short(value: float) -> str:
    """Format with two decimals below 100, and with none above: a NEES can be a thousand."""
    return f"{value:.2f}" if value < 100.0 else f"{value:,.0f}"


def _centimetres(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.2f}"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.0%}"


def _answer(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Name the rows whose interval of NEES / dim lies on one side of 1, and those whose interval holds it."""
    sides: dict[str, list[str]] = {"too small": [], "too large": [], "not shown to be wrong": []}
    for name, row in rows.items():
        interval = row["nees"]
        if interval["low"] is None:
            continue
        side = "too small" if interval["low"] > 1 else "too large" if interval["high"] < 1 else "not shown to be wrong"
        sides[side].append(f"{name} ({_short(interval['mean'])})")
    said = [f"{side}: {', '.join(names)}" for side, names in sides.items() if names]
    head = "NEES / dim is 1 where covariances are right. "
    judged = f"By its 95 % interval over runs they are {'; '.join(said)}." if said else "A single run has no interval."
    of_truth = [f" {name}: {row['about']}." for name, row in rows.items() if "nuisances" in row]
    return head + judged + "".join(of_truth)


def _picture(rows: Mapping[str, Mapping[str, Any]]) -> bytes:
    """Draw NEES / dim, the share inside the region, and error against stated deviation of every row, as SVG."""
    figure = Figure(figsize=(11.5, 1.3 + 0.3 * len(rows)), layout="constrained")
    left, middle, right = figure.subplots(1, 3, sharey=True)
    places = np.arange(len(rows))
    for place, row in enumerate(rows.values()):
        nees, segments = row["nees"], row["segments"]
        left.plot(nees["values"], [place] * len(nees["values"]), "|", color="0.65", markersize=7)
        _interval(left, place, nees["mean"], nees["low"], nees["high"])
        faint = 1.0 if segments["count"] >= ENOUGH_SEGMENTS else 0.45
        if segments["share"] is not None:
            share, low, high = (100 * segments[key] for key in ("share", "low", "high"))
            _interval(middle, place, share, low, high, faint)
        for key, colour, marker in (("error_m", pictures.ESTIMATE_COLOUR, "o"), ("std_m", pictures.TRUE_COLOUR, "s")):
            if row[key] is not None:
                right.plot(100 * row[key], place, marker, color=colour, markersize=5)
    left.axvline(1.0, color="0.3", linestyle="--", linewidth=1.0)
    left.set(xscale="log", xlabel="NEES / dim; ticks: runs")
    middle.axvline(100 * REGION, color="0.3", linestyle="--", linewidth=1.0)
    middle.set(xlim=(0, 102), xlabel=f"% of segments inside 95 %; faint: fewer than {ENOUGH_SEGMENTS}")
    right.set(xscale="log", xlabel="location, cm: error (round), stated (square)")
    left.set_yticks(places, [pictures.tick_name(name) for name in rows], fontsize=8)
    left.set_ylim(len(rows) - 0.5, -0.5)
    for axes in (left, middle, right):
        tidy(axes)
    return pictures.svg(figure)


def _interval(
    axes: Axes, place: float, value: float | None, low: float | None, high: float | None, alpha: float = 1.0
) -> None:
    if value is None:
        return
    if low is not None and high is not None:
        axes.plot([low, high], [place, place], color=pictures.ESTIMATE_COLOUR, linewidth=2.0, alpha=alpha)
    axes.plot(value, place, "o", color=pictures.ESTIMATE_COLOUR, markersize=5, alpha=alpha)
