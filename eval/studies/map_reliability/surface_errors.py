"""Learn maps of simulated apartments, and compare their surfaces with the true ones.

The error at a point of a map's surface is the true signed distance there, to the nearest face of any box of the scene:
positive where the map shows a surface before the real one. Its stated std is
:func:`~vssm_gym.maps.surface_std.surface_std`, of the poses too where they were estimated.
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vssm_gym.data.recording import record
from vssm_gym.data.sequences import FrameReader, load_sequence
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.scenes.solids import signed_distance
from vssm_gym.errors import InputError
from vssm_gym.eval.metrics.surfaces import sample_mesh
from vssm_gym.maps.surface_std import surface_std
from vssm_gym.progress import OnProgress
from vssm_gym.slam.drive_poses import estimate_poses
from vssm_gym.slam.map_building import Poses, map_from_frames
from vssm_gym.viz.mesh import surface_mesh

POINTS = 10_000  # of a map's surface, uniform over its area
LARGEST_ERROR = 0.2  # m: farther surfaces are no displaced ones, but things that are not there


@dataclass(frozen=True)
class SurfaceErrors:
    """Hold errors and stated stds of points of one map's surface, m."""

    error: Float[np.ndarray, "n"]
    std: Float[np.ndarray, "n"]


def measure(
    scene: str, *, poses: Poses, sensor_noise: str, voxel: float, seed: int, on_progress: OnProgress | None = None
) -> SurfaceErrors:
    """Drive through an apartment, learn its map as ``vssm-gym map build`` does, and compare it with the scene.

    Args:
        scene: name of an apartment.
        poses: at which images enter the map: recorded (true) or estimated ones.
        sensor_noise: of the camera.
        voxel: edge of a cell, m.
        seed: of the drive and the noise.
        on_progress: called while the drive is made, the poses are estimated and the map is built.

    Raises:
        InputError: a drive whose map shows no surface.
    """
    with tempfile.TemporaryDirectory(prefix="vssm-gym-drive-") as folder:
        drive = Path(folder) / "drive"
        record(scene, drive, sensor_noise=sensor_noise, seed=seed, on_progress=on_progress)
        sequence, errors = load_sequence(drive), None
        reader = FrameReader(sequence)
        T_world_cam, taken = sequence.true_poses(), np.arange(len(sequence.frames))
        if poses == "estimated":
            estimate = estimate_poses(sequence, voxel, on_progress)
            T_world_cam, taken = estimate.T_world_cam, np.flatnonzero(estimate.accepted)
            errors = estimate.errors(reader.camera)
        frames = [reader[int(i)] for i in taken]
        m = map_from_frames(frames, T_world_cam[taken], reader.camera, voxel, on_progress)
    mesh = surface_mesh(m)
    if not len(mesh.faces):
        raise InputError(scene, "map", "a drive that shows a surface")
    points = sample_mesh(mesh, POINTS, seed)
    std = np.asarray(surface_std(m, jnp.asarray(points, jnp.float32), pose_errors=errors), float)
    distance = signed_distance(points, load_scene(scene).boxes())
    known = np.isfinite(std)
    return SurfaceErrors(np.clip(distance, -LARGEST_ERROR, LARGEST_ERROR)[known], std[known])
