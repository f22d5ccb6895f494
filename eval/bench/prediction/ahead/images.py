"""Render a map where a transition believes the camera to be, and score the image that was taken there."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vssm_gym.data.dynamics.read import INDEXES
from vssm_gym.data.sequences import FrameReader, Sequence, load_sequence
from vssm_gym.errors import InputError
from vssm_gym.eval.bench.prediction.ahead.judged import STEPS_AHEAD, Judged
from vssm_gym.eval.bench.prediction.mixture import SampledImages
from vssm_gym.eval.bench.prediction.models import map_images
from vssm_gym.eval.bench.prediction.run import PIXEL_STRIDE, every_nth, thinned
from vssm_gym.eval.bench.prediction.scores import ImageScores, score_image
from vssm_gym.geometry.camera import Camera
from vssm_gym.maps.voxel_map import VoxelMap, read_metadata
from vssm_gym.model import emission
from vssm_gym.model.emission import RGBD
from vssm_gym.model.emission_density import EmissionScales, has_reading
from vssm_gym.model.spatial_model import SpatialModel
from vssm_gym.model.transition.base import Transition
from vssm_gym.training.dynamics.windows import evenly_spread

STAMP_TOLERANCE = 0.005  # s between the end of a step and its image
CHECKED_IMAGES = 12  # images by which the frame of a map is checked
MAP_NEAR, MAP_NEAR_SHARE = 0.2, 0.1  # m, or a share of the depth: a surface is where the map shows it
LEAST_AGREEING, LEAST_SHOWN = 0.5, 0.1  # least shares of readings: near what the map shows, and shown by it at all


@dataclass(frozen=True)
class Sights:
    """Hold the map and the images of a log.

    Attributes:
        m: the map.
        camera: of every n-th pixel.
        T_body_cam: pose of the camera on the body, m.
        frames: number of the image after ``STEPS_AHEAD`` of each window; -1 where there is none.
        reader: of the images.
        agreeing: share of readings at the true poses that are near what the map shows.
    """

    m: VoxelMap
    camera: Camera
    T_body_cam: Float[Array, "4 4"]
    frames: Int[np.ndarray, "windows steps"]
    reader: FrameReader
    agreeing: float

    def image(self, frame: int) -> RGBD:
        """Return the scored pixels of an image."""
        return thinned(RGBD.from_camera(*self.reader[frame]), PIXEL_STRIDE)


def load_sights(folder: Path, map_file: Path, judged: Judged) -> Sights:
    """Load map and images, and check that they are of one world.

    Args:
        folder: the recording.
        map_file: a map in the world frame of its poses.
        judged: the windows.

    Raises:
        InputError: a log without images, a map that cannot be read or is in another frame, no image where steps end.
    """
    if not any((folder / name).exists() for name in INDEXES):
        raise InputError("bench prediction", "map", f"a recording with images before it; {folder} has none")
    if "sequence" in read_metadata(map_file):
        expected = "a map in the world frame, of `vssm-gym map build`; this one is in its first camera's"
        raise InputError(map_file, "frame", expected)
    m, sequence = VoxelMap.load(map_file), load_sequence(folder)
    assert sequence.T_body_cam is not None  # else the log had no poses of the body
    reader = FrameReader(sequence)
    ends = judged.begins[:, None] + judged.dt * np.array(STEPS_AHEAD)
    frames = _nearest(sequence.times, ends)
    if (frames < 0).all():
        raise InputError(folder, "times", f"an image within {STAMP_TOLERANCE:g} s of the end of a step")
    camera = every_nth(reader.camera, PIXEL_STRIDE)
    T_body_cam = jnp.asarray(sequence.T_body_cam, jnp.float32)
    sights = Sights(m, camera, T_body_cam, frames, reader, 0.0)
    return Sights(m, camera, T_body_cam, frames, reader, _agreement(sights, sequence, map_file))


def _nearest(times: np.ndarray, wanted: np.ndarray) -> Int[np.ndarray, "windows steps"]:
    """Return the numbers of the frames at some times; -1 where the nearest one is too far."""
    after = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    nearest = np.where(wanted - times[after - 1] < times[after] - wanted, after - 1, after)
    return np.where(np.abs(times[nearest] - wanted) <= STAMP_TOLERANCE, nearest, -1)


def _agreement(sights: Sights, sequence: Sequence, map_file: Path) -> float:
    """Return the share of readings that lie near what the map shows from the true poses; raise where it is low."""
    scored = np.unique(sights.frames[sights.frames >= 0])
    chosen = scored[evenly_spread(len(scored), CHECKED_IMAGES)]
    poses = sequence.true_poses()
    counts = np.zeros(3)
    for frame in chosen:
        image = sights.image(frame)
        shown = emission.render(sights.m, jnp.asarray(poses[frame], jnp.float32), sights.camera)
        counts += np.asarray(_near(image, shown), float)
    readings, visible, near = counts
    share, agreeing = visible / max(readings, 1.0), near / max(visible, 1.0)
    if share < LEAST_SHOWN or agreeing < LEAST_AGREEING:
        expected = f"a map in the world frame of {sequence.root}: from its true poses the map shows a surface for"
        found = f"{share:.0%} of the readings (least {LEAST_SHOWN:.0%}), of which {agreeing:.0%} are near it"
        raise InputError(map_file, "frame", f"{expected} {found} (least {LEAST_AGREEING:.0%})")
    return float(agreeing)


@jax.jit
def _near(image: RGBD, shown: RGBD) -> Float[Array, "3"]:
    """Count readings, those for which the map shows a surface, and those that are near it."""
    read = has_reading(image)
    visible = read & shown.hit & shown.known
    near = jnp.abs(image.depth - shown.depth) <= jnp.maximum(MAP_NEAR, MAP_NEAR_SHARE * image.depth)
    return jnp.stack([jnp.sum(read), jnp.sum(visible), jnp.sum(visible & near)])


def score_images(
    nominal: Transition, states: Any, sights: Sights, seed: int, on_image: Callable[[], None] | None = None
) -> list[list[ImageScores | None]]:
    """Score the predicted images of every window after ``STEPS_AHEAD``.

    Args:
        nominal: of whose manifold the states are: one for all models, so that one program renders for all.
        states: futures, axes ``(windows, samples, steps, ...)``.
        sights: map and images.
        seed: of the randomised PIT of colour.
        on_image: called after each image.

    Returns:
        Scores by window and step; None where there is no image.
    """
    scales, rng = EmissionScales(), np.random.default_rng([seed, 5])
    spatial = SpatialModel(nominal, sights.m, sights.camera, sights.T_body_cam, scales)
    found: list[list[ImageScores | None]] = []
    for window, frames in enumerate(sights.frames):
        found.append([])
        for step, frame in enumerate(frames):
            scores = None
            if frame >= 0:
                samples = jax.tree.map(lambda a, at=(window, slice(None), step): jnp.asarray(a[at]), states)
                images, depth_std, rgb_std = map_images(spatial, samples)
                scores = score_image(SampledImages(images, scales, depth_std, rgb_std), sights.image(frame), rng)
            found[-1].append(scores)
            if on_image:
                on_image()
    return found
