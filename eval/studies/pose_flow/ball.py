"""Define the toy world: one ball of one colour in free space, and one noisy RGB-D image of it (VSSM-LM, fig. 5.4)."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import inverse, se3_exp
from vssm_gym.inference.filter import Rig
from vssm_gym.inference.smoothing.pose_posterior import View
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model import emission
from vssm_gym.model.emission import RGBD
from vssm_gym.model.emission_density import EmissionScales

RADIUS = 0.4  # m, of the ball, whose centre is the world's origin
DISTANCE = 1.5  # m, of the camera from it
BALL_VOXEL, BALL_EXTENT = 0.05, 1.2  # m, of the map
COLOUR = np.array([0.80, 0.20, 0.15])  # of the ball
CELL_PRECISION = 1e4  # precision of the cells: the map is known
TURN = (0.4, 0.9, 0.2)  # rad: the side that the camera is on
# Free space gives no reading: where no surface is predicted, none is the rule.
BALL_SCALES = EmissionScales(miss=0.02, empty_miss=0.98, outlier=0.02)
CAMERA = Camera.from_hfov(20, 15, np.radians(70.0))  # pixels, angle of view


def true_pose() -> Float[np.ndarray, "4 4"]:
    """Return ``T_world_cam`` of the camera, which looks at the ball."""
    back = np.eye(4)
    back[2, 3] = -DISTANCE
    return np.asarray(se3_exp(jnp.array([0.0, 0.0, 0.0, *TURN])), float) @ back


def ball_map() -> VoxelMap:
    """Return the map of the ball: exact signed distances in its cells."""
    m = VoxelMap.cube((0.0, 0.0, 0.0), BALL_EXTENT, BALL_VOXEL)
    cells = np.stack(np.meshgrid(*(np.arange(n) for n in m.shape), indexing="ij"), axis=-1)
    occupancy = RADIUS - np.linalg.norm(np.asarray(m.origin) + BALL_VOXEL * cells, axis=-1)
    colour = np.broadcast_to(COLOUR, (*m.shape, 3))
    certain = jnp.full_like(m.occupancy_precision, CELL_PRECISION)
    m = replace(
        m,
        occupancy_precision=certain,
        colour_precision=certain,
        colour=m.blocked(jnp.asarray(colour, jnp.float32)),
    )
    return m.with_occupancy(m.blocked(jnp.asarray(occupancy, jnp.float32)))


def view(seed: int) -> View:
    """Return one image of the ball, with the emission's noise of depth, colour and missing readings.

    Args:
        seed: of the noise.
    """
    m, rng = ball_map(), np.random.default_rng(seed)
    exact = emission.render(m, jnp.asarray(true_pose(), jnp.float32), CAMERA)
    hit = np.asarray(exact.hit) & (rng.uniform(size=exact.hit.shape) > BALL_SCALES.miss)
    depth = np.asarray(exact.depth)
    depth = np.where(hit, depth + rng.laplace(0.0, np.asarray(BALL_SCALES.depth_at(exact.depth))), 0.0)
    rgb = np.clip(np.asarray(exact.rgb) + rng.normal(0.0, BALL_SCALES.rgb, (*hit.shape, 3)), 0.0, 1.0)
    image = RGBD(
        jnp.asarray(depth, jnp.float32),
        jnp.asarray(np.where(hit[..., None], rgb, 0.0), jnp.float32),
        jnp.asarray(hit),
        jnp.asarray(hit),
    )
    return View(image, m, Rig.of(CAMERA), BALL_SCALES)


def ball_in_camera(T_world_cam: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 3"]:
    """Return the centre of the ball in the camera's frame, m: the true pose has it at ``(0, 0, DISTANCE)``."""
    return np.asarray(inverse(np.asarray(T_world_cam, float)))[:, :3, 3]
