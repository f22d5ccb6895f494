"""Run a world model over a drive in a scene whose map it is given, and score its predictions in nats a pixel."""

import math
import time
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from vssm_gym.envs.scenes.specs import scene_name
from vssm_gym.eval.bench.prediction.contract import Prediction
from vssm_gym.eval.bench.prediction.models import with_map
from vssm_gym.eval.bench.prediction.run import (
    HORIZONS,
    NOISE,
    PIXEL_STRIDE,
    SENSOR_NOISE,
    MappedDrive,
    every_nth,
    thinned,
    times,
)
from vssm_gym.eval.benchmark.content import IMAGES_APART, content_of
from vssm_gym.eval.benchmark.entries import find_entry
from vssm_gym.eval.benchmark.prediction.levels import UNINFORMED
from vssm_gym.eval.benchmark.prediction.levels import nats as nats_of
from vssm_gym.eval.benchmark.suite import given_seed
from vssm_gym.eval.studies.calibration.drives import drives
from vssm_gym.eval.studies.calibration.split import seed_of
from vssm_gym.eval.sweep.supervision import Supervisor
from vssm_gym.geometry.camera import Camera
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD


@dataclass(frozen=True)
class PredictionUnit:
    """Hold one run: an entry, one of the drives through a scene, and the time that the entry may use, s."""

    entry: str  # label
    reference: str
    scene: str
    number: int
    count: int  # drives of the scene
    seed: int
    map_file: Path
    seconds: float

    @property
    def unit(self) -> str:
        """Return the drive's name."""
        return f"{scene_name(self.scene)}-{self.number}"

    @property
    def cluster(self) -> str:
        """Return the scene's name."""
        return scene_name(self.scene)


def run_drive(unit: PredictionUnit) -> dict[str, Any]:
    """Run the entry of a unit on its drive, and return the row.

    The model's time is that of `begin`, `observe` and `predict`; what a prediction takes to be scored has a limit of
    its own, as large. A prediction is scored before the model sees the next image.
    """
    given = _drives(unit.scene, unit.count, unit.seed, unit.map_file)[unit.number]
    drive, context = given.drive, given.drive.context
    model, scorer = Supervisor(unit.seconds), Supervisor(unit.seconds)
    entry: Any = model.call(lambda: find_entry(unit.reference).make())
    model.call(lambda: entry.begin(context, given.image(0)))
    camera = every_nth(Camera.from_matrix(context.K, *context.camera), PIXEL_STRIDE)
    key = jax.random.key(given_seed(seed_of("test", unit.seed, unit.number)))
    nats: dict[float, list[float]] = {seconds: [] for seconds in HORIZONS}
    took: dict[float, list[float]] = {seconds: [] for seconds in HORIZONS}
    starts = times(drive)
    for frame in range(starts[-1] + 1):
        if frame:
            model.call(partial(_observe, entry, drive.commands[frame - 1], given.image(frame)))
        for seconds in HORIZONS if frame in starts else ():
            count = round(seconds / context.dt)
            drawn = jax.random.fold_in(jax.random.fold_in(key, frame), count)
            began = time.perf_counter()
            made: Any = model.call(
                partial(_predict, entry, drive.commands[frame : frame + count].copy(), camera, drawn)
            )
            took[seconds].append(time.perf_counter() - began)
            seen = thinned(given.image(frame + count), PIXEL_STRIDE)
            if model.fault is None:
                of_image = scorer.call(partial(_mean_nats, made, seen))
                nats[seconds].append(math.nan if of_image is None else of_image)
        if model.fault is not None or scorer.fault is not None:
            break
    warm = [one for of in took.values() for one in of[1:]]  # the first of each length compiles
    fault = model.fault or scorer.fault
    mean = {seconds: float(np.mean(of)) for seconds, of in nats.items()} if fault is None else {}
    return {
        "score": max(float(np.mean(list(mean.values()))), UNINFORMED) if mean else UNINFORMED,
        "success": fault is None,
        "fault": fault,
        "p95": float(np.percentile(warm, 95)) if warm else None,
        "measured": {f"nats_{seconds:g}_s": value for seconds, value in mean.items()},
        "content": content_of(drive.planar, drive.images[::IMAGES_APART]),
    }


def _observe(entry: Any, command: np.ndarray, image: RGBD) -> None:
    entry.observe(command.copy(), image)


def _predict(entry: Any, commands: np.ndarray, camera: Camera, key: Any) -> Any:
    """Return a prediction once it is computed."""
    return jax.block_until_ready(entry.predict(commands, camera, key))


def _mean_nats(prediction: Prediction, image: RGBD) -> float:
    return float(np.mean(nats_of(prediction, image, SENSOR_NOISE)))


@lru_cache(maxsize=1)
def _drives(scene: str, count: int, seed: int, map_file: Path) -> list[MappedDrive]:
    """Return the drives through a scene, all of which are driven, because each drive counts only without contacts."""
    learned, found = VoxelMap.load(map_file), []
    for _, drive in drives((scene,), count, noise=NOISE, sensor_noise=SENSOR_NOISE, split="test", seed=seed):
        context = with_map(drive.context, learned)
        found.append(
            MappedDrive(scene, type(drive)(context, drive.images, drive.commands, drive.planar, drive.contacts))
        )
    return found
