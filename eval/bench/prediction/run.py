"""Drive through apartments, let each model predict from several times on, and collect the scores of its predictions."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import jax
import numpy as np

from vssm_gym.envs.tasks.navigation import Split
from vssm_gym.eval.bench.prediction.contract import WorldModel
from vssm_gym.eval.bench.prediction.models import with_map
from vssm_gym.eval.bench.prediction.scores import Scores, score
from vssm_gym.eval.studies.calibration.drives import drives
from vssm_gym.eval.studies.calibration.replay import Drive
from vssm_gym.eval.studies.calibration.rows import MAP_VOXEL
from vssm_gym.eval.studies.calibration.split import DIVISIONS
from vssm_gym.geometry.camera import Camera
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD
from vssm_gym.progress import OnProgress
from vssm_gym.slam.map_building import ensure_map

NOISE, SENSOR_NOISE = "mid", "kinect"  # of the drives' execution, which the robot knows, and of its camera
HORIZONS = (1.0, 3.0)  # s ahead
FIRST_PREDICTION, PREDICT_EVERY = 2.0, 2.0  # s: when a model predicts first, and how often
PIXEL_STRIDE = 4  # every fourth row and column is scored: neighbours are correlated


@dataclass(frozen=True)
class MappedDrive:
    """Hold a drive, its scene, and a context with the scene's learned map."""

    scene: str
    drive: Drive

    def image(self, frame: int) -> RGBD:
        """Return a frame as filters take it."""
        return RGBD.from_camera(*self.drive.images[frame])


def mapped_drives(
    split: Split, runs: int, seed: int, folder: Path, on_map: OnProgress | None = None
) -> Iterator[MappedDrive]:
    """Yield drives through the apartments of a split whose maps are learned; they share no image with the maps.

    Args:
        split: of scenes and seeds.
        runs: number of drives.
        seed: of the drives and the maps.
        folder: where maps are kept.
        on_map: called while a map is learned.
    """
    scenes = DIVISIONS[split].mapped
    for scene, drive in drives(scenes, runs, noise=NOISE, sensor_noise=SENSOR_NOISE, split=split, seed=seed):
        learned = _loaded(ensure_map(scene, folder, voxel=MAP_VOXEL, seed=seed, on_progress=on_map))
        context = with_map(drive.context, learned)
        yield MappedDrive(scene, Drive(context, drive.images, drive.commands, drive.planar, drive.contacts))


@lru_cache(maxsize=1)
def _loaded(path: Path) -> VoxelMap:
    return VoxelMap.load(path)


def every_nth(camera: Camera, n: int) -> Camera:
    """Return the camera of every n-th pixel, from the middle of the first n on."""
    first = n // 2
    width, height = len(range(first, camera.width, n)), len(range(first, camera.height, n))
    return Camera(width, height, camera.fx / n, camera.fy / n, (camera.cx - first) / n, (camera.cy - first) / n)


def thinned(image: RGBD, n: int) -> RGBD:
    """Return the pixels of an image that the camera of :func:`every_nth` has."""
    return jax.tree.map(lambda a: a[n // 2 :: n, n // 2 :: n], image)


def times(drive: Drive) -> list[int]:
    """Return the frames from which a model predicts: each has the longest horizon ahead."""
    dt = drive.context.dt
    longest = round(max(HORIZONS) / dt)
    return list(range(round(FIRST_PREDICTION / dt), len(drive.planar) - longest, round(PREDICT_EVERY / dt)))


def scored(
    model: WorldModel, given: MappedDrive, seed: int, on_prediction: Callable[[], None] | None = None
) -> dict[float, list[Scores]]:
    """Run a model over a drive, and score its predictions.

    Args:
        model: is begun anew.
        given: the drive.
        seed: of the model's and the scores' random numbers.
        on_prediction: called after every prediction.

    Returns:
        The scores by seconds ahead, in the order of time.
    """
    drive, context = given.drive, given.drive.context
    camera = every_nth(Camera.from_matrix(context.K, *context.camera), PIXEL_STRIDE)
    key, rng = jax.random.key(seed), np.random.default_rng([seed, 5])
    steps = {seconds: round(seconds / context.dt) for seconds in HORIZONS}
    found: dict[float, list[Scores]] = {seconds: [] for seconds in HORIZONS}
    starts = times(drive)
    model.begin(context, given.image(0))
    for frame in range(starts[-1] + 1):
        if frame:
            model.observe(drive.commands[frame - 1], given.image(frame))
        if frame not in starts:
            continue
        for seconds, count in steps.items():
            drawn = jax.random.fold_in(jax.random.fold_in(key, frame), count)
            prediction = model.predict(drive.commands[frame : frame + count], camera, drawn)
            seen = thinned(given.image(frame + count), PIXEL_STRIDE)
            found[seconds].append(score(prediction, seen, drive.planar[frame + count], rng))
            if on_prediction:
                on_prediction()
    return found
