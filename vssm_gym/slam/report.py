"""Collect the page of a SLAM run: summary, surface and trajectory, errors, images, map, uncertainty, fit, latency."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from vssm_gym.data.sequences import Sequence
from vssm_gym.inference.mapping.map_update import MapUpdateConfig
from vssm_gym.inference.status import Status
from vssm_gym.inference.tracking.config import TrackingConfig
from vssm_gym.maps.voxel_map import OBSERVATION_STD
from vssm_gym.slam import calibration, figures, refinement_figures, states, verdict
from vssm_gym.slam.refinement import Refinement
from vssm_gym.slam.run import SlamRun
from vssm_gym.slam.states import Truth
from vssm_gym.viz.html import Table, render, script, svg_image, webp_image
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
SETTING = ("version", "machine", "sequence", "config", "camera")  # of the stats
OUTSIDE_GRID = 0.2  # a larger proportion of readings outside the grid gives a warning


def page(
    run: SlamRun,
    sequence: Sequence,
    truth: Truth | None,
    mesh: Mesh,
    stats: dict[str, Any],
    config: TrackingConfig,
    refined: Refinement | None = None,
) -> str:
    """Return one self-contained HTML page.

    Args:
        run: the run.
        sequence: what it ran on.
        truth: its true states, where known.
        mesh: surface of its map.
        stats: as :func:`vssm_gym.slam.output.summarise` makes them.
        config: of the filter.
        refined: the smoothing that the run is the outcome of, where there was one.
    """
    display = figures.Display.of(run, sequence, truth)
    view_picture, view_numbers = figures.views(run)
    path_picture, magnified = figures.path(run, display)
    alignment = None if truth is None else verdict.Alignment.of(run, truth)
    errors = stats["errors"]
    outside = 1.0 - (stats["fit_median"]["in_grid"] or 0.0)
    return render(
        "slam.html.j2",
        sequence=stats["sequence"],
        tiles=verdict.tiles(run, stats, alignment),
        ate=_centimetres(errors["ate_translation_se3"]["rmse"]) if errors and "pairs" in errors else None,
        loose=_loose(alignment),
        wrong=verdict.warnings_of(stats["calibration"]),
        surface=figures.surface(run, mesh, display),
        surface_script=script("surface.js"),
        known=_facts(stats),
        outside=f"{outside:.0%}" if outside > OUTSIDE_GRID else None,
        forgotten=f"{stats['map']['blocks_forgotten']:,}" if stats["map"]["blocks_forgotten"] else None,
        notices={"n": len(stats["notices"]), "listed": stats["notices"][:NOTICES]},
        lost=_lost(run),
        path={
            "frame": display.note,
            "magnified": None if magnified == 1.0 else f"{magnified:g}",
            "picture": svg_image(path_picture),
        },
        errors=_errors(errors),
        refinement=_refinement(refined, display, truth) if refined and refined.costs else None,
        colour_camera=_colour_camera(stats.get("colour_camera")),
        in_band=_in_band(stats["calibration"]),
        velocity=webp_image(states.velocity(run, truth)),
        pose_std=webp_image(states.pose_std(run)),
        calibration=_calibration(run, truth, stats["calibration"]),
        views={"picture": webp_image(view_picture), "table": _view_table(view_numbers)},
        map=_map(stats["map"], mesh) | {"slices": webp_image(figures.slices(run, display, MapUpdateConfig().std))},
        fit=svg_image(figures.fit(run, config)),
        latency={
            "note": stats["latency_note"],
            "compiling": ", ".join(f"{s:.1f}" for s in stats["compiling_s"]),
            "cores": stats["machine"]["cores"],
            "jax": stats["machine"]["jax"],
            "table": _latency_table(stats["latency_ms"]),
            "picture": svg_image(figures.latency(run)),
        },
        config={name: stats[name] for name in SETTING},
    )


def _refinement(refined: Refinement, display: figures.Display, truth: Truth | None) -> dict[str, Any]:
    """Return the picture of a run before and after it was smoothed, and the table of its images."""
    numbers = refinement_figures.depth_differences(refined)
    lines = [[str(index), _millimetres(before), _millimetres(after)] for index, before, after in numbers]
    return {
        "frames": len(refined.nodes),
        "seconds": f"{refined.seconds:.0f}",
        "picture": webp_image(refinement_figures.before_and_after(refined, display, truth)),
        "table": Table(["frame", "median |depth difference|, mm: before", "smoothed"], lines, 1),
    }


def _colour_camera(learned: dict[str, Any] | None) -> dict[str, Any] | None:
    """Return the table of a learned calibration, and the names of the numbers that the recording does not tell."""
    if learned is None:
        return None
    rows = learned["parameters"]
    lines = [[row["name"], row["unit"], *(f"{row[key]:.3f}" for key in ("stated", "learned", "std"))] for row in rows]
    return {
        "rounds": learned["rounds"],
        "settled": learned["settled"],
        "seconds": f"{learned['seconds']:.0f}",
        "untold": ", ".join(row["name"] for row in rows if not row["told"]),
        "table": Table(["parameter", "unit", "stated", "learned", "std"], lines, 2),
    }


def _facts(stats: dict[str, Any]) -> dict[str, tuple[str]]:
    """Return what stands under the heading: names, and one value of each."""
    facts = {
        "frames": f"{stats['frames']} of {stats['frames_recorded']} recorded",
        "recording": f"{stats['sequence_s']:.1f} s",
        "run": f"{stats['run_s']:.1f} s",
        "images": stats["config"]["size"],
        "rate": f"{stats['config']['rate']:g} Hz at most",
        "method": stats["config"]["method"],
        "solver": stats["config"]["solver"],
        "version": stats["version"],
    }
    return {name: (value,) for name, value in facts.items()}


def _centimetres(metres: float) -> str:
    return f"{100.0 * metres:.2f} cm"


def _loose(alignment: verdict.Alignment | None) -> dict[str, str] | None:
    """Return the numbers of the warning about an alignment that the positions do not determine."""
    if alignment is None or not alignment.is_loose:
        return None
    angle, spread = f"{np.degrees(alignment.angle):.0f}", _centimetres(alignment.spread)
    return {"angle": angle, "spread": spread, "error": _centimetres(alignment.error)}


def _lost(run: SlamRun) -> dict[str, Any]:
    listed = [frame for frame in run.frames if frame.lost or frame.status is Status.RECOVERED]
    lines = [
        [
            str(frame.index),
            f"{frame.time:.6f}",
            frame.status.message,
            *(_number(value) for value in (frame.inlier_share, frame.coverage, frame.photometric)),
        ]
        for frame in listed[:LISTED]
    ]
    return {
        "n": len(listed),
        "lost": sum(frame.lost for frame in run.frames),
        "again": sum(frame.status is Status.RECOVERED for frame in run.frames),
        "frames": len(run.frames),
        "table": Table(
            ["frame", "time, s", "status", "inliers", "coverage", "photometric"], lines, 3, sentences=("status",)
        ),
    }


def _number(value: float | None) -> str:
    return "-" if value is None or not np.isfinite(value) else f"{value:.2f}"


def _errors(errors: dict[str, Any] | None) -> dict[str, Any] | None:
    if errors is None or "impossible" in errors:
        return errors
    lines = [
        [label, unit, *(f"{errors[name][statistic]:.4f}" for statistic in STATISTICS)]
        for label, unit, name in ERRORS
        if name in errors
    ]
    return {
        "impossible": None,
        "pairs": errors["pairs"],
        "tolerance": f"{errors['tolerance_s']:g}",
        "scale": f"{errors['scale']:.4f}",
        "table": Table(["error", "unit", *STATISTICS], lines, 2),
    }


def _in_band(found: dict[str, Any] | None) -> dict[str, str] | None:
    """Return the proportion of frames whose true velocity lies in its band, as text, per axis."""
    if not found or "velocity" not in found:
        return None
    shares = found["velocity"]["share_in_band"]
    linear, angular = (", ".join(f"{share:.0%}" for share in part) for part in (shares[:3], shares[3:]))
    return {"linear": linear, "angular": angular}


def _calibration(run: SlamRun, truth: Truth | None, found: dict[str, Any] | None) -> dict[str, Any] | None:
    if truth is None or not found:
        return None
    raw = states.calibrations(run, truth)
    lines = [
        [
            name,
            str(len(c.nees)),
            str(c.dimension),
            f"{values['nees']:.1f}",
            f"{values['nees_over_dimension']:.2f}",
            *(f"{values[f'share_within_{p}']:.0%}" for p in (50, 90, 95, 99)),
            f"{c.scaled(calibration.fit_scale({name: c})).summary()['share_within_95']:.0%}",
        ]
        for name, c, values in ((name, c, c.summary()) for name, c in raw.items())
    ]
    header = ["state", "frames", "dimension", "mean NEES", "NEES / dimension"]
    header += [*(f"in {p} %" for p in (50, 90, 95, 99)), "in 95 %, rescaled"]
    return {"table": Table(header, lines, 1), "picture": svg_image(figures.calibration_curves(raw))}


def _view_table(numbers: list[tuple[int, float, float]]) -> Table:
    lines = [[str(index), _millimetres(off), f"{share:.0%}"] for index, off, share in numbers]
    return Table(["frame", "median |depth difference|, mm", "readings with a known surface"], lines, 1)


def _millimetres(metres: float) -> str:
    return f"{1e3 * metres:.1f}" if np.isfinite(metres) else "-"


def _map(of_map: dict[str, Any], mesh: Mesh) -> dict[str, Any]:
    return {
        "shape": " x ".join(map(str, of_map["shape"])),
        "voxel": f"{of_map['voxel']:g}",
        "storage": of_map["storage"],
        "vertices": f"{len(mesh.vertices):,}",
        "triangles": f"{len(mesh.faces):,}",
        "reading_mm": f"{1e3 * OBSERVATION_STD:g}",
    }


def _latency_table(latency: Mapping[str, Mapping[str, float]]) -> Table:
    columns = ("p50", "p95", "p99", "max", "mean")
    lines = [
        [stage, *(f"{values[column]:.1f}" for column in columns), str(int(values["n"]))]
        for stage, values in latency.items()
    ]
    return Table(["ms", *columns, "frames"], lines, 1)
