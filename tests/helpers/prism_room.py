"""Filter a hand-held walk through the analytic room once, for all tests that use it."""

from collections.abc import Iterator
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from tests.helpers.analytic_room import Room, camera_pose
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import se3_log
from vssm_gym.inference.filter import FilterInfo, Rig
from vssm_gym.inference.prism.config import HAND, PrismConfig
from vssm_gym.inference.prism.filter import Prism, PrismState
from vssm_gym.inference.tracking.camera_filter import at_rest
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD
from vssm_gym.model.posterior import Posterior
from vssm_gym.model.transition import RIGID

CAMERA = Camera.from_hfov(80, 60, np.radians(70.0))
ROOM = Room(((-2.0, -1.6, 0.0), (2.2, 1.7, 2.3)), (((0.9, -0.4, 0.0), (1.4, 0.5, 0.8)),))
DT = 0.1  # s
CONFIG = PrismConfig()
EXPECTED = PrismConfig(samples=3)
EXTENT, VOXEL = 6.4, 0.08  # m


def true_pose(k: float) -> np.ndarray:
    """Return T_room_cam of a hand that moves 2 to 3 cm and about a degree a frame."""
    place = (-0.8 + 0.025 * k, 0.2 * np.sin(0.25 * k), 1.1 + 0.05 * np.sin(0.4 * k))
    return camera_pose(place, 0.02 * k - 0.1, 0.2 + 0.01 * k, 0.01 * k)


def image(k: float) -> RGBD:
    return ROOM.image(true_pose(k), CAMERA)


def error(belief, T_room_cam: np.ndarray, T_room_world: np.ndarray | None = None) -> tuple[float, float]:
    """Return the error of an estimated pose, m and degrees; the world is the first camera's frame."""
    start = true_pose(0) if T_room_world is None else T_room_world
    truth = np.linalg.inv(start) @ T_room_cam
    off = np.linalg.inv(truth) @ np.asarray(belief.mean.T_world_body, float)
    xi = np.asarray(se3_log(jnp.asarray(off, jnp.float32)))
    return float(np.linalg.norm(xi[:3])), float(np.degrees(np.linalg.norm(xi[3:])))


def copy(state: PrismState) -> PrismState:
    """Copy a state: a step consumes its argument."""
    return jax.tree.map(lambda a: a.copy() if eqx.is_array(a) else a, state)


def prism_of(config: PrismConfig = CONFIG) -> Prism:
    """Return the filter of a hand-held camera."""
    return Prism(Rig.of(CAMERA), HAND, config)


def step(
    state: PrismState, taken: RGBD, dt: float = DT, config: PrismConfig = CONFIG, control: jax.Array | None = None
) -> tuple[PrismState, FilterInfo]:
    """Filter one image; with constant velocity unless an acceleration is given."""
    return prism_of(config).step(state, jnp.zeros(6) if control is None else control, taken, dt)


def start(
    config: PrismConfig = CONFIG,
    extent: float = EXTENT,
    seed: int = 0,
    first: RGBD | None = None,
    T_world_body: jax.Array | None = None,
) -> PrismState:
    """Begin at a known pose in the middle of an empty map; by default it is the world's origin."""
    T = jnp.eye(4) if T_world_body is None else T_world_body
    known = at_rest(RIGID, T, 1e-8 * jnp.eye(6), config.tracking.start_velocity)
    prior = Posterior(known, VoxelMap.cube(tuple(np.asarray(T[:3, 3], float)), extent, VOXEL))
    return prism_of(config).init(prior, image(0) if first is None else first, jax.random.key(seed))


def walk(state: PrismState, frames, config: PrismConfig = CONFIG) -> Iterator[tuple[PrismState, FilterInfo]]:
    """Filter every frame number of the path, 0.1 s apart."""
    for k in frames:
        state, info = step(state, image(k), DT, config)
        yield state, info


@cache
def _walked(config: PrismConfig, frames: int) -> tuple[PrismState, tuple[FilterInfo, ...]]:
    steps = list(walk(start(config), range(1, frames + 1), config))
    return steps[-1][0], tuple(info for _, info in steps)


def walked(frames: int = 12, config: PrismConfig = CONFIG) -> tuple[PrismState, tuple[FilterInfo, ...]]:
    """Return the state after so many frames, free to be consumed, and the report of each."""
    state, infos = _walked(config, frames)
    return copy(state), infos


def same_map(a: VoxelMap, b: VoxelMap) -> bool:
    """Compare maps bit for bit."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.asarray(x).tobytes() == np.asarray(y).tobytes() for x, y in pairs)
