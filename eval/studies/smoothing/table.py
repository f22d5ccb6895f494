"""Arrange filter against smoother: a line a recording, one picture, one sentence."""

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from pydantic import Field

from vssm_gym.envs.validation import StrictModel
from vssm_gym.eval.studies.page import Study
from vssm_gym.slam.states import tidy
from vssm_gym.viz import pictures

HEADER = (
    "recording",
    "s",
    "m",
    "lost",
    "ATE, cm",
    "smoothed",
    "ratio",
    "NEES / dim",
    "smoothed",
    "depth L1, mm",
    "smoothed",
    "log p a pixel",
    "smoothed",
    "s to filter",
    "to smooth",
)
NOTES = (
    "ATE is the RMSE of positions after SE(3) alignment, lost frames included. NEES / dim is the mean over tracked "
    "frames of the pose's error by its stated covariance, with the first pose known; 1 where the covariance is right.",
    "Depth L1 and log-likelihood are means over pixels of images that neither filter nor smoother has seen, at their "
    "true poses, brought into the world of each map by the alignment of its own trajectory. Each map has the emission "
    "scales that fit it best on the images that it was made of.",
    "Seconds are wall-clock times on this machine, compilation included; the smoother's include the new map.",
)

Count = Annotated[int, Field(ge=0, lt=10**9)]
Size = Annotated[float, Field(ge=0.0, lt=1e30)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]


class Measured(StrictModel):
    """Hold the errors of poses, of their covariances and of the map, and the time that it took."""

    ate_m: Size
    max_m: Size
    rotation_deg: Size
    nees: Size
    inside: Share
    depth_l1: Size | None
    log_likelihood: float | None
    hit_share: Share | None
    seconds: Size


class StoredRow(StrictModel):
    """Hold a recording: its length (s, m), its frames, and what was measured of filter and smoother."""

    seconds: Size
    length_m: Size
    frames: Count
    lost: Count
    smoothed_frames: Count
    filter: Measured
    smoother: Measured


def study_of(rows: Mapping[str, Mapping[str, Any]], setting: Mapping[str, Any]) -> Study:
    """Return the study of the recordings measured so far, at least one."""
    return Study(
        name="smoothing",
        question="Is the smoother better than the filter?",
        answer=answer(rows),
        header=HEADER,
        lines=[line_of(name, row) for name, row in rows.items()],
        picture=_picture(rows),
        setting=dict(setting),
        figures={"rows": {name: dict(row) for name, row in rows.items()}},
        notes=NOTES,
    )


def ratio_of(row: Mapping[str, Any]) -> float:
    """Return the smoother's ATE over the filter's."""
    return row["smoother"]["ate_m"] / max(row["filter"]["ate_m"], 1e-9)


def line_of(name: str, row: Mapping[str, Any]) -> list[str]:
    """Return the line of a recording."""
    both = row["filter"], row["smoother"]
    pair = lambda field, scale, form: ["-" if one[field] is None else format(scale * one[field], form) for one in both]
    return [
        name,
        f"{row['seconds']:.0f}",
        f"{row['length_m']:.0f}",
        f"{row['lost']} of {row['frames']}",
        *pair("ate_m", 100.0, ".2f"),
        f"{ratio_of(row):.2f}",
        *pair("nees", 1.0, ".2f"),
        *pair("depth_l1", 1e3, ".1f"),
        *pair("log_likelihood", 1.0, ".3f"),
        *pair("seconds", 1.0, ".0f"),
    ]


def answer(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Say by how much trajectories, covariances and maps differ, walks, flights and recordings apart."""
    said = [f"{name}: {_answer_of(chosen)}" for name, chosen in kinds(rows).items()]
    took = [
        (row["filter"]["seconds"] + row["smoother"]["seconds"]) / max(row["seconds"], 1e-9) for row in rows.values()
    ]
    return f"{' '.join(said)} Both together take {np.median(took):.1f} times real time (median)."


def kinds(rows: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Mapping[str, Any]]]:
    """Return the rows of walks, flights and given recordings, those that there are."""
    found: dict[str, dict[str, Mapping[str, Any]]] = {"Walks": {}, "Flights": {}, "Recordings": {}}
    for name, row in rows.items():
        kind = {"walk": "Walks", "flight": "Flights"}.get(name.split(" ")[0], "Recordings")
        found[kind][name] = row
    return {kind: chosen for kind, chosen in found.items() if chosen}


def _answer_of(rows: Mapping[str, Mapping[str, Any]]) -> str:
    ratios = {name: ratio_of(row) for name, row in rows.items()}
    worst = max(ratios, key=lambda name: ratios[name])
    nees = np.mean([row["smoother"]["nees"] for row in rows.values()])
    said = (
        f"mean ratio of ATE, smoothed to filtered, {np.mean(list(ratios.values())):.2f} of {len(rows)}, largest "
        f"{ratios[worst]:.2f} ({worst}); mean NEES / dim of smoothed poses {nees:.2f}"
    )
    judged = [row for row in rows.values() if None not in (row["filter"]["depth_l1"], row["smoother"]["depth_l1"])]
    if not judged:
        return f"{said}."
    better = lambda field, sign: sum(sign * (row["smoother"][field] - row["filter"][field]) > 0.0 for row in judged)
    return (
        f"{said}; in held-out images depth is better in {better('depth_l1', -1.0)} and the log-likelihood in "
        f"{better('log_likelihood', 1.0)} of {len(judged)}."
    )


def _picture(rows: Mapping[str, Mapping[str, Any]]) -> bytes:
    """Draw both errors of every recording on one line, and NEES / dim of both, as SVG."""
    names = list(rows)[::-1]
    figure = Figure(figsize=(9.0, 1.2 + 0.26 * len(names)), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    heights = np.arange(len(names))
    for axes, field, scale in ((left, "ate_m", 100.0), (right, "nees", 1.0)):
        before, after = (np.array([scale * rows[name][who][field] for name in names]) for who in ("filter", "smoother"))
        axes.hlines(heights, before, after, color="0.75", linewidth=1.5)
        axes.plot(before, heights, "o", color="C7", markersize=5, label="filter")
        axes.plot(after, heights, "o", color="C0", markersize=5, label="smoother")
        axes.set(xscale="log", ylim=(-0.5, len(names) - 0.5))
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
        tidy(axes)
    left.set(yticks=heights, xlabel="ATE, cm")
    left.set_yticklabels([pictures.tick_name(name) for name in names], fontsize=8)
    right.axvline(1.0, color="0.3", linestyle="--", linewidth=1.0)
    right.set(xlabel="NEES / dim")
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2, fontsize=8, frameon=False)
    return pictures.svg(figure)
