"""Arrange errors of surfaces against their stated std: bins, lines, one picture, one sentence."""

from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
from matplotlib.figure import Figure
from pydantic import Field

from vssm_gym.envs.validation import StrictModel
from vssm_gym.eval.studies.map_reliability.surface_errors import LARGEST_ERROR, SurfaceErrors
from vssm_gym.eval.studies.page import Study
from vssm_gym.slam.states import NORMAL_95, tidy
from vssm_gym.viz import pictures

EDGES_MM = (0, 2, 4, 8, 16, 32, 64, 1000)  # of the bins of the stated std
FEWEST_POINTS = 200  # of a bin that is shown: a share of 95 % is known to 3 points from as many independent ones
HEADER = ("maps", "stated, mm", "points", "stated rms, mm", "error rms, mm", "error / stated", "inside 95 %")
NOTES = (
    "A map is learned from a drive through each apartment, at its true poses or at those that PRISM estimates from "
    "images and commands. Error: the true signed distance to the nearest surface of the scene at points drawn "
    f"uniformly over the map's surface, no more than {LARGEST_ERROR:g} m. Stated: the std of the surface's place along "
    "its normal. With estimated poses it holds the drift that the filter states at up to 64 frames, its "
    "start known.",
    "Error / stated is 1 where the std is right, above 1 where it is too small; in brackets the least and the largest "
    "over the maps. Points of one map are not independent: errors of a wall are alike, and with estimated poses those "
    "of whole rooms. Inside 95 %: the share of points whose error is below 1.96 stds.",
)

Count = Annotated[int, Field(ge=0, lt=10**9)]
Size = Annotated[float, Field(ge=0.0, lt=1e30)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]


class Agreement(StrictModel):
    """Hold rms error and rms stated std (m) of some points, and the share inside the 95 % interval."""

    points: Count
    error_m: Size
    std_m: Size
    inside: Share


class Bin(Agreement):
    """Hold the agreement of points whose stated std lies in an interval, m."""

    low_m: Size
    high_m: Size


class StoredRow(StrictModel):
    """Hold a row: all points, those of each map, and those of each bin that has any."""

    whole: Agreement
    maps: dict[str, Agreement]
    bins: tuple[Bin, ...]


def summarise(measured: Mapping[str, SurfaceErrors]) -> dict[str, Any]:
    """Return the row of some maps, in the form of :class:`StoredRow`."""
    error = np.concatenate([one.error for one in measured.values()])
    std = np.concatenate([one.std for one in measured.values()])
    bins = []
    for low, high in pairwise(EDGES_MM):
        inside = (std >= 1e-3 * low) & (std < 1e-3 * high)
        if inside.any():
            bins.append(agreement(error[inside], std[inside]) | {"low_m": 1e-3 * low, "high_m": 1e-3 * high})
    return {
        "whole": agreement(error, std),
        "maps": {name: agreement(one.error, one.std) for name, one in measured.items()},
        "bins": bins,
    }


def agreement(error: np.ndarray, std: np.ndarray) -> dict[str, Any]:
    """Return the fields of :class:`Agreement`."""
    rms = lambda a: float(np.sqrt(np.mean(a**2)))
    inside = float(np.mean(np.abs(error) <= NORMAL_95 * std))
    return {"points": len(error), "error_m": rms(error), "std_m": rms(std), "inside": inside}


def study_of(rows: Mapping[str, Mapping[str, Any]], setting: Mapping[str, Any]) -> Study:
    """Return the study of the rows measured so far, at least one."""
    return Study(
        name="map-reliability",
        question="How right is the uncertainty of a map's surface?",
        answer=_answer(rows),
        header=HEADER,
        lines=[line for name, row in rows.items() for line in lines_of(name, row)],
        picture=_picture(rows),
        setting=dict(setting),
        figures={"rows": {name: dict(row) for name, row in rows.items()}},
        notes=NOTES,
    )


def lines_of(name: str, row: Mapping[str, Any]) -> list[list[str]]:
    """Return the lines of a row: one for all points, then one a bin."""
    ratios = [one["error_m"] / one["std_m"] for one in row["maps"].values()]
    spread = f" [{min(ratios):.2f}, {max(ratios):.2f}]"
    lines = [[f"{name}: {len(ratios)}", "all", *_cells(row["whole"], spread)]]
    shown = [one for one in row["bins"] if one["points"] >= FEWEST_POINTS]
    lines += [["", f"{1e3 * one['low_m']:.0f} to {1e3 * one['high_m']:.0f}", *_cells(one)] for one in shown]
    return lines


def _cells(found: Mapping[str, Any], spread: str = "") -> list[str]:
    stated, error = 1e3 * found["std_m"], 1e3 * found["error_m"]
    return [
        str(found["points"]),
        f"{stated:.1f}",
        f"{error:.1f}",
        f"{error / stated:.2f}{spread}",
        f"{found['inside']:.1%}",
    ]


def _answer(rows: Mapping[str, Mapping[str, Any]]) -> str:
    said = [
        f"{name} {row['whole']['error_m'] / row['whole']['std_m']:.2f} ({row['whole']['inside']:.0%} inside 95 %)"
        for name, row in rows.items()
    ]
    return f"The rms error of a surface over its stated std, 1 if right: {', '.join(said)}."


def _picture(rows: Mapping[str, Mapping[str, Any]]) -> bytes:
    """Draw error against stated std, and the share inside 95 %, of the bins of every row, as SVG."""
    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for name, row in rows.items():
        shown = [one for one in row["bins"] if one["points"] >= FEWEST_POINTS]
        stated = [1e3 * one["std_m"] for one in shown]
        left.plot(stated, [1e3 * one["error_m"] for one in shown], "o-", label=name, markersize=4)
        right.plot(stated, [100 * one["inside"] for one in shown], "o-", markersize=4)
    low, high = left.get_xlim()
    ends = [max(low, 0.5), high]
    left.plot(ends, ends, color="0.3", linestyle="--", linewidth=1.0)
    left.set(xscale="log", yscale="log", xlabel="stated std, mm", ylabel="rms error, mm")
    right.axhline(95.0, color="0.3", linestyle="--", linewidth=1.0)
    right.set(xscale="log", ylim=(50, 101), xlabel="stated std, mm", ylabel="% of points inside 95 %")
    left.legend(fontsize=8, frameon=False)
    for axes in (left, right):
        tidy(axes)
    return pictures.svg(figure)
