"""Evaluate the filter in flight: reference flights through a hall with noisy stereo depth (PRISM, table 1).

Every flight is flown by the simulated body with gusts, recorded as by ``vssm-gym record``, and given to the filter of
``vssm-gym slam``. Two errors of position are reported: after SE(3) alignment of the whole path, as in the papers, and
after alignment of the first pose alone, where an error at the start rotates all later poses.
"""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from vssm_gym.data.flights import record_flight
from vssm_gym.data.sequences import load_sequence
from vssm_gym.envs.scenes.scene import Apartment, load_scene
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.envs.tasks.reference_flights import Yaw
from vssm_gym.errors import InputError
from vssm_gym.eval.studies.page import Study, labelled
from vssm_gym.geometry.transforms import inverse
from vssm_gym.progress import OnProgress
from vssm_gym.slam import trajectory_error
from vssm_gym.slam.options import SlamOptions
from vssm_gym.slam.run import SlamRun, run_slam
from vssm_gym.viz import pictures

ATE_GOAL = 0.10  # m of ATE, the project's own aim
# The yaw mode of the Blackbird flights that the papers chose.
YAWS: dict[str, Yaw] = {"star": "forward", "picasso": "constant", "figure8": "forward", "clover": "forward"}
# ATE (m) at 1, 2, 3, 4 m/s on Blackbird's real flights (PRISM, table 1), in other scenes with another stereo camera.
PUBLISHED = {"picasso": (0.064, 0.053, 0.061, 0.079), "star": (0.089, 0.111, 0.115, 0.153)}


def run(
    scene: str | Path | Apartment,
    *,
    flights: tuple[str, ...],
    speeds: tuple[float, ...],
    sensor_noise: str,
    options: SlamOptions,
    seeds: int = 1,
    on_progress: OnProgress | None = None,
) -> Study:
    """Fly, record and track every flight at every speed.

    Args:
        scene: the hall.
        flights: names of reference flights.
        speeds: peak speeds, m/s.
        sensor_noise: the noise of the camera.
        options: of the filter; images are recorded at its size and rate.
        seeds: number of flights of each kind, with different gusts and noise.
        on_progress: called during recording and tracking.

    Raises:
        InputError: an unknown name, or a flight that does not fit the scene.
    """
    apartment = load_scene(scene)
    for name in flights:
        if name not in YAWS:
            raise InputError("study", "flights", f"names among {', '.join(YAWS)}, not {name!r}")
    rows = []
    for flight in flights:
        for speed in speeds:
            for seed in range(seeds):
                label = f"{flight} {speed:g} m/s" + f", {seed + 1}" * (seeds > 1)
                with tempfile.TemporaryDirectory(prefix="vssm-gym-flight-") as folder:
                    recording = Path(folder) / "flight"
                    record_flight(
                        apartment,
                        recording,
                        flight=flight,
                        speed=speed,
                        yaw=YAWS[flight],
                        rate=options.rate,
                        sensor_noise=sensor_noise,
                        camera=CameraConfig(*options.size),
                        seed=seed,
                        on_progress=labelled(on_progress, f"{label}: recording"),
                    )
                    sequence = load_sequence(recording)
                    done = run_slam(sequence, options, on_progress=labelled(on_progress, f"{label}: tracking"))
                true = sequence.true_poses()[[frame.index for frame in done.frames]]
                rows.append({"flight": flight, "speed": speed, "seed": seed} | measured(done, true))
    return Study(
        name="flight",
        question="Does the filter track flights?",
        answer=_answer(rows),
        header=("flight", "nose", "peak", "length", *LABELS.values(), "published"),
        lines=[_line(row) for row in rows],
        picture=_picture(rows),
        setting={
            "scene": apartment.name,
            "scene_hash": apartment.content_hash(),
            "sensor_noise": sensor_noise,
            "size": "x".join(map(str, options.size)),
            "rate": options.rate,
            "voxel": options.voxel,
            "extent": options.extent,
            "max_depth": options.max_depth,
            "depth": options.depth,
            "imu": options.imu,
            "seeds": seeds,
        },
        figures={"rows": rows},
        notes=(
            "ATE is the RMSE of positions after SE(3) alignment, lost frames included; 'first pose' is the RMSE after "
            "alignment of the first pose alone; 'end' is that error at the last frame, over a closed path.",
            "Milliseconds are those of a whole step once its image is read, without the calls that compile.",
            "Published: PRISM on Blackbird's real flights at these speeds, in another scene: for orientation only.",
        ),
    )


LABELS = {
    "ate_m": "ATE, cm",
    "max_m": "largest, cm",
    "first_m": "first pose, cm",
    "end_m": "end, cm",
    "lost": "lost frames",
    "step_ms": "ms a step",
    "step_p95_ms": "95 %",
}


def measured(done: SlamRun, true: Float[np.ndarray, "n 4 4"]) -> dict[str, Any]:
    """Compute errors, lost frames and times of one run; ATE is None where the estimate cannot be aligned."""
    error = np.linalg.norm((true[0] @ inverse(done.poses[0]) @ done.poses)[:, :3, 3] - true[:, :3, 3], axis=1)
    try:
        errors = trajectory_error.evaluate(done.times, done.poses, done.times, true, deltas=(), alignments=("se3",))
        ate = errors["ate_translation_se3"]
    except InputError:
        ate = {"rmse": None, "max": None}
    steps = [1e3 * frame.step_s for frame in done.frames if frame.warm]
    median, p95 = np.percentile(steps, (50, 95)) if steps else (None, None)
    return {
        "ate_m": ate["rmse"],
        "max_m": ate["max"],
        "first_m": float(np.sqrt(np.mean(error**2))),
        "end_m": float(error[-1]),
        "length_m": float(np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum()),
        "frames": len(done.frames),
        "lost": int(done.lost.sum()),
        "step_ms": None if median is None else float(median),
        "step_p95_ms": None if p95 is None else float(p95),
        "true_xy": true[::5, :2, 3].round(3).tolist(),
        "estimated_xy": (true[0] @ inverse(done.poses[0]) @ done.poses)[::5, :2, 3].round(3).tolist(),
    }


def _line(row: Mapping[str, Any]) -> list[str]:
    def text(name: str) -> str:
        if name == "lost":
            return f"{row['lost']} of {row['frames']}"
        value = row[name]
        return "-" if value is None else f"{100 * value:.1f}" if name.endswith("_m") else f"{value:.0f}"

    known = PUBLISHED.get(row["flight"], ())
    published = f"{100 * known[int(row['speed']) - 1]:.1f}" if row["speed"] in range(1, len(known) + 1) else "-"
    first = [row["flight"], YAWS[row["flight"]], f"{row['speed']:g} m/s", f"{row['length_m']:.0f} m"]
    return [*first, *(text(name) for name in LABELS), published]


def _answer(rows: list[dict[str, Any]]) -> str:
    aligned = [row for row in rows if row["ate_m"] is not None]
    within = sum(row["ate_m"] <= ATE_GOAL for row in aligned)
    lost, frames = sum(row["lost"] for row in rows), sum(row["frames"] for row in rows)
    if not aligned:
        return "No flight was tracked."
    worst = max(aligned, key=lambda row: row["ate_m"])
    return (
        f"{within} of {len(rows)} flights within {100 * ATE_GOAL:.0f} cm ATE, {lost} of {frames} frames lost. "
        f"Largest ATE: {100 * worst['ate_m']:.1f} cm, {worst['flight']} at {worst['speed']:g} m/s."
    )


def _picture(rows: list[dict[str, Any]]) -> bytes:
    """Draw ATE over speed, and the fastest flight of each kind from above, as SVG."""
    names = list(dict.fromkeys(row["flight"] for row in rows))
    figure = Figure(figsize=(3.4 * (1 + len(names)), 3.4), layout="constrained")
    left, *plans = figure.subplots(1, 1 + len(names))
    for i, name in enumerate(names):
        mine = [row for row in rows if row["flight"] == name and row["ate_m"] is not None]
        speeds = sorted({row["speed"] for row in mine})
        means = [100 * np.mean([row["ate_m"] for row in mine if row["speed"] == speed]) for speed in speeds]
        left.plot(speeds, means, "o-", color=f"C{i}", label=name, markersize=5, linewidth=1.2)
    left.axhline(100 * ATE_GOAL, color="0.4", linewidth=0.8, linestyle="--")
    left.set(xlabel="peak speed, m/s", ylabel="ATE, cm", title="error")
    left.set_ylim(bottom=0.0)
    left.grid(alpha=0.3)
    left.legend(fontsize=8, frameon=False)
    for i, (axes, name) in enumerate(zip(plans, names, strict=True)):
        row = max((row for row in rows if row["flight"] == name), key=lambda row: row["speed"])
        axes.plot(*np.array(row["true_xy"]).T, color="0.6", linewidth=2.5, label="true")
        axes.plot(*np.array(row["estimated_xy"]).T, color=f"C{i}", linewidth=1.0, label="estimated")
        axes.set(title=f"{name}, {row['speed']:g} m/s", xlabel="x, m", aspect="equal")
        axes.legend(fontsize=7, frameon=False)
    for axes in (left, *plans):
        axes.spines[["top", "right"]].set_visible(False)
    return pictures.svg(figure)
