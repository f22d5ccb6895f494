"""Run SLAM with a latent grid on a log of a planar laser scanner: on line, or off line in several passes."""

import time
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vssm_gym.data.laser_logs import LaserLog
from vssm_gym.errors import InputError
from vssm_gym.inference.latent.chart_update import Panorama, panorama
from vssm_gym.inference.latent.config import LatentConfig
from vssm_gym.inference.latent.decoder_fit import fit_decoder
from vssm_gym.inference.latent.filter import LatentFilter, smoothed
from vssm_gym.inference.latent.passes import Log, Pass, advance, put_all
from vssm_gym.inference.particles import ParticleBelief
from vssm_gym.maps.latent_grid import ChartDecoder, LatentGrid
from vssm_gym.model.latent_scans import LatentScans
from vssm_gym.model.scanner import Scanner
from vssm_gym.model.transition.manifold import PLANAR
from vssm_gym.model.transition.odometry import Odometry
from vssm_gym.progress import OnProgress

# The odometry's errors, fitted to drives through `pillars-v1` and the poses that SLAM estimated there (odometry_fit)
LATENT_FLOOR_CELLS = 0.004  # cells, of a step without motion
LATENT_FLOOR_TURN = 0.0045  # rad, of the same
LATENT_SHARES = (0.031, 0.016, 0.006)  # of the motion, that they grow by
STEPS_TOGETHER = 100  # compiled steps between two reports


@dataclass(frozen=True)
class LatentRun:
    """Hold the outcome.

    Attributes:
        poses: x, y (m), heading (rad) at each scan, in the frame of the first.
        covariance: of each one's error: forward, left (m), turn (rad).
        model: of scans, with the map of all of them.
        seconds: that it took, compilation included.
        log_evidence: of all scans in each pass, each given those before it and the map of the other chunks, nats;
            tempered as the likelihood is.
    """

    poses: Float[np.ndarray, "scans 3"]
    covariance: Float[np.ndarray, "scans 3 3"]
    model: LatentScans
    seconds: float
    log_evidence: list[float]


def run_latent(
    log: LaserLog,
    cell_size: float,
    max_range: float | None = None,
    passes: int = 0,
    config: LatentConfig | None = None,
    decoder: ChartDecoder | None = None,
    seed: int = 0,
    on_progress: OnProgress | None = None,
) -> LatentRun:
    """Track a robot and learn the charts around its path; poses and loops of the log are not read.

    Args:
        log: scans and odometry.
        cell_size: of the map, m.
        max_range: m; farther readings are left out; None: those of the log.
        passes: off-line passes after the on-line one.
        config: numbers; None: the default.
        decoder: of the charts; None: one is fitted to the scans.
        seed: of the particles.
        on_progress: called with (stage, scans done, scans).

    Raises:
        InputError: a range that is not above 0, a log of one scan, or a map with too many cells.
    """
    config = config or LatentConfig()
    longest = log.max_range if max_range is None else min(max_range, log.max_range)
    if not longest > 0.0:
        raise InputError("slam2d", "max-range", f"above 0 m, not {longest:g}")
    if len(log) < 2:
        raise InputError("slam2d", "log", f"two scans or more; found {len(log)}")
    if passes < 0:
        raise InputError("slam2d", "passes", f"at least 0, not {passes}")
    began = time.perf_counter()
    ranges = np.where(log.ranges < longest, log.ranges, 0.0).astype(np.float32)
    spacing = float(np.ptp(log.angles)) / (len(log.angles) - 1)
    bearings = round(2.0 * np.pi / spacing)
    decoder = decoder or fit_decoder(ranges, log.angles, bearings, min(config.latents, bearings))
    path = log.path()[:, :2]
    margin = 0.5 * np.ptp(path, axis=0).max() + 4.0 * cell_size  # the odometry drifts
    prior = LatentGrid.prior(path.min(axis=0) - margin, path.max(axis=0) + margin, cell_size, decoder)
    scanner = Scanner(jnp.asarray(log.angles, jnp.float32), jnp.asarray(log.mount, jnp.float32), jnp.float32(longest))
    floor = LATENT_FLOOR_CELLS * cell_size
    transition = Odometry((floor, floor, LATENT_FLOOR_TURN), LATENT_SHARES)
    scans = jax.vmap(lambda scan: panorama(scan, scanner, bearings))(jnp.asarray(ranges))
    controls = jnp.asarray(np.concatenate([np.zeros((1, 3)), log.motions]), jnp.float32)
    given = Log(controls, jnp.asarray(ranges), scans)
    mean, covariance = jnp.zeros((len(log), 3)), jnp.zeros((len(log), 3, 3))
    m, evidence, written = prior, [], None
    near = slice(0, config.chunk + 1)  # of the first step
    for number in range(passes + 1):
        if written is not None:
            m = put_all(m, _some(scans, near), written[near], scanner, config, -1.0)
        particles = ParticleBelief.of(jnp.zeros((config.particles, 3)), PLANAR)
        m = jax.tree.map(jnp.copy, m)  # `advance` takes its state for itself
        at = Pass(particles, m, jnp.zeros_like(mean), jnp.zeros_like(covariance), jnp.zeros(len(log)))
        key = jax.random.fold_in(jax.random.key(seed), number)
        for first in range(1, len(log), STEPS_TOGETHER):
            steps = jnp.arange(first, first + STEPS_TOGETHER)
            at = advance(scanner, transition, config, key, at, given, steps, written)
            if on_progress:
                stage = f"pass {number}" if number else "on line"
                on_progress(stage, min(first + STEPS_TOGETHER, len(log)), len(log))
        mean, covariance = at.mean, at.covariance
        if passes and number:
            # Particles that all agree have no spread to weigh the next step by
            jitter = 1e-12 * jnp.eye(3)
            mean, covariance = smoothed(transition, mean, covariance + jitter, controls[1:], 0.0)
        evidence.append(float(at.log_evidence.sum()))
        written = mean
        m = put_all(prior, scans, written, scanner, config)
    model = LatentFilter(scanner, transition, config).model(m)
    jax.block_until_ready(m.chart)
    seconds = time.perf_counter() - began
    return LatentRun(np.asarray(mean, float), np.asarray(covariance, float), model, seconds, evidence)


def _some(scans: Panorama, part: slice) -> Panorama:
    return Panorama(scans.ranges[part], scans.valid[part])
