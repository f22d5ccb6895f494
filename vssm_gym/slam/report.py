"""Lay out the page of a SLAM run: lost frames, trajectory, errors, rendered and observed images, map, fit, latency."""

import json
from html import escape
from typing import Any

import numpy as np

from vssm_gym.data.sequences import Sequence
from vssm_gym.inference.mapping.map_update import MapUpdateConfig
from vssm_gym.inference.status import Status
from vssm_gym.inference.tracking.camera_filter import TrackingConfig
from vssm_gym.maps.voxel_map import OBSERVATION_STD
from vssm_gym.slam import calibration, figures, states
from vssm_gym.slam.run import SlamRun
from vssm_gym.slam.states import Truth
from vssm_gym.viz import pictures
from vssm_gym.viz.html import STYLE, html_table
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
NOTICES = 20  # listed; the rest is counted


def page(
    run: SlamRun, sequence: Sequence, truth: Truth | None, mesh: Mesh, stats: dict[str, Any], config: TrackingConfig
) -> str:
    """Return one self-contained HTML page.

    Args:
        run: the run.
        sequence: what it ran on.
        truth: its true states, where known.
        mesh: surface of its map.
        stats: as :func:`vssm_gym.slam.output.summarise` makes them.
        config: of the filter.
    """
    display = figures.Display.of(run, sequence, truth)
    view_picture, view_numbers = figures.views(run)
    path_picture, magnified = figures.path(run, display)
    name = escape(stats["sequence"])
    sections = [
        _header(stats),
        _notices(stats["notices"]),
        _lost(run),
        "<h2>Trajectory</h2>",
        f"<p class=note>Drawn in {escape(display.note)}. The ellipses hold 95 % of the position"
        f"{'' if magnified == 1.0 else f', drawn {magnified:g} times larger than they are'}.</p>",
        _image(path_picture, "image/svg+xml", "trajectory from above and from the side"),
        _errors(stats["errors"]),
        "<h2>Velocity</h2>",
        "<p class=note>In the map's frame; a new map's has x to the right, y down and z ahead of the first camera. The "
        "band is 1.96 stds to either side; the truth is the mean velocity since the frame before, which is what the "
        f"filter estimates. Lost frames have none.{_in_band(stats['calibration'])}</p>",
        _image(states.velocity(run, truth), "image/webp", "velocity over time with its band"),
        "<h2>Uncertainty of the pose</h2>",
        "<p class=note>Std of the pose in the camera's own axes: how well each image fixes it in what was mapped so "
        "far, and how far the map itself may have drifted from the first frame. Drift grows most where new space comes "
        "into view; nothing makes it smaller.</p>",
        _image(states.pose_std(run), "image/webp", "std of the pose over time"),
        _calibration(run, truth, stats["calibration"]),
        "<h2>Rendered against observed</h2>",
        "<p class=note>The final map's mean, rendered at the estimated poses; grey: never observed or no reading. The "
        "map was built from these images among others, so this shows consistency, not prediction.</p>",
        _image(view_picture, "image/webp", "observed and rendered images"),
        _view_table(view_numbers),
        "<h2>Map</h2>",
        _map_note(stats["map"], mesh),
        _image(
            figures.slices(run, display, MapUpdateConfig().std), "image/webp", "slices of mean and std of occupancy"
        ),
        "<h2>Fit</h2>",
        "<p class=note>The values of the loss test, and their limits (dashed). The score is the share of pixels that "
        "agree with the model's geometry, times min(1, coverage / 0.4).</p>",
        _image(figures.fit(run, config), "image/svg+xml", "fit over time"),
        "<h2>Latency</h2>",
        f"<p class=note>{escape(stats['latency_note'])}: "
        f"{', '.join(f'{s:.1f}' for s in stats['compiling_s'])} s. All wall-clock, on {stats['machine']['cores']} "
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


def _map_note(of_map: dict[str, Any], mesh: Mesh) -> str:
    return (
        f"<p class=note>{' x '.join(map(str, of_map['shape']))} cells of {of_map['voxel']:g} m, stored "
        f"{of_map['storage']}; the surface (<code>mesh.ply</code>) has {len(mesh.vertices):,} vertices and "
        f"{len(mesh.faces):,} triangles. Slices where most space is free, the camera's path in black. Occupancy is the "
        "negative signed distance: 0, white between blue (free) and red (inside), is the surface; grey was never "
        f"observed. The std takes each reading of a cell as an independent one of {1e3 * OBSERVATION_STD:g} mm and the "
        "pose as known, so it orders cells by how well they were seen; it is not the error of the surface.</p>"
    )


def _notices(notices: list[str]) -> str:
    if not notices:
        return ""
    lines = "".join(f"<li>{escape(notice)}</li>" for notice in notices[:NOTICES])
    more = (
        f"<p class=note>and {len(notices) - NOTICES} more; all are in stats.json.</p>" if len(notices) > NOTICES else ""
    )
    return f"<h2>Damaged input</h2><p class=bad>{_counted(len(notices), 'warning')}.</p><ul>{lines}</ul>{more}"


def _counted(n: int, noun: str) -> str:
    return f"{n} {noun}{'' if n == 1 else 's'}"


def _in_band(found: dict[str, Any] | None) -> str:
    if not found or "velocity" not in found:
        return ""
    shares = found["velocity"]["share_in_band"]
    linear, angular = (", ".join(f"{share:.0%}" for share in part) for part in (shares[:3], shares[3:]))
    return f" The truth lies in its band on {linear} of the frames (linear x, y, z) and {angular} (angular)."


def _calibration(run: SlamRun, truth: Truth | None, found: dict[str, Any] | None) -> str:
    if truth is None or not found:
        return "<p class=note>Calibration needs ground truth of ten tracked frames at least.</p>"
    raw = states.calibrations(run, truth)
    scale = {name: calibration.fit_scale({name: c}) for name, c in raw.items()}
    scaled = {f"{name}, x {scale[name]:.3g}": c.scaled(scale[name]) for name, c in raw.items()}
    lines = [
        [
            name,
            str(len(c.nees)),
            str(c.dimension),
            f"{values['nees']:.1f}",
            f"{values['nees_over_dimension']:.2f}",
            *(f"{values[f'share_within_{p}']:.0%}" for p in (50, 90, 95, 99)),
        ]
        for name, c, values in ((name, c, c.summary()) for name, c in (raw | scaled).items())
    ]
    header = [
        "state",
        "frames",
        "dimension",
        "mean NEES",
        "NEES / dimension",
        "in 50 %",
        "in 90 %",
        "in 95 %",
        "in 99 %",
    ]
    drawn = "".join(
        _image(calibration.figure({name: c}, f"covariances of the {name}"), "image/svg+xml", f"calibration: {name}")
        for name, c in (raw | scaled).items()
    )
    return (
        "<h3>Calibration</h3><p class=note>NEES is the squared error in units of the covariance; its mean should be "
        "the dimension. First the covariances as the filter gives them, then times the one factor that makes it so "
        "here; fitted on this very sequence, that shows whether their shape is right, not their size. Poses are "
        "aligned by the first one alone, so that drift counts as error, and on real data the error of that one true "
        f"pose with it.</p>{html_table(header, lines, 1)}{drawn}"
    )


def _header(stats: dict[str, Any]) -> str:
    step = stats["latency_ms"].get("whole step")
    facts = {
        "frames": f"{stats['frames']} of {stats['frames_recorded']} recorded",
        "lost": str(len(stats["lost"])),
        "relocalised": str(len(stats["relocalised"])),
        "recording": f"{stats['sequence_s']:.1f} s",
        "run": f"{stats['run_s']:.1f} s",
        "images": stats["config"]["size"],
        "rate": f"{stats['config']['rate']:g} Hz at most",
        "method": stats["config"]["method"],
        "voxel": f"{stats['map']['voxel']:g} m",
        "grid": " x ".join(f"{stats['map']['voxel'] * n:.3g}" for n in stats["map"]["shape"]) + " m",
        "solver": stats["config"]["solver"],
        "version": stats["version"],
    }
    if step is not None:
        facts["step, median"] = f"{step['p50']:.1f} ms"
        facts["95 %"] = f"{step['p95']:.1f} ms"
    if stats["errors"] and "pairs" in stats["errors"]:
        facts["ATE after SE(3)"] = f"{100.0 * stats['errors']['ate_translation_se3']['rmse']:.2f} cm"
    line = " · ".join(f"{name} <code>{escape(value)}</code>" for name, value in facts.items())
    warnings = []
    outside = 1.0 - (stats["fit_median"]["in_grid"] or 0.0)
    if outside > 0.2:
        warnings.append(
            f"Half of the frames have more than {outside:.0%} of their readings outside the grid: give a larger "
            "--extent."
        )
    if stats["map"]["blocks_forgotten"]:
        warnings.append(
            f"The camera left the grid, which followed it: {stats['map']['blocks_forgotten']:,} observed blocks of 8^3 "
            "cells were forgotten. A larger --extent keeps them."
        )
    return f"<h1>{escape(stats['sequence'])}</h1><p class=note>{line}</p>" + "".join(
        f"<p class=bad>{warning}</p>" for warning in warnings
    )


def _lost(run: SlamRun) -> str:
    listed = [frame for frame in run.frames if frame.lost or frame.status is Status.RECOVERED]
    lost, again = sum(frame.lost for frame in run.frames), sum(frame.status is Status.RECOVERED for frame in run.frames)
    if not listed:
        return "<p class=good>No frame was lost.</p>"
    lines = [
        [
            str(frame.index),
            f"{frame.time:.6f}",
            frame.status.message,
            *(_number(value) for value in (frame.inlier_share, frame.coverage, frame.photometric)),
        ]
        for frame in listed[:LISTED]
    ]
    table = html_table(["frame", "time, s", "status", "inliers", "coverage", "photometric"], lines, 3)
    more = f"<p class=note>and {len(listed) - LISTED} more; all are in stats.json.</p>" if len(listed) > LISTED else ""
    return (
        f"<h2>Lost frames</h2><p class=bad>{lost} of {len(run.frames)} frames were lost. The camera was relocalised "
        f"{_counted(again, 'time')} at a pose other than the expected one.</p><p class=note>The line of a lost frame "
        "in trajectory.txt is the last accepted pose, and the map does not include the frame.</p>"
        f"<div class=wide>{table}</div>{more}"
    )


def _number(value: float | None) -> str:
    return "-" if value is None or not np.isfinite(value) else f"{value:.2f}"


def _errors(errors: dict[str, Any] | None) -> str:
    if errors is None:
        return "<p class=note>The sequence has no ground truth.</p>"
    if "impossible" in errors:
        return f"<p class=bad>Errors cannot be computed: {escape(errors['impossible'])}.</p>"
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
    columns = ("p50", "p95", "p99", "max", "mean")
    lines = [
        [stage, *(f"{values[column]:.1f}" for column in columns), str(int(values["n"]))]
        for stage, values in latency.items()
    ]
    return html_table(["ms", *columns, "frames"], lines, 1)
