"""Measure ``bench prediction LOG``: a learned transition against plain integration, 100 steps ahead on a log."""

import os
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.eval.bench.prediction.ahead.euler import fit_euler, plain
from vssm_gym.eval.bench.prediction.ahead.images import Sights, load_sights, score_images
from vssm_gym.eval.bench.prediction.ahead.judged import STEPS_AHEAD, Judged, read_judged
from vssm_gym.eval.bench.prediction.ahead.rows import Seen, gains_of, rows_of
from vssm_gym.eval.bench.prediction.ahead.states import FUTURES, Foreseen, foresee
from vssm_gym.eval.bench.prediction.models import IMAGE_SAMPLES
from vssm_gym.eval.bench.prediction.run import PIXEL_STRIDE
from vssm_gym.model.emission_density import EmissionScales
from vssm_gym.model.transition.learned_file import TransitionFile, load_transition, transition_hash
from vssm_gym.progress import OnProgress

NO_IMAGES = "no map was given (`--map`), or the log has no images: states alone were predicted"


@dataclass(frozen=True)
class Measured:
    """Hold what was measured.

    Attributes:
        result: rows and setting, as JSON values.
        foreseen: states by model, for the picture.
        judged: the windows.
    """

    result: dict[str, Any]
    foreseen: dict[str, Foreseen]
    judged: Judged


def measure_ahead(
    log: Path,
    transition: Path,
    *,
    map_file: Path | None = None,
    fit: Sequence[Path] = (),
    seed: int = 0,
    on_progress: OnProgress | None = None,
) -> Measured:
    """Predict windows of a log by both models, and score states and images.

    Args:
        log: that is predicted: what `train-dynamics` reads.
        transition: a file of `train-dynamics`.
        map_file: a map in the world frame of the log's poses; None: no images are predicted.
        fit: logs that the noise of plain integration is fitted to; none: the first third of ``log``.
        seed: of the samples.
        on_progress: called with ("predicted windows", done, total) and ("predicted images", done, total).

    Raises:
        InputError: a file that is missing or does not fit the others.
    """
    stored = load_transition(transition)
    judged = read_judged(log, stored, fit)
    sights = None if map_file is None else load_sights(log, map_file, judged)
    noise = measured_noise(stored, transition)
    euler = fit_euler(stored.transition, judged.fitted, judged.dt, noise)
    models = {"euler": euler.transition, "learned": stored.transition}
    windows = _Counted("predicted windows", len(models) * len(judged.data), on_progress)
    foreseen = {name: foresee(model, judged, noise, seed, windows) for name, model in models.items()}
    seen: dict[str, Seen | None] = dict.fromkeys(models)
    if sights is not None:
        images = _Counted("predicted images", len(models) * sights.frames.size, on_progress)
        nominal = plain(stored.transition)
        for name, states in foreseen.items():
            seen[name] = score_images(nominal, states.states, sights, seed, images)
    rows = [row for name, states in foreseen.items() for row in rows_of(name, judged, states, seen[name])]
    result = {
        "log": judged.log,
        "rows": rows,
        "gains": gains_of(judged, foreseen, rows),
        "curves": {name: _curves(states) for name, states in foreseen.items()},
        "fitted": {"euler": {"gain": euler.gain} | euler.stds},
        "notices": [*judged.notices, *_notices(euler.at_bound, sights)],
        "setting": _setting(judged, stored, transition, map_file, sights, noise, seed),
        "machine": {"cores": os.cpu_count(), "processor": platform.machine(), "load": round(os.getloadavg()[0], 1)},
    }
    return Measured(result, foreseen, judged)


def measured_noise(stored: TransitionFile, path: Path) -> tuple[float, float]:
    """Return the standard deviations of measured positions (m) and rotations (rad) that the training found.

    Raises:
        InputError: the file does not state them.
    """
    stds = stored.trained.get("measured_stds")
    if isinstance(stds, list) and len(stds) == 2 and all(type(std) in (int, float) for std in stds):
        position, rotation = (float(std) for std in stds)
        if 0.0 <= position < np.inf and 0.0 <= rotation < np.inf:
            return position, rotation
    raise InputError(path, "measured_stds", "two numbers, m and rad, as `vssm-gym train-dynamics` writes them")


class _Counted:
    """Count what is done, and report it."""

    def __init__(self, stage: str, total: int, on_progress: OnProgress | None) -> None:
        self._stage, self._total, self._report, self._done = stage, total, on_progress, 0

    def __call__(self) -> None:
        self._done += 1
        if self._report:
            self._report(self._stage, self._done, self._total)


def _curves(states: Foreseen) -> dict[str, list[float]]:
    """Return errors and coverage at every step."""
    held = states.held.mean(axis=0)
    named = {"position": states.position, "rotation": states.rotation, "position_held": held[0], "pose_held": held[1]}
    return {name: [round(float(value), 5) for value in values] for name, values in named.items()}


def _notices(at_bound: bool, sights: Sights | None) -> list[str]:
    """Return sentences about what is missing or limited."""
    bound = "the noise of euler is at its bound: its envelopes may hold less than they should, even where it was fitted"
    return [bound] * at_bound + [NO_IMAGES] * (sights is None)


def _setting(
    judged: Judged,
    stored: TransitionFile,
    transition: Path,
    map_file: Path | None,
    sights: Sights | None,
    noise: tuple[float, float],
    seed: int,
) -> dict[str, Any]:
    """Return what is needed to repeat the rows."""
    about: dict[str, Any] = {
        "log": judged.log,
        "kind": judged.kind,
        "step_s": judged.dt,
        "steps_ahead": STEPS_AHEAD,
        "windows": len(judged.data),
        "stretches": len(set(judged.stretches)),
        "transition": transition.name,
        "transition_hash": transition_hash(transition),
        "learned_from": stored.trained.get("data"),
        "learned_horizon": stored.trained.get("horizon"),
        "noise_of_euler_fitted_on": judged.fitted_on,
        "measured_stds": noise,
        "seed": seed,
        "samples": {"states": FUTURES, "images": IMAGE_SAMPLES},
    }
    if sights is not None and map_file is not None:
        camera = {"width": sights.camera.width, "height": sights.camera.height}
        about |= {"map": map_file.name, "readings_near_the_map": round(sights.agreeing, 4), "camera": camera}
        about |= {"pixel_stride": PIXEL_STRIDE, "scales": asdict(EmissionScales())}
    return about
