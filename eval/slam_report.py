"""The page of a SLAM run: what was lost, trajectory and errors, rendered against observed, map, fit, latency."""

import json
from html import escape
from typing import Any

import numpy as np

from vssm_gym.data.sequences import Sequence
from vssm_gym.eval import slam_figures as figures
from vssm_gym.eval.report import STYLE
from vssm_gym.eval.report_tables import html_table
from vssm_gym.eval.slam_run import SlamRun
from vssm_gym.inference.slam import STATUS, SlamConfig
from vssm_gym.viz import pictures
from vssm_gym.viz.mesh import Mesh

ERRORS = (
    ("ATE position", "m", "ate_translation_se3"),
    ("ATE rotation", "deg", "ate_rotation_se3"),
    ("RPE position, 1 frame", "m", "rpe_translation_1"),
    ("RPE rotation, 1 frame", "deg", "rpe_rotation_1"),
    ("RPE position, 30 frames", "m", "rpe_translation_30"),
    ("RPE rotation, 30 frames", "deg", "rpe_rotation_30"),
)
STATISTICS = ("rmse", "mean", "median", "max")
LISTED = 200  # lost frames


def page(run: SlamRun, sequence: Sequence, mesh: Mesh, stats: dict[str, Any], config: SlamConfig) -> str:
    """One HTML page that needs no other file and no network.

    Args:
        run: the run.
        sequence: what it ran on.
        mesh: surface of its map.
        stats: as :func:`vssm_gym.eval.slam_output.summarise` makes them.
        config: of the loss test.
    """
    display = figures.Display.of(run, sequence)
    view_picture, view_numbers = figures.views(run)
    name = escape(stats["sequence"])
    sections = [
        _header(stats),
        _lost(run),
        "<h2>Trajectory</h2>",
        f"<p class=note>Drawn in {escape(display.note)}.</p>",
        _image(figures.path(run, display), "image/svg+xml", "trajectory from above and from the side"),
        _errors(stats["errors"]),
        "<h2>Rendered against observed</h2>",
        "<p class=note>The final map's mean, rendered at the estimated poses; grey: never observed or no reading. The "
        "map was built from these images among others, so this shows consistency, not prediction.</p>",
        _image(view_picture, "image/webp", "observed and rendered images"),
        _view_table(view_numbers),
        "<h2>Map</h2>",
        _map_note(run, mesh),
        _image(figures.slices(run, display), "image/webp", "slices of mean and std of occupancy"),
        "<h2>Fit</h2>",
        "<p class=note>What the loss test looks at, and its limits (dashed). The score is the share of pixels that "
        "agree with the model's geometry, times min(1, coverage / 0.4).</p>",
        _image(figures.fit(run, config), "image/svg+xml", "fit over time"),
        "<h2>Latency</h2>",
        f"<p class=note>{escape(stats['latency_note'])}. The first calls took "
        f"{', '.join(f'{s:.1f}' for s in stats['first_calls_s'])} s. All wall-clock, on {stats['machine']['cores']} "
        f"cores with whatever else ran there; jax {escape(stats['machine']['jax'])}.</p>",
        _latency_table(stats["latency_ms"]),
        _image(figures.latency(run), "image/svg+xml", "latency"),
        f"<details><summary>configuration</summary><pre>{_setting(stats)}</pre></details>",
    ]
    return (
        f"<!doctype html><html lang=en><head><meta charset=utf-8><title>vssm-gym slam: {name}</title>"
        f"<meta name=viewport content='width=device-width'><style>{STYLE}</style></head>"
        f"<body>{''.join(sections)}</body></html>\n"
    )


def _image(content: bytes, kind: str, alt: str) -> str:
    return f"<img src='{pictures.data_url(content, kind)}' alt='{escape(alt)}'>"


def _setting(stats: dict[str, Any]) -> str:
    names = ("version", "machine", "sequence", "config", "camera")
    return escape(json.dumps({name: stats[name] for name in names}, indent=1))


def _map_note(run: SlamRun, mesh: Mesh) -> str:
    return (
        f"<p class=note>{' x '.join(map(str, run.map.shape))} cells of {float(run.map.voxel_size):g} m; the surface "
        f"(<code>mesh.ply</code>) has {len(mesh.vertices):,} vertices and {len(mesh.faces):,} triangles. Slices where "
        "most space is free, the camera's path in black. Occupancy is the negative signed distance: 0, white between "
        "blue (free) and red (inside), is the surface; grey was never observed. Each image counts as one observation "
        "of std 1 m, so the std is one over the root of how often a cell was seen, not a calibrated error.</p>"
    )


def _header(stats: dict[str, Any]) -> str:
    step = stats["latency_ms"].get("track and update", {}).get("p50")
    facts = {
        "frames": f"{stats['frames']} of {stats['frames_recorded']} recorded",
        "lost": str(len(stats["lost"])),
        "recording": f"{stats['sequence_s']:.1f} s",
        "run": f"{stats['run_s']:.1f} s",
        "images": stats["config"]["size"],
        "rate": f"{stats['config']['rate']:g} Hz at most",
        "voxel": f"{stats['config']['voxel']:g} m",
        "grid": f"{stats['config']['extent']:g} m",
        "version": stats["version"],
    }
    if step is not None:
        facts["track and update, median"] = f"{step:.1f} ms"
    if stats["errors"] and "pairs" in stats["errors"]:
        facts["ATE after SE(3)"] = f"{100.0 * stats['errors']['ate_translation_se3']['rmse']:.2f} cm"
    line = " · ".join(f"{name} <code>{escape(value)}</code>" for name, value in facts.items())
    outside = 1.0 - (stats["fit_median"]["in_grid"] or 0.0)
    warning = (
        f"<p class=bad>Half of the frames have more than {outside:.0%} of their readings outside the grid: give a "
        "larger --extent.</p>"
        if outside > 0.2
        else ""
    )
    return f"<h1>{escape(stats['sequence'])}</h1><p class=note>{line}</p>{warning}"


def _lost(run: SlamRun) -> str:
    lost = [frame for frame in run.frames if frame.lost]
    if not lost:
        return "<p class=good>No frame was lost.</p>"
    lines = [
        [
            str(frame.index),
            f"{frame.time:.6f}",
            STATUS[frame.status],
            *(_number(value) for value in (frame.inlier_share, frame.coverage, frame.photometric)),
        ]
        for frame in lost[:LISTED]
    ]
    table = html_table(["frame", "time, s", "status", "inliers", "coverage", "photometric"], lines, 3)
    more = f"<p class=note>and {len(lost) - LISTED} more; all are in stats.json.</p>" if len(lost) > LISTED else ""
    return (
        f"<h2>Lost frames</h2><p class=bad>{len(lost)} of {len(run.frames)} frames were lost.</p><p class=note>Their "
        "line in trajectory.txt is a guess (the last pose that fitted, turned by the rotation found), and the map does "
        f"not hold them.</p><div class=wide>{table}</div>{more}"
    )


def _number(value: float | None) -> str:
    return "-" if value is None or not np.isfinite(value) else f"{value:.2f}"


def _errors(errors: dict[str, Any] | None) -> str:
    if errors is None:
        return "<p class=note>The sequence has no ground truth.</p>"
    if "impossible" in errors:
        return f"<p class=bad>No errors: {escape(errors['impossible'])}.</p>"
    lines = [
        [label, unit, *(f"{errors[name][statistic]:.4f}" for statistic in STATISTICS)]
        for label, unit, name in ERRORS
        if name in errors
    ]
    return (
        f"<p class=note>{errors['pairs']} poses with a true one within {errors['tolerance_s']:g} s, lost frames "
        "included; ATE after SE(3) alignment, as <code>vssm-gym evaluate-trajectory</code> computes it. Scale of a "
        f"Sim(3) alignment: {errors['scale']:.4f}.</p>{html_table(['error', 'unit', *STATISTICS], lines, 2)}"
    )


def _view_table(numbers: list[tuple[int, float, float]]) -> str:
    lines = [[str(index), _millimetres(off), f"{share:.0%}"] for index, off, share in numbers]
    return html_table(["frame", "median |depth difference|, mm", "readings with a known surface"], lines, 1)


def _millimetres(metres: float) -> str:
    return f"{1e3 * metres:.1f}" if np.isfinite(metres) else "-"


def _latency_table(latency: dict[str, dict[str, float]]) -> str:
    columns = ("p50", "p90", "p99", "max", "mean")
    lines = [
        [stage, *(f"{values[column]:.1f}" for column in columns), str(int(values["n"]))]
        for stage, values in latency.items()
    ]
    return html_table(["ms", *columns, "frames"], lines, 1)
