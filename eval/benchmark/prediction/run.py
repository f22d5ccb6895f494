"""Run a world model over a drive in a scene whose map it is given, and score its predictions in nats a pixel."""

import hashlib
import math
import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import numpy as np

from vssm_gym.agents.base import AgentContext
from vssm_gym.eval.bench.prediction.contract import Prediction
from vssm_gym.eval.bench.prediction.models import with_map
from vssm_gym.eval.bench.prediction.run import HORIZONS, NOISE, PIXEL_STRIDE, SENSOR_NOISE, MappedDrive, scored, thinned
from vssm_gym.eval.bench.prediction.scores import Scores
from vssm_gym.eval.benchmark.entries import find_entry
from vssm_gym.eval.benchmark.prediction.densities import MOST_MASS, masses
from vssm_gym.eval.studies.calibration.drives import drives
from vssm_gym.eval.studies.calibration.split import seed_of
from vssm_gym.eval.sweep.supervision import Supervisor
from vssm_gym.geometry.camera import MAX_DEPTH, Camera
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD

# Nats of a pixel by who knows nothing: a reading or none, any depth in range, any colour; what a failure is worth
UNINFORMED = math.log(0.5) - math.log(MAX_DEPTH)


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
        return f"{Path(self.scene).stem}-{self.number}"


class _Timed:
    """Time a model, keep what it predicts for the nearest horizon, and wait for what it computes."""

    def __init__(self, model: Any, nearest: int) -> None:
        self._model, self._nearest = model, nearest
        self.name = str(model.name)
        self.seconds: dict[int, list[float]] = {}  # of each prediction, by the number of commands
        self.kept: list[tuple[int, Prediction]] = []  # with the frame that it is of
        self._frame = 0

    def begin(self, context: AgentContext, image: RGBD) -> None:
        self._model.begin(context, image)

    def observe(self, command: np.ndarray, image: RGBD) -> None:
        self._frame += 1
        self._model.observe(command, image)

    def predict(self, commands: np.ndarray, camera: Camera, key: Any) -> Prediction:
        began = time.perf_counter()
        prediction: Prediction = jax.block_until_ready(self._model.predict(commands, camera, key))
        self.seconds.setdefault(len(commands), []).append(time.perf_counter() - began)
        if len(commands) == self._nearest:
            self.kept.append((self._frame + self._nearest, prediction))
        return prediction


def run_drive(unit: PredictionUnit) -> dict[str, Any]:
    """Run the entry of a unit on its drive, and return the row."""
    given = _drives(unit.scene, unit.count, unit.seed, unit.map_file)[unit.number]
    supervisor = Supervisor(unit.seconds)
    model = _Timed(find_entry(unit.reference).make(), round(min(HORIZONS) / given.drive.context.dt))
    seed = seed_of("test", unit.seed, unit.number)
    found = supervisor.call(lambda: scored(model, given, seed))
    nats = {} if found is None else {seconds: _nats(of) for seconds, of in found.items()}
    if found is not None and not all(map(math.isfinite, nats.values())):
        supervisor.fail("its log densities are not all finite")
    if supervisor.fault is None:
        mass = supervisor.call(lambda: _masses(model, given, seed))
        if mass is not None and not max(mass) <= MOST_MASS:
            supervisor.fail(f"its densities integrate to {mass[0]:.3g} for depth and {mass[1]:.3g} for colour, not 1")
    warm = [seconds for of in model.seconds.values() for seconds in of[1:]]  # the first of each length compiles
    valid = supervisor.fault is None
    return {
        "score": float(np.mean(list(nats.values()))) if valid else UNINFORMED,
        "success": valid,
        "fault": supervisor.fault,
        "p95": float(np.percentile(warm, 95)) if warm else None,
        "measured": {f"nats_{seconds:g}_s": value for seconds, value in nats.items()} if valid else {},
        "content": hashlib.sha256(given.drive.planar.round(3).tobytes()).hexdigest()[:16],
    }


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


def _nats(of_drive: list[Scores]) -> float:
    """Return the mean log density of a pixel over the predictions of a drive."""
    return float(np.mean([np.mean(scores.depth_nats + scores.rgb_nats) for scores in of_drive]))


def _masses(model: _Timed, given: MappedDrive, seed: int) -> tuple[float, float]:
    """Return what the kept predictions integrate to on average, for depth and for colour."""
    rng = np.random.default_rng([seed, 7])
    found = [masses(made, thinned(given.image(frame), PIXEL_STRIDE), rng) for frame, made in model.kept]
    depth, rgb = np.mean(found, axis=0)
    return float(depth), float(rgb)
