"""Run SLAM on a log of a planar laser scanner, and judge it by what the log knows beside its scans."""

import time
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vssm_gym.data.laser_logs import LaserLog
from vssm_gym.errors import InputError
from vssm_gym.geometry.planar_poses import relation
from vssm_gym.inference.planar import PlanarPrism, PlanarState
from vssm_gym.inference.planar.config import PlanarConfig
from vssm_gym.maps.planar_map import PlanarMap
from vssm_gym.model.scanner import Scanner
from vssm_gym.model.transition import planar_belief
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.odometry import Odometry
from vssm_gym.progress import OnProgress

FLOOR_CELLS, FLOOR_TURN = 0.1, 0.01  # cells and rad, of the odometry's errors in a step without motion
SHARES = (0.1, 0.1, 0.1)  # of the motion, that they grow by
STARTS_WITHIN = 1e-3  # m, rad: the first pose is the origin
SCANS_TOGETHER = 100  # compiled steps between two reports


@dataclass(frozen=True)
class PlanarRun:
    """Hold the outcome.

    Attributes:
        poses: x, y (m), heading (rad) at each scan, in the frame of the first.
        covariance: of each one's error: forward, left (m), turn (rad).
        used: share of each scan's readings that met a known surface; the first has none.
        m: the map after the last scan.
        seconds: that it took, compilation included.
    """

    poses: Float[np.ndarray, "scans 3"]
    covariance: Float[np.ndarray, "scans 3 3"]
    used: Float[np.ndarray, "scans"]
    m: PlanarMap
    seconds: float


def run_scans(
    log: LaserLog,
    cell_size: float,
    max_range: float | None = None,
    config: PlanarConfig | None = None,
    on_progress: OnProgress | None = None,
    transition: Transition | None = None,
) -> PlanarRun:
    """Track and map a log, scan by scan; its poses and loops are not read.

    Args:
        log: scans and odometry.
        cell_size: of the map, m.
        max_range: m; farther readings are left out; None: those of the log.
        config: of the filter; None: the default.
        on_progress: called with ("tracking and mapping", scans done, scans).
        transition: of the robot, whose controls are the log's motions; None: an odometry with the errors above.

    Raises:
        InputError: a range that is not above 0, a log of one scan, or a map with too many cells.
    """
    longest = log.max_range if max_range is None else min(max_range, log.max_range)
    if not longest > 0.0:
        raise InputError("slam2d", "max-range", f"above 0 m, not {longest:g}")
    if len(log) < 2:
        raise InputError("slam2d", "log", f"two scans or more; found {len(log)}")
    ranges = np.where(log.ranges < longest, log.ranges, 0.0).astype(np.float32)
    reach, path = float(ranges.max()), log.path()[:, :2]
    # The odometry drifts: half as much room again as its path takes up, on each side
    margin = reach + 0.5 * np.ptp(path, axis=0).max() + 4.0 * cell_size
    m = PlanarMap.prior(path.min(axis=0) - margin, path.max(axis=0) + margin, cell_size)
    scanner = Scanner(jnp.asarray(log.angles, jnp.float32), jnp.asarray(log.mount, jnp.float32), jnp.float32(longest))
    floor = (FLOOR_CELLS * cell_size, FLOOR_CELLS * cell_size, FLOOR_TURN)
    moves = Odometry(floor, SHARES) if transition is None else transition
    prism = PlanarPrism(scanner, moves, config or PlanarConfig())
    belief = planar_belief(jnp.zeros(3), STARTS_WITHIN**2 * jnp.eye(3))
    state = prism.init(belief, m, jnp.asarray(ranges[0]))
    # The last part is filled up with scans without readings, which change no map: all parts have one compilation
    filled = ((0, -len(log.motions) % SCANS_TOGETHER), (0, 0))
    motions, seen = (jnp.asarray(np.pad(a, filled), jnp.float32) for a in (log.motions, ranges[1:]))
    parts = [(belief.mean[None], belief.covariance[None], jnp.zeros(1))]
    seconds = 0.0
    for first in range(0, len(motions), SCANS_TOGETHER):
        several = slice(first, first + SCANS_TOGETHER)
        given = state, motions[several], seen[several]
        began = time.perf_counter()
        state, found = jax.block_until_ready(_steps(prism.scanner, prism.transition, prism.config, *given))
        seconds += time.perf_counter() - began
        parts.append(found)
        if on_progress:
            on_progress("tracking and mapping", min(first + SCANS_TOGETHER, len(log) - 1), len(log) - 1)
    poses, covariance, used = (np.concatenate([np.asarray(part[k]) for part in parts])[: len(log)] for k in range(3))
    return PlanarRun(poses, covariance, used, state.m, seconds)


@partial(jax.jit, static_argnames="config", donate_argnames="state")
def _steps(
    scanner: Scanner, transition: Transition, config: PlanarConfig, state: PlanarState, motions: Array, ranges: Array
) -> tuple[PlanarState, tuple[Array, Array, Array]]:
    """Return the state after several scans, and pose, covariance and share of used readings of each."""
    prism = PlanarPrism(scanner, transition, config)

    def step(state: PlanarState, now: tuple[Array, Array]) -> tuple[PlanarState, tuple[Array, Array, Array]]:
        state, info = prism.step(state, *now, 0.0)
        return state, (state.belief.mean, state.belief.covariance, info.used)

    return jax.lax.scan(step, state, (motions, ranges))


def loop_errors(log: LaserLog, poses: Float[np.ndarray, "scans 3"]) -> Float[np.ndarray, "loops 2"]:
    """Return the errors of poses over the loops of a log: distance (m) and turn (rad) from its relations."""
    a, b = log.loops.T
    found = relation(poses[a], poses[b])
    turn = np.abs((found[:, 2] - log.relations[:, 2] + np.pi) % (2.0 * np.pi) - np.pi)
    return np.stack([np.hypot(*(found - log.relations)[:, :2].T), turn], axis=-1)
