"""Build the maps that agents are given: closed-form updates over a recording (TNP-SM, off-line map).

The poses are either those recorded with it, as from a motion-capture system, or PRISM's estimates.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, Protocol

import jax.numpy as jnp
import numpy as np

from vssm_gym.data.recording import read_provenance, record
from vssm_gym.data.sequences import FrameReader, Sequence, load_sequence
from vssm_gym.envs.rendering.raycast import RaycastCamera
from vssm_gym.envs.scenes.generator import recorded_spec
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.scenes.solids import SolidBox, signed_distance
from vssm_gym.envs.scenes.specs import scene_name
from vssm_gym.errors import InputError
from vssm_gym.files.output_folders import ADVICE
from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.mapping.map_update import MapUpdateConfig, update
from vssm_gym.maps.cell_centres import cell_centres
from vssm_gym.maps.pose_errors import PoseErrors
from vssm_gym.maps.voxel_map import OBSERVED_PRECISION, TRUNCATION, VoxelMap, read_metadata
from vssm_gym.progress import OnProgress
from vssm_gym.slam.drive_poses import estimate_poses
from vssm_gym.version import package_version

Poses = Literal["recorded", "estimated"]
Surfaces = Literal["learned", "exact"]

BOUNDS_MARGIN = 0.25  # m around the farthest points seen, for the truncation band and the noise of other frames
LOOKED_AT = 200  # about how many frames the bounds are computed from
MAX_MAP_CELLS = 40_000_000  # 25 bytes each: 1 GB
NOISE = "low"  # execution noise of the drive that a map is learned from


def build_map(
    sequence: Sequence,
    voxel: float,
    on_progress: OnProgress | None = None,
    warn: Callable[[tuple[str, ...]], None] | None = None,
    poses: Poses = "recorded",
) -> VoxelMap:
    """``q(M) ∝ p(M) prod_t q(M | x_t, z_t)`` over a sequence, at recorded or estimated poses ``z_t``.

    The grid spans the observed depth readings, not the known extent of the scene.

    Args:
        sequence: with ``groundtruth.txt``; only its first pose is read if poses are estimated.
        voxel: cell size, m.
        on_progress: called after every frame.
        warn: called at the end with the damaged frames, which count as empty.
        poses: ``recorded`` takes the ground truth, ``estimated`` those that PRISM finds in images and controls.

    Returns:
        The map; z is the world's z. At estimated poses it holds their errors.

    Raises:
        InputError: no ground truth, no depth at all, or a space too large for cells of this size.
    """
    reader = FrameReader(sequence)
    taken, chosen, errors = _poses(sequence, reader.camera, voxel, poses, on_progress)
    m = replace(_fused(reader, taken, reader.camera, voxel, chosen, on_progress, sequence.root), pose_errors=errors)
    if warn:
        warn(reader.notices)
    return m


class Frames(Protocol):
    """Provide images by number, such as a list of pairs or a :class:`~vssm_gym.data.sequences.FrameReader`."""

    def __len__(self) -> int:
        """Return the number of images."""
        ...

    def __getitem__(self, index: int, /) -> tuple[np.ndarray, np.ndarray]:
        """Return colour ``(height, width, 3)`` uint8 and z-depth ``(height, width)``, m; 0 = no reading."""
        ...


def map_from_frames(
    frames: Frames, T_world_cam: np.ndarray, camera: Camera, voxel: float = 0.05, on_progress: OnProgress | None = None
) -> VoxelMap:
    """``q(M) ∝ p(M) prod_t q(M | x_t, z_t)``: fuse RGB-D images at known poses into a map, in closed form (PRISM).

    The grid spans what the depth images show.

    Args:
        frames: ``(rgb, depth)`` of each image: colour ``(height, width, 3)`` uint8, z-depth ``(height, width)`` in
            metres with 0 where there is no reading; each is read twice.
        T_world_cam: ``(n, 4, 4)`` pose of the camera at each image.
        camera: intrinsics and size of the images.
        voxel: cell size, m.
        on_progress: called with ``("map", images done, images)`` after every image.

    Returns:
        The map; z is the world's z.

    Raises:
        InputError: not one pose for each image, no depth at all, or a space too large for cells of this size.
    """
    poses = np.asarray(T_world_cam, np.float64)
    if poses.shape != (len(frames), 4, 4):
        raise InputError("map_from_frames", "T_world_cam", f"({len(frames)}, 4, 4) poses; found {poses.shape}")
    return _fused(frames, poses, camera, voxel, list(range(len(frames))), on_progress, "map_from_frames")


def _fused(
    frames: Frames,
    T_world_cam: np.ndarray,
    camera: Camera,
    voxel: float,
    chosen: list[int],
    on_progress: OnProgress | None,
    source: object,
) -> VoxelMap:
    """Fuse the ``chosen`` images into a grid that spans all of them."""
    config = MapUpdateConfig()
    low, high = grid_bounds(frames, T_world_cam, camera, config, source)
    shape = tuple(int(n) for n in np.ceil((high - low) / voxel).astype(int) + 1)
    if np.prod(shape) > MAX_MAP_CELLS:
        raise InputError("map", "voxel", f"larger cells: {high - low} m at {voxel} m makes {np.prod(shape):,} of them")
    m = VoxelMap.prior(low, voxel, (shape[0], shape[1], shape[2]))
    for done, i in enumerate(chosen, 1):
        rgb, depth = frames[i]
        colour, pose = jnp.asarray(rgb, jnp.float32) / 255.0, jnp.asarray(T_world_cam[i], jnp.float32)
        m = update(m, jnp.asarray(depth), colour, pose, camera, config)
        if on_progress:
            on_progress("map", done, len(chosen))
    return m


def _poses(
    sequence: Sequence, camera: Camera, voxel: float, poses: Poses, on_progress: OnProgress | None
) -> tuple[np.ndarray, list[int], PoseErrors | None]:
    """Return ``T_world_cam`` of each frame, which frames enter the map, and the errors of estimated poses."""
    if poses == "recorded":
        return sequence.true_poses(), list(range(len(sequence.frames))), None
    estimate = estimate_poses(sequence, voxel, on_progress)
    return estimate.T_world_cam, np.flatnonzero(estimate.accepted).tolist(), estimate.errors(camera)


def grid_bounds(
    frames: Frames, T_world_cam: np.ndarray, camera: Camera, config: MapUpdateConfig, source: object
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the box around the back-projected depths of some images, with a margin.

    Raises:
        InputError: ``source`` has no depth reading at all.
    """
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    rays = _rays(camera)
    for i in range(0, len(T_world_cam), max(1, len(T_world_cam) // LOOKED_AT)):
        depth = frames[i][1]
        seen = (depth > config.min_depth) & (depth <= config.max_depth)
        if seen.any():
            p_world = (rays[seen] * depth[seen][:, None]) @ T_world_cam[i, :3, :3].T + T_world_cam[i, :3, 3]
            low, high = np.minimum(low, p_world.min(axis=0)), np.maximum(high, p_world.max(axis=0))
    if not np.isfinite(low).all():
        raise InputError(source, "depth", "readings; every sampled pixel has none")
    return low - BOUNDS_MARGIN, high + BOUNDS_MARGIN


def _rays(camera: Camera) -> np.ndarray:
    """Return ``K^-1 [i, j, 1]``, float64 ``(height, width, 3)``."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    homogeneous = np.stack([u, v, np.ones_like(u)], axis=-1)
    return homogeneous @ np.linalg.inv(camera.K).T


def ensure_map(
    scene: str,
    folder: Path,
    *,
    voxel: float,
    seed: int,
    poses: Poses = "recorded",
    surfaces: Surfaces = "learned",
    on_progress: OnProgress | None = None,
) -> Path:
    """Return the learned map of a scene, ``folder/maps/NAME.npz``; build it from ``folder/recordings/NAME`` if needed.

    Where obstacles were moved after the recording, it was made in the scene before
    (:func:`~vssm_gym.envs.scenes.generator.recorded_spec`). Map and recording are kept. They are used again if scene,
    seed, noise and tracer of the drive, cell size and kind of poses are the same, else refused: results in the folder
    are of these maps.

    Args:
        scene: built-in name or path of a scene file.
        folder: of a sweep.
        voxel: cell size, m.
        seed: of the recorded drive.
        poses: at which the images enter the map: see :func:`build_map`.
        surfaces: ``exact`` replaces what it has learned by :func:`with_exact_surfaces`, for budgets of errors.
        on_progress: called after every frame recorded and every frame mapped.

    Raises:
        InputError: a scene that cannot be used, or a map or recording of another origin at its place.
    """
    name, before = scene_name(scene), recorded_spec(scene)
    apartment = load_scene(before)
    origin: dict[str, str | int] = {
        "scene_hash": apartment.content_hash(),
        "seed": seed,
        "noise": NOISE,
        "renderer": RaycastCamera.name,
    }
    map_file, recording = folder / "maps" / f"{name}.npz", folder / "recordings" / scene_name(before)
    if map_file.exists():
        found = {"surfaces": "learned"} | read_metadata(map_file)
        _check_origin(map_file, "map", found, origin | {"voxel": voxel, "poses": poses, "surfaces": surfaces})
        if poses == "estimated" and "pose_errors" not in found:
            raise InputError(map_file, "pose_errors", f"the errors of its estimated poses; found none ({ADVICE})")
        return map_file
    if recording.exists():
        _check_origin(recording, "recording", read_provenance(recording), origin)
    else:
        recording.parent.mkdir(parents=True, exist_ok=True)
        record(before, recording, noise=NOISE, seed=seed, on_progress=on_progress)
    voxel_map = build_map(load_sequence(recording), voxel, on_progress, poses=poses)
    if surfaces == "exact":
        voxel_map = with_exact_surfaces(voxel_map, apartment.boxes())
    map_file.parent.mkdir(parents=True, exist_ok=True)
    made = {"voxel": voxel, "poses": poses, "surfaces": surfaces, "package_version": package_version()}
    voxel_map.save(map_file, **origin, **made)
    return map_file


def with_exact_surfaces(m: VoxelMap, boxes: list[SolidBox]) -> VoxelMap:
    """Return the map with ``-signed distance``, truncated, in all of its observed cells; what it saw stays as it is.

    Args:
        m: learned from images, world frame.
        boxes: the solids of its scene.
    """
    observed = np.asarray(m.occupancy_precision) > OBSERVED_PRECISION
    largest = TRUNCATION * float(m.voxel_size)
    occupancy = np.array(m.occupancy)
    occupancy[observed] = np.clip(-signed_distance(cell_centres(m, observed), boxes, largest), -largest, largest)
    return m.with_occupancy(jnp.asarray(occupancy))


def _check_origin(path: Path, what: str, found: dict[str, Any], wanted: dict[str, Any]) -> None:
    """Raise :class:`InputError` for the first field of its origin in which a map or recording differs."""
    for field, value in wanted.items():
        if found.get(field) != value:
            expected = f"a {what} with {value}; found {found.get(field)} ({ADVICE})"
            raise InputError(path, field, expected)
