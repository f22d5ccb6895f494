"""Fit the decoder of charts to scans: probabilistic principal components at all headings (Tipping and Bishop, 1999).

    C(d) = E[(r(b) - mean) (r(b + d) - mean)],    W = sqrt(eigenvalues) eigenvectors of the circulant of C

A map's frame has no heading of its own, so the scans of one place at all headings are equally likely: the covariance
over bearings depends on their difference alone, and its components are sines and cosines. No pose is needed.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vssm_gym.errors import InputError
from vssm_gym.maps.latent_grid import ChartDecoder

LEAST_VARIANCE = 1e-8  # m^2, of a component


def fit_decoder(
    ranges: Float[np.ndarray, "scans beams"], angles: Float[np.ndarray, "beams"], bearings: int, latents: int
) -> ChartDecoder:
    """Return the decoder whose prior has the mean and the covariance of scans.

    Args:
        ranges: m; 0 where there is no reading.
        angles: of the beams, rad, evenly spaced.
        bearings: of a chart.
        latents: components that are kept, those with the most variance.

    Raises:
        InputError: no readings, or more latents than bearings.
    """
    if not 1 <= latents <= bearings:
        raise InputError("fit_decoder", "latents", f"between 1 and {bearings}, the bearings; found {latents}")
    seen = ranges > 0.0
    if not seen.any():
        raise InputError("fit_decoder", "ranges", "a reading at least")
    mean = float(ranges[seen].mean())
    column = np.round((angles - angles[0]) * bearings / (2.0 * np.pi)).astype(int) % bearings
    away, valid = np.zeros((len(ranges), bearings)), np.zeros((len(ranges), bearings))
    away[:, column], valid[:, column] = np.where(seen, ranges - mean, 0.0), seen
    correlate = lambda a: np.fft.irfft((np.abs(np.fft.rfft(a, axis=1)) ** 2).sum(axis=0), bearings)
    pairs = correlate(valid)
    covariance = np.where(pairs > 0.5, correlate(away) / np.maximum(pairs, 1.0), 0.0)  # 0 at differences never seen
    variance = np.maximum(np.fft.rfft(covariance).real, LEAST_VARIANCE)
    bearing = 2.0 * np.pi * np.arange(bearings) / bearings
    waves, of_wave = [], []
    for k in range(bearings // 2 + 1):
        for wave in (np.cos(k * bearing), np.sin(k * bearing)):
            if (length := np.linalg.norm(wave)) > 1e-6 * bearings:
                waves.append(wave / length)
                of_wave.append(variance[k])
    kept = np.argsort(-np.array(of_wave), kind="stable")[:latents]
    basis = np.sqrt(np.array(of_wave)[kept, None]) * np.array(waves)[kept]
    return ChartDecoder(jnp.float32(mean), jnp.asarray(basis, jnp.float32))
