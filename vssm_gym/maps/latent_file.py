"""Write and read a latent grid: an ``.npz`` without pickle, written atomically."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.bounded import open_file
from vssm_gym.files.npz_file import open_npz
from vssm_gym.maps.latent_grid import MOST_LATENT_CELLS, ChartDecoder, LatentGrid

LATENT_BYTES = 2_000_000_000  # of all arrays unpacked
_FIELDS = ("weight", "moment", "origin", "cell_size", "decoder_mean", "decoder_basis")


def save_latent_grid(path: Path, m: LatentGrid) -> None:
    """Write natural parameters and decoder; the file is complete or absent."""
    values = m.weight, m.moment, m.origin, m.cell_size, m.decoder.mean, m.decoder.basis
    arrays = {name: np.asarray(value, np.float32) for name, value in zip(_FIELDS, values, strict=True)}
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def load_latent_grid(path: Path) -> LatentGrid:
    """Read what :func:`save_latent_grid` has written.

    Raises:
        InputError: a missing or damaged file, arrays that do not fit each other, or values that no map has.
    """
    with open_file(path) as file, open_npz(file, path, LATENT_BYTES, "a whole file of a latent grid") as stored:
        weight, moment, origin, cell_size, mean, basis = (stored.read(name) for name in _FIELDS)
    for name, array in zip(_FIELDS, (weight, moment, origin, cell_size, mean, basis), strict=True):
        if array.dtype != np.float32 or not np.isfinite(array).all():
            raise InputError(path, name, f"finite float32; found {array.dtype}")
    charts = weight.ndim == 3 and min(weight.shape) >= 2 and weight.shape[0] * weight.shape[1] <= MOST_LATENT_CELLS
    if not charts or moment.shape != weight.shape or (weight < 0.0).any():
        raise InputError(path, "weight", f"(nx, ny, bearings) at least 0, as moment has; found {weight.shape}")
    if origin.shape != (2,) or cell_size.shape != () or not cell_size > 0.0:
        raise InputError(path, "cell_size", f"above 0 m, and an origin of 2 numbers; found {cell_size}, {origin}")
    if mean.shape != () or basis.ndim != 2 or not len(basis) or basis.shape[1] != weight.shape[2]:
        raise InputError(path, "decoder_basis", f"(latents, {weight.shape[2]}); found {basis.shape}")
    decoder = ChartDecoder(jnp.asarray(mean), jnp.asarray(basis))
    where = jnp.asarray(origin), jnp.asarray(cell_size)
    return LatentGrid.of(jnp.asarray(weight), jnp.asarray(moment), *where, decoder)
