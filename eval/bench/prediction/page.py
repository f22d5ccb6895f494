"""Arrange the rows as a table, a figure of the PIT histograms, and one self-contained page."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from vssm_gym.eval.bench.prediction.rows import PIT_RANGE
from vssm_gym.files.atomic import atomic_write
from vssm_gym.slam.states import tidy
from vssm_gym.viz import pictures
from vssm_gym.viz.html import Table, render, svg_image

QUESTION = "How good are predicted images and poses?"
HEADER = (
    "model",
    "ahead, s",
    "nats a pixel",
    "depth",
    "colour",
    "CRPS depth, cm",
    "CRPS colour",
    "depth in 95 %",
    "PIT holds for",
    "pose, nats",
    "CRPS location, cm",
    "CRPS heading, deg",
)
PAGE_ONLY = ("depth", "colour", "pose, nats", "CRPS location, cm", "CRPS heading, deg")
WHOLE = ("model", "nats a pixel", "PIT holds for")  # columns that are not wrapped
PIT_NAMES = {"depth": "depth", "rgb": "colour", "pose": "pose"}
NOTES = (
    "Each model follows a drive up to some time, is given the commands of the next seconds, and states the "
    "distribution of each pixel and of the pose at their end. Every fourth row and column of the image is scored.",
    "Nats a pixel: mean log density over all pixels, with the 95 % bootstrap interval over drives; the sum of its "
    "parts. A pixel has no reading, or a depth (density in 1/m) and a colour (over [0, 1]^3). Higher is better.",
    "CRPS: the integral of (F(y) - [y >= x])^2, in the unit of the value, of pixels with a reading; lower is better.",
    "PIT: F(x), uniform where the prediction is calibrated. It holds for depth, colour or the pose where every bin, "
    f"of 20 for depth and colour and of 5 for the pose, holds {PIT_RANGE[0]:g} to {PIT_RANGE[1]:g} times the uniform "
    "share. "
    "The pixels of an image are correlated: few drives give uneven histograms even where a prediction is calibrated.",
)


def line_of(row: Mapping[str, Any]) -> list[str]:
    """Return the cells of a row, in the order of :data:`HEADER`."""
    nats, calibrated = row["nats"], row["calibrated"]
    bounds = "" if nats["low"] is None else f" [{nats['low']:.2f}, {nats['high']:.2f}]"
    return [
        row["model"],
        f"{row['seconds']:g}",
        f"{nats['mean']:.2f}{bounds}",
        f"{row['depth_nats']:.2f}",
        f"{row['rgb_nats']:.2f}",
        f"{100 * row['depth_crps']:.1f}",
        f"{row['rgb_crps']:.3f}",
        f"{row['depth_in_band']:.1%}",
        ", ".join(label for name, label in PIT_NAMES.items() if calibrated[name]) or "none",
        f"{row['pose_nats']:.2f}",
        f"{100 * row['location_crps']:.1f}",
        f"{np.degrees(row['heading_crps']):.1f}",
    ]


def shown(result: Mapping[str, Any]) -> Sequence[int]:
    """Return the columns that a terminal has room for."""
    return [index for index, name in enumerate(HEADER) if name not in PAGE_ONLY]


def answer(result: Mapping[str, Any]) -> str:
    """Name the best model of each horizon, and say where its distribution of depth is calibrated."""
    said, rows = [], result["rows"]
    for seconds in sorted({row["seconds"] for row in rows}):
        best = max((row for row in rows if row["seconds"] == seconds), key=lambda row: row["nats"]["mean"])
        held = [PIT_NAMES[name] for name, holds in best["calibrated"].items() if holds]
        said.append(
            f"{seconds:g} s ahead {best['model']} is best with {best['nats']['mean']:.2f} nats a pixel; "
            f"{best['depth_in_band']:.1%} of its depths lie in the 95 % band, and the PIT band holds for "
            f"{' and '.join(held) if held else 'none of depth, colour and pose'}."
        )
    return " ".join(said)


def write_page(result: Mapping[str, Any], stem: Path, version: str) -> Path:
    """Write ``STEM.svg`` and ``STEM.html``; return the page."""
    picture = _picture(result["rows"])
    measured = {name: result[name] for name in ("setting", "fitted", "machine")} | {"version": version}
    page = render(
        "prediction.html.j2",
        question=QUESTION,
        answer=answer(result),
        picture=svg_image(picture),
        table=Table(HEADER, [line_of(row) for row in result["rows"]], 1),
        notes=NOTES,
        measured=measured,
    )
    for suffix, content in (("svg", picture), ("html", page.encode())):
        with atomic_write(stem.with_suffix(f".{suffix}")) as temporary:
            temporary.write_bytes(content)
    return stem.with_suffix(".html")


def _picture(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """Draw the PIT histograms: a line of axes for each model, one curve for each horizon, as SVG."""
    names = list(dict.fromkeys(row["model"] for row in rows))
    figure = Figure(figsize=(10.0, 0.8 + 1.7 * len(names)), layout="constrained")
    axes = figure.subplots(len(names), len(PIT_NAMES), squeeze=False, sharex=True)
    colours = (pictures.ESTIMATE_COLOUR, pictures.TRUE_COLOUR)
    for label, ax in zip(PIT_NAMES.values(), axes[0], strict=True):
        ax.set_title(f"PIT of {label}", fontsize=10)
    for ax in axes[-1]:
        ax.set_xlabel("F(x)")
    for line, name in zip(axes, names, strict=True):
        for ax, key in zip(line, PIT_NAMES, strict=True):
            ax.axhspan(*PIT_RANGE, color="0.92")
            ax.axhline(1.0, color="0.3", linestyle="--", linewidth=0.8)
            for colour, row in zip(colours, (row for row in rows if row["model"] == name), strict=False):
                shares = row["pit"][key]
                ax.stairs(shares, np.linspace(0, 1, len(shares) + 1), color=colour, label=f"{row['seconds']:g} s")
            ax.set(ylim=(0, 3), xlim=(0, 1))
            tidy(ax)
        line[0].set_ylabel(pictures.tick_name(name), fontsize=8)
    axes[0][0].legend(fontsize=8, frameon=False)
    return pictures.svg(figure)
