"""Estimate the poses of a robot's recorded drive by PRISM from images and commands; only the start is known.

A map made at these poses uses no ground truth: it is the map that the robot itself would have.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from vssm_gym.data.recording import read_provenance
from vssm_gym.data.sequences import FrameReader, Sequence
from vssm_gym.envs.robots import NOISE_LEVELS
from vssm_gym.errors import InputError
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import inverse, matrix_to_planar, planar_to_matrix
from vssm_gym.inference.filter import KNOWN_START_STD, Rig
from vssm_gym.inference.registry import FILTERS
from vssm_gym.maps.pose_errors import PoseErrors
from vssm_gym.maps.voxel_map import DEFAULT_SLOTS, VoxelMap
from vssm_gym.model.emission import RGBD
from vssm_gym.model.posterior import Posterior
from vssm_gym.model.transition import MotionNoise, Planar, planar_belief
from vssm_gym.progress import OnProgress

MAP_REACH = 12.0  # m: half the map's edge along x and y, around the start of the drive
MAP_LOW, MAP_HIGH = -0.5, 3.5  # m above the floor: lower and upper end of the map
KEYFRAMES = 64  # of a drive at most, whose errors are followed


@dataclass(frozen=True)
class DrivePoses:
    """Hold the estimated poses."""

    T_world_cam: Float[np.ndarray, "frames 4 4"]  # float64
    accepted: Bool[np.ndarray, "frames"]  # False: the pose follows the commands alone
    drift: Float[np.ndarray, "frames 6 6"]  # covariance of the map's frame around the body, in the world's tangent

    def errors(self, camera: Camera) -> PoseErrors:
        """Return the errors of the accepted poses, at ``KEYFRAMES`` of them at most, evenly spaced."""
        accepted = np.flatnonzero(self.accepted)
        kept = accepted[:: -(-len(accepted) // KEYFRAMES)]
        return PoseErrors.of(self.T_world_cam[kept], self.drift[kept], camera)


def estimate_poses(sequence: Sequence, voxel: float, on_progress: OnProgress | None = None) -> DrivePoses:
    """Estimate ``q(z_1:T)`` by PRISM with the planar transition, from the first true pose on.

    Args:
        sequence: a survey of ``vssm-gym record``: images, commands, ``T_body_cam``, and the robot's noise level.
        voxel: cell size of the filter's map, m.
        on_progress: called with ("poses", frames done, frames).

    Raises:
        InputError: a recording without a robot's commands, a drive too far from its start, or too small cells.
    """
    made = read_provenance(sequence.root)
    if (robot := made.get("robot", "holonomic")) != "holonomic":
        raise InputError(sequence.root, "robot", f"holonomic, whose commands tell its motion; found {robot!s:.80}")
    noise = NOISE_LEVELS.get(str(made.get("noise")))
    if noise is None or sequence.T_body_cam is None or sequence.controls.shape != (len(sequence.frames), 4):
        expected = "a survey that `vssm-gym record` drove: commands, T_body_cam and the noise of the drive"
        raise InputError(sequence.root, "controls", expected)
    reader = FrameReader(sequence)
    rig = Rig.of(reader.camera, sequence.T_body_cam)
    start = matrix_to_planar(jnp.asarray(sequence.true_poses()[0], jnp.float32) @ inverse(rig.T_body_cam))
    low = np.array([float(start[0]) - MAP_REACH, float(start[1]) - MAP_REACH, MAP_LOW])
    sides = np.array([2.0 * MAP_REACH, 2.0 * MAP_REACH, MAP_HIGH - MAP_LOW])
    nx, ny, nz = (int(n) for n in np.ceil(sides / voxel))
    sparse = VoxelMap.prior(low, voxel, (nx, ny, nz), slots=DEFAULT_SLOTS)
    motion = Planar(MotionNoise(noise.turn, noise.step))
    prism = FILTERS["prism"].make(rig, motion)
    known = planar_belief(start, KNOWN_START_STD**2 * jnp.eye(3))
    state = prism.init(Posterior(known, sparse), RGBD.from_camera(*reader[0]), jax.random.key(0))
    planar, accepted, drift = [np.asarray(start, float)], [True], [np.zeros((6, 6))]
    for i in range(1, len(reader)):
        control = jnp.asarray(sequence.controls[i, 1:], jnp.float32)
        state, info = prism.step(
            state, control, RGBD.from_camera(*reader[i]), float(sequence.times[i] - sequence.times[i - 1])
        )
        planar.append(np.asarray(prism.posterior(state).belief.mean, float))
        accepted.append(info.status.accepted)
        drift.append(np.asarray(state.past.considered.drift, float))
        if np.abs(planar[-1][:2] - planar[0][:2]).max() > MAP_REACH - 1.0:
            raise InputError(sequence.root, "controls", f"a drive that stays within {MAP_REACH - 1.0} m of its start")
        if on_progress:
            on_progress("poses", i + 1, len(reader))
    if state.map.table is not None and (refused := int(state.map.table.refused)):
        raise InputError("map", "voxel", f"larger cells: {refused} blocks of the drive found no room at {voxel} m")
    T_world_body = np.asarray(planar_to_matrix(jnp.asarray(np.array(planar), jnp.float32)), float)
    return DrivePoses(T_world_body @ sequence.T_body_cam, np.array(accepted), np.array(drift))
