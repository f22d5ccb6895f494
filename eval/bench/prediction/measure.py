"""Score every model on the drives of a split: ``bench prediction``."""

import os
import platform
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from vssm_gym.envs.tasks.navigation import Split
from vssm_gym.eval.bench.prediction import models, run
from vssm_gym.eval.bench.prediction.contract import WorldModel
from vssm_gym.eval.bench.prediction.fit import fitted
from vssm_gym.eval.bench.prediction.rows import PIT_BINS, PIT_RANGE, row_of
from vssm_gym.eval.bench.prediction.scores import Scores
from vssm_gym.eval.studies.calibration.split import DIVISIONS, seed_of
from vssm_gym.progress import OnProgress


def score_models(
    candidates: Sequence[WorldModel],
    drives: Sequence[run.MappedDrive],
    *,
    split: Split,
    seed: int,
    on_progress: OnProgress | None = None,
) -> list[dict[str, Any]]:
    """Score models on drives.

    Args:
        candidates: the models.
        drives: of the split.
        split: of scenes and seeds.
        seed: of the random numbers of the models.
        on_progress: called with ("predictions", done, total).

    Returns:
        Rows as :func:`~vssm_gym.eval.bench.prediction.rows.row_of` returns them, model by model.
    """
    total = sum(len(run.times(given.drive)) for given in drives) * len(run.HORIZONS) * len(candidates)
    done = 0

    def on_prediction() -> None:
        nonlocal done
        done += 1
        if on_progress:
            on_progress("predictions", done, total)

    rows = []
    for model in candidates:
        found: dict[float, list[list[Scores]]] = {seconds: [] for seconds in run.HORIZONS}
        for number, given in enumerate(drives):
            scores = run.scored(model, given, seed_of(split, seed, number), on_prediction)
            for seconds, of_drive in scores.items():
                found[seconds].append(of_drive)
        rows += [row_of(model.name, seconds, of_model) for seconds, of_model in found.items()]
    return rows


def measure(
    *,
    split: Split,
    runs: int,
    seed: int,
    folder: Path,
    candidates: Sequence[WorldModel] | None = None,
    on_progress: OnProgress | None = None,
) -> dict[str, Any]:
    """Drive, predict and score; on the train split also estimate what the models take as given.

    Args:
        split: of scenes and seeds.
        runs: number of drives.
        seed: of the drives, the maps and the random numbers of the models.
        folder: where learned maps are kept.
        candidates: models that are scored; by default those of :func:`~vssm_gym.eval.bench.prediction.models.models`.
        on_progress: called while maps are learned, and with ("predictions", done, total).

    Returns:
        ``rows`` as :func:`~vssm_gym.eval.bench.prediction.rows.row_of` returns them, model by model; ``setting``, what
        is needed to repeat them; ``fitted`` on the train split, else None; ``machine``.
    """
    candidates = models.models() if candidates is None else candidates
    drives = list(run.mapped_drives(split, runs, seed, folder, on_progress))
    rows = score_models(candidates, drives, split=split, seed=seed, on_progress=on_progress)
    return {
        "rows": rows,
        "fitted": fitted(drives) if split == "train" else None,
        "setting": {
            "split": split,
            "runs": runs,
            "seed": seed,
            "scenes": DIVISIONS[split].mapped,
            "noise": run.NOISE,
            "sensor_noise": run.SENSOR_NOISE,
            "voxel": run.MAP_VOXEL,
            "pixel_stride": run.PIXEL_STRIDE,
            "every_s": run.PREDICT_EVERY,
            "samples": {"images": models.IMAGE_SAMPLES, "poses": models.POSE_SAMPLES},
            "scales": {model.name: asdict(model.scales) for model in candidates if hasattr(model, "scales")},
            "pit": {"bins": PIT_BINS, "range": PIT_RANGE},
        },
        "machine": {"cores": os.cpu_count(), "processor": platform.machine(), "load": round(os.getloadavg()[0], 1)},
    }
