"""Run SLAM with a latent grid on a log of a planar laser scanner: on line, or off line in several passes."""

import time
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vssm_gym.data.laser_logs import LaserLog
from vssm_gym.data.strip_logs import StripLog
from vssm_gym.errors import InputError
from vssm_gym.inference.latent.chart_update import ChartSensor
from vssm_gym.inference.latent.config import LatentConfig
from vssm_gym.inference.latent.decoder_fit import fit_decoder
from vssm_gym.inference.latent.filter import smoothed
from vssm_gym.inference.latent.passes import Log, Pass, advance, put_all, without_first_chunk
from vssm_gym.inference.latent.scan_charts import ScanCharts, ScanReading, panorama
from vssm_gym.inference.latent.strip_charts import (
    StripCharts,
    StripConfig,
    StripReading,
    brightness,
    fit_strip_decoder,
)
from vssm_gym.inference.particles import ParticleBelief
from vssm_gym.maps.latent_grid import ChartDecoder, LatentGrid
from vssm_gym.model.latent_scans import LatentScans
from vssm_gym.model.latent_strips import LatentStrips
from vssm_gym.model.scanner import Scanner
from vssm_gym.model.transition.manifold import PLANAR
from vssm_gym.model.transition.odometry import Odometry
from vssm_gym.progress import OnProgress

# The odometry's errors, fitted to drives through `pillars-v1` and the poses that SLAM estimated there (odometry_fit)
LATENT_FLOOR_CELLS = 0.004  # cells, of a step without motion
LATENT_FLOOR_TURN = 0.0045  # rad, of the same
LATENT_SHARES = (0.031, 0.016, 0.006)  # of the motion, that they grow by
CELLS_TOGETHER = 8  # a map's sides are multiples of it, so that logs share compilations
STEPS_TOGETHER = 100  # compiled steps between two reports


@dataclass(frozen=True)
class LatentRun:
    """Hold the outcome.

    Attributes:
        poses: x, y (m), heading (rad) at each scan, in the frame of the first.
        covariance: of each one's error: forward, left (m), turn (rad).
        model: of scans, or of strips, with the map of all of them.
        seconds: that it took, compilation included.
        log_evidence: of all scans in each pass, each given those before it and the map of the other chunks, nats;
            tempered as the likelihood is.
    """

    poses: Float[np.ndarray, "scans 3"]
    covariance: Float[np.ndarray, "scans 3 3"]
    model: LatentScans | LatentStrips
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

    On line means that a pose depends on the scans so far, given decoder and extent of the map: those are fitted to the
    whole log.

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
    _check(log, passes)
    began = time.perf_counter()
    ranges = np.where(log.ranges < longest, log.ranges, 0.0).astype(np.float32)
    spacing = float(np.ptp(log.angles)) / (len(log.angles) - 1)
    bearings = round(2.0 * np.pi / spacing)
    decoder = decoder or fit_decoder(ranges, log.angles, bearings, min(config.latents, bearings))
    scanner = Scanner(jnp.asarray(log.angles, jnp.float32), jnp.asarray(log.mount, jnp.float32), jnp.float32(longest))
    beams = jnp.asarray(ranges)
    readings = ScanReading(beams, jax.vmap(lambda scan: panorama(scan, scanner, bearings))(beams))
    charts, prior = ScanCharts(scanner, config), _prior(log.path(), cell_size, decoder)
    found = _infer(charts, prior, log.motions, readings, config, passes, seed, on_progress)
    return LatentRun(*found[:2], charts.model(found[2]), time.perf_counter() - began, found[3])


def run_strips(
    log: StripLog,
    cell_size: float,
    passes: int = 0,
    config: StripConfig | None = None,
    seed: int = 0,
    on_progress: OnProgress | None = None,
) -> LatentRun:
    """Track a robot by strip images and learn charts of colours around its path; poses of the log are not read.

    Args:
        log: strips, the columns evenly spaced from ahead, and odometry.
        cell_size: of the map, m.
        passes: off-line passes after the on-line one.
        config: numbers; None: the default.
        seed: of the particles.
        on_progress: called with (stage, strips done, strips).

    Raises:
        InputError: a log of one strip, or a map with too many cells.
    """
    config = config or StripConfig()
    _check(log, passes)
    began = time.perf_counter()
    pixels = brightness(log.images)
    charts = StripCharts(config)
    prior = _prior(log.path(), cell_size, fit_strip_decoder(pixels, config.latents))
    readings = StripReading(jnp.asarray(pixels))
    found = _infer(charts, prior, log.motions, readings, config, passes, seed, on_progress)
    return LatentRun(*found[:2], charts.model(found[2]), time.perf_counter() - began, found[3])


def _check(log: LaserLog | StripLog, passes: int) -> None:
    if len(log) < 2:
        raise InputError("slam2d", "log", f"two scans or more; found {len(log)}")
    if passes < 0:
        raise InputError("slam2d", "passes", f"at least 0, not {passes}")


def _prior(path: Float[np.ndarray, "scans 3"], cell_size: float, decoder: ChartDecoder) -> LatentGrid:
    """Return an empty map around a path that drifts."""
    low, high = path[:, :2].min(axis=0), path[:, :2].max(axis=0)
    margin = 0.5 * (high - low).max() + 4.0 * cell_size
    low, high = low - margin, high + margin
    block = CELLS_TOGETHER * cell_size if cell_size > 0.0 else 1.0
    high = low + block * np.ceil((high - low) / block) - 0.5 * cell_size
    return LatentGrid.prior(low, high, cell_size, decoder)


def _infer(
    charts: ChartSensor,
    prior: LatentGrid,
    motions: Float[np.ndarray, "motions 3"],
    readings: Any,
    config: LatentConfig | StripConfig,
    passes: int,
    seed: int,
    on_progress: OnProgress | None,
) -> tuple[np.ndarray, np.ndarray, LatentGrid, list[float]]:
    """Return poses, covariances, map and evidence of each pass."""
    floor = LATENT_FLOOR_CELLS * float(prior.cell_size)
    transition = Odometry((floor, floor, LATENT_FLOOR_TURN), LATENT_SHARES)
    controls = jnp.asarray(np.concatenate([np.zeros((1, 3)), motions]), jnp.float32)
    given, length = Log(controls, readings), len(controls)
    mean, covariance = jnp.zeros((length, 3)), jnp.zeros((length, 3, 3))
    m, evidence, written = prior, [], None
    for number in range(passes + 1):
        if written is not None:
            m = jax.block_until_ready(without_first_chunk(charts, m, readings, written, config.chunk))
        particles = ParticleBelief.of(jnp.zeros((config.particles, 3)), PLANAR)
        m = jax.tree.map(jnp.copy, m)  # `advance` takes its state for itself
        at = Pass(particles, m, jnp.zeros_like(mean), jnp.zeros_like(covariance), jnp.zeros(length))
        key = jax.random.fold_in(jax.random.key(seed), number)
        for first in range(1, length, STEPS_TOGETHER):
            steps = jnp.arange(first, first + STEPS_TOGETHER)
            # One computation at a time: several in flight share XLA's few threads on a small machine, and may wait for
            # each other without end
            at = jax.block_until_ready(advance(charts, transition, config.chunk, key, at, given, steps, written))
            if on_progress:
                stage = f"pass {number}" if number else "on line"
                on_progress(stage, min(first + STEPS_TOGETHER, length), length)
        mean, covariance = at.mean, at.covariance
        if number:
            # Particles that all agree have no spread to weigh the next step by
            jitter = 1e-12 * jnp.eye(3)
            both = smoothed(transition, mean, covariance + jitter, controls[1:], 0.0)
            mean, covariance = jax.block_until_ready(both)
        evidence.append(float(at.log_evidence.sum()))
        written = mean
        m = jax.block_until_ready(put_all(charts, prior, readings, written))
    return np.asarray(mean, float), np.asarray(covariance, float), m, evidence
