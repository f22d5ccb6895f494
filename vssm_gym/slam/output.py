"""Write the output folder of ``vssm-gym slam``: trajectory line by line, then map, mesh, ``stats.json`` and report."""

import hashlib
import json
import os
import platform
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any

import jax
import numpy as np

from vssm_gym.data.sequences import FrameReader, Sequence
from vssm_gym.data.trajectories import tum_line
from vssm_gym.errors import InputError
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.line_file import LineFile
from vssm_gym.files.output_folders import Owner, owned_folder
from vssm_gym.inference.status import Status
from vssm_gym.maps.map_file import map_hash
from vssm_gym.model.transition.learned_file import transition_hash
from vssm_gym.progress import OnProgress
from vssm_gym.slam import trajectory_error
from vssm_gym.slam.colour_learning import learn_colour, registered
from vssm_gym.slam.figures import STAGES
from vssm_gym.slam.options import SlamOptions
from vssm_gym.slam.real_time import real_time
from vssm_gym.slam.refinement import FEWEST_NODES, refine
from vssm_gym.slam.report import page
from vssm_gym.slam.run import SlamRun, TrackedFrame, run_slam
from vssm_gym.slam.states import Truth, calibration_summary
from vssm_gym.version import package_version
from vssm_gym.viz.mesh import surface_mesh, write_ply
from vssm_gym.viz.stream import Viewer

PARTIAL, TRAJECTORY, MAP, MESH = "trajectory.partial.txt", "trajectory.txt", "map.npz", "mesh.ply"
STATS, REPORT, MANIFEST = "stats.json", "report.html", "slam.json"
CAMERA = "camera.json"  # where its calibration was learned
TRAJECTORY_HEADER = "# timestamp tx ty tz qx qy qz qw\n"  # of a trajectory
MOST_OUTSIDE = 0.5  # a larger share of readings outside the map gives a warning
LATENCY_NOTE = (
    "whole step: from the image in memory to the pose and the updated map; of that, track: prior, rotation between "
    "the images, MAP, Laplace and velocity; map: the closed-form update, and moving the window where the camera leaves "
    "it; reference: rendering a new reference view where the camera has left the last one; recover: aligning a lost "
    "image to the map from several starts; the rest is shrinking the image and storing keyframes. read: decoding, "
    "undistorting and resizing, in a thread beside the filter; wait: the time in which the filter waits for the image. "
    "Frames on which a stage ran for the first time, and was compiled, are left out"
)


def process(
    sequence: Sequence,
    out: Path,
    options: SlamOptions,
    on_progress: OnProgress | None = None,
    on_frame: Callable[[TrackedFrame], None] | None = None,
    viewer: Viewer | None = None,
) -> dict[str, Any]:
    """Run SLAM over a sequence and write everything to ``out``; returns what ``stats.json`` holds.

    Each file is written atomically. If the run ends early, the poses of the finished frames stay in
    ``trajectory.partial.txt``, and the same run may use the folder again.

    Args:
        sequence: the recording.
        out: new or empty folder, or that of an unfinished run over the same sequence with the same options.
        options: image size, rate, grid, solver.
        on_progress: called after every frame, and after every file.
        on_frame: called with every finished frame.
        viewer: shows every frame, and the surface at the end.

    Raises:
        InputError: bad input, or the folder of another run; a run that ends before its first frame leaves nothing.
        OutputError: a full disk or the like.
    """
    with owned_folder(out, _owner(sequence, options)):
        return _process(sequence, out, options, on_progress, on_frame, viewer)


def _owner(sequence: Sequence, options: SlamOptions) -> Owner:
    """Return what marks the folder of a run: the sequence, by its name and all that is read of it, and the options."""
    config = {"sequence": sequence.root.resolve().name, "content": _content_hash(sequence), **_config(options)}
    if options.map is not None:
        config["map"] = map_hash(options.map)
    if options.transition is not None:
        config["transition"] = transition_hash(options.transition)
    hashed = hashlib.sha256(json.dumps(config, sort_keys=True).encode()).hexdigest()[:16]
    content = {"config": config, "config_hash": hashed, "version": package_version()}
    return Owner("SLAM run", MANIFEST, content, finished=REPORT)


def _content_hash(sequence: Sequence) -> str:
    """Return 16 hex digits by which two sequences differ: camera, times, measurements, names and sizes of images.

    The images themselves are not read, which would take as long as a run; a folder may be moved.
    """
    camera = sequence.camera
    content = hashlib.sha256(repr((camera.width, camera.height, sequence.depth_scale)).encode())
    arrays = [
        camera.K,
        sequence.distortion,
        sequence.T_body_cam,
        *(sequence.truth or ()),
        sequence.controls,
        sequence.imu,
    ]
    if (colour := sequence.colour) is not None:
        view = colour.view
        content.update(repr((view.camera.width, view.camera.height)).encode())
        arrays += [view.camera.K, np.asarray(view.T_depth_colour), colour.distortion, colour.std]
    for array in arrays:
        content.update(repr(None if array is None else array.shape).encode())
        content.update(np.asarray([] if array is None else array, np.float64).tobytes())
    for frame in sequence.frames:
        files = [(file.name, file.stat().st_size if file.is_file() else None) for file in (frame.rgb, frame.depth)]
        content.update(repr((frame.time, files)).encode())
    return content.hexdigest()[:16]


def _process(
    sequence: Sequence,
    out: Path,
    options: SlamOptions,
    on_progress: OnProgress | None,
    on_frame: Callable[[TrackedFrame], None] | None,
    viewer: Viewer | None,
) -> dict[str, Any]:
    """Do the work of :func:`process` in a folder that it owns."""
    if options.learn_camera and sequence.colour is None:
        raise registered(sequence)
    if options.learn_camera and len(sequence.frames) < FEWEST_NODES:
        found = f"{FEWEST_NODES} frames or more; found {len(sequence.frames)}"
        raise InputError(sequence.root, "learn-camera", found)
    start = time.perf_counter()
    images = FrameReader(sequence, options.size)  # for the viewer: the run keeps none of its images

    def finished(frame: TrackedFrame) -> None:
        file.append(frame)
        if viewer:
            pixels = images[frame.index]
            viewer.frame(frame.time, frame.T_world_cam, *pixels, lost=frame.lost, step_ms=1e3 * frame.step_s)
        if on_frame:
            on_frame(frame)

    with _TrajectoryFile(out) as file:
        run = run_slam(sequence, options, finished, on_progress)
    refined, colour = None, None
    if options.learn_camera:
        run, sequence, colour = learn_colour(run, sequence, options, on_progress)
    if options.refine or options.method == "smoother":
        refined = refine(run, options, on_progress)
        run = refined.run
    if refined is not None or colour is not None:
        _write(
            out / TRAJECTORY,
            TRAJECTORY_HEADER + "".join(tum_line(frame.time, frame.T_world_cam) for frame in run.frames),
        )
    truth = Truth.of(run, sequence)
    stats = summarise(run, sequence, options, time.perf_counter() - start, truth)
    if refined is not None:
        before = errors(refined.filtered, sequence)
        stats["refinement"] = {
            "frames": len(refined.nodes),
            "costs": refined.costs,
            "seconds": refined.seconds,
            "ate_before": before["ate_translation_se3"] if before and "pairs" in before else None,
        }
    if colour is not None:
        stats["colour_camera"] = {
            "rounds": colour.rounds,
            "settled": colour.settled,
            "seconds": colour.seconds,
            "parameters": [parameter._asdict() for parameter in colour.parameters],
        }
        _write(out / CAMERA, json.dumps(sequence.calibration.as_json(), indent=1) + "\n")
    mesh = surface_mesh(run.map)
    stats["map"] |= {"vertices": len(mesh.vertices), "faces": len(mesh.faces)}
    if viewer:
        viewer.surface(mesh)
    writers = (
        lambda: run.posterior.save(out / MAP, sequence=sequence.root.resolve().name, frames=len(run.frames)),
        lambda: write_ply(out / MESH, mesh),
        lambda: _write(out / STATS, json.dumps(stats, indent=1, allow_nan=False) + "\n"),
        lambda: _write(out / REPORT, page(run, sequence, truth, mesh, stats, options.tracking, refined)),
    )
    for done, write in enumerate(writers, start=1):
        write()
        if on_progress:
            on_progress("writing", done, len(writers))
    return stats


def summarise(
    run: SlamRun, sequence: Sequence, options: SlamOptions, seconds: float, truth: Truth | None
) -> dict[str, Any]:
    """Summarise a run for readers who evaluate or repeat it, as plain JSON values."""
    frames = run.frames
    fits = {
        name: [value for frame in frames if (value := getattr(frame, name)) is not None and np.isfinite(value)]
        for name in ("inlier_share", "coverage", "photometric", "in_grid")
    }
    camera = sequence.camera
    K = camera.K
    table = run.map.table
    return {
        "version": package_version(),
        "machine": {
            "processor": platform.machine(),
            "cores": os.cpu_count(),
            "jax": f"{jax.__version__} {jax.default_backend()}",
        },
        "sequence": sequence.root.resolve().name,
        "config": _config(options),
        "camera": {
            "width": camera.width,
            "height": camera.height,
            "fx_fy_cx_cy": [float(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2])],
            "distortion_k1_k2_p1_p2_k3": sequence.distortion.tolist(),
            "depth_scale": sequence.depth_scale,
        },
        "notices": list(notices(run)),
        "frames_recorded": len(sequence.frames),
        "frames": len(frames),
        "sequence_s": float(run.times[-1] - run.times[0]),
        "run_s": seconds,
        "lost": [{"index": f.index, "time": f.time, "status": f.status.message} for f in frames if f.lost],
        "relocalised": [{"index": f.index, "time": f.time} for f in frames if f.status is Status.RECOVERED],
        "fit_median": {name: float(np.median(values)) if values else None for name, values in fits.items()},
        "real_time": real_time(frames),
        "latency_ms": latency(frames),
        "latency_note": LATENCY_NOTE,
        "compiling_s": [f.step_s for f in frames if not f.warm and (f.stages or f.status is Status.OK)],
        "map": {
            "cells": int(np.prod(run.map.shape)),
            "shape": list(run.map.shape),
            "voxel": round(float(run.map.voxel_size), 6),
            "storage": "dense" if table is None else "block-sparse",
            "blocks_forgotten": sum(frame.left_window for frame in frames),
        },
        "errors": errors(run, sequence),
        "calibration": calibration_summary(run, truth),
    }


def _config(options: SlamOptions) -> dict[str, Any]:
    """Return the options as JSON, without those that the method does not use."""
    unused = {"tracker": {"voxel", "extent", "samples"}, "smoother": {"samples"}}.get(options.method, set())
    shown = asdict(options) | {"size": "x".join(map(str, options.size)), "map": options.map and options.map.name}
    shown["transition"] = options.transition and options.transition.name
    return {name: value for name, value in shown.items() if value is not None and name not in unused}


def notices(run: SlamRun) -> tuple[str, ...]:
    """List problems of the input, and of the map's size and storage, one sentence each."""
    found = list(run.notices)
    outside = 1.0 - float(np.median([frame.in_grid for frame in run.frames]))
    if outside > MOST_OUTSIDE:
        why = "a larger --extent, or a depth scale that is wrong in camera.json"
        found.append(f"{outside:.0%} of the depth readings lie outside the map's cube (median over frames): {why}?")
    refused = 0 if run.map.table is None else int(run.map.table.refused)
    if refused:
        found.append(f"the map's storage is full: {refused:,} observations of blocks were left out; use larger voxels")
    return tuple(found)


def latency(frames: tuple[TrackedFrame, ...]) -> dict[str, dict[str, float]]:
    """Summarise the duration of the step, of its stages (over the frames that needed them) and of the images, ms."""
    warm = [frame for frame in frames if frame.warm]
    names = dict.fromkeys(stage for stage in STAGES for frame in warm if stage in frame.stages)
    seconds = {"whole step": [frame.step_s for frame in warm]}
    seconds |= {stage: [frame.stages[stage] for frame in warm if stage in frame.stages] for stage in names}
    seconds |= {"read": [frame.read_s for frame in frames], "wait for image": [frame.wait_s for frame in frames[1:]]}
    return {stage: percentiles(values) for stage, values in seconds.items() if values}


def percentiles(seconds: list[float]) -> dict[str, float]:
    """Return median, 95th and 99th percentile, largest and mean, ms, and the number of values."""
    ms = 1e3 * np.asarray(seconds)
    p50, p95, p99 = (float(value) for value in np.percentile(ms, (50, 95, 99)))
    return {"p50": p50, "p95": p95, "p99": p99, "max": float(ms.max()), "mean": float(ms.mean()), "n": len(ms)}


def errors(run: SlamRun, sequence: Sequence) -> dict[str, Any] | None:
    """Compute ATE and RPE as ``vssm-gym evaluate-trajectory`` does; None without truth, a reason where impossible."""
    if sequence.truth is None:
        return None
    try:
        return trajectory_error.evaluate(run.times, run.poses, *sequence.truth)
    except InputError as error:
        return {"impossible": str(error)}


def _write(path: Path, text: str) -> None:
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


class _TrajectoryFile:
    """Write one line per finished frame to a partial file, which is renamed when the run has ended."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self._file: LineFile | None = None

    def append(self, frame: TrackedFrame) -> None:
        """Write a frame's pose; the first call drops the poses of the same run before, if that did not end."""
        if self._file is None:
            self._file = LineFile(self.out / PARTIAL, keep=0)
            self._file.append(TRAJECTORY_HEADER.encode())
        self._file.append(tum_line(frame.time, frame.T_world_cam).encode())

    def __enter__(self) -> "_TrajectoryFile":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is not None:
            self._file.close()
            if kind is None:
                os.replace(self.out / PARTIAL, self.out / TRAJECTORY)
