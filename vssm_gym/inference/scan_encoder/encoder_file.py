"""Write and read the layers of an encoder of scans: an ``.npz`` without pickle, written atomically."""

import itertools
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.bounded import open_file
from vssm_gym.files.npz_file import open_npz
from vssm_gym.inference.scan_encoder.network import OUTPUTS, ScanEncoder
from vssm_gym.inference.scan_encoder.prior import VisitedPlaces

ENCODER_BYTES = 100_000_000  # of all layers unpacked


def save_encoder(path: Path, encoder: ScanEncoder) -> None:
    """Write weights and offsets; the file is complete or absent."""
    arrays = {
        f"{name}{k}": np.asarray(layer[i]) for k, layer in enumerate(encoder.layers) for i, name in enumerate("wb")
    }
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def load_encoder(path: Path, prior: VisitedPlaces, max_range: float) -> ScanEncoder:
    """Read what :func:`save_encoder` has written.

    Args:
        path: of the file.
        prior: under which the encoder was trained.
        max_range: of the scanner, m.

    Raises:
        InputError: a missing or damaged file, or layers that do not follow each other.
    """
    with open_file(path) as file, open_npz(file, path, ENCODER_BYTES, "a whole file of an encoder") as stored:
        arrays = stored.read_all()
    layers = [
        (arrays[f"w{k}"], arrays[f"b{k}"]) for k in range(len(arrays) // 2) if f"w{k}" in arrays and f"b{k}" in arrays
    ]
    wide = [w.shape for w, _ in layers]
    finite = all(a.dtype == np.float32 and np.isfinite(a).all() for a in arrays.values())
    fits = finite and all(w.ndim == 2 and b.shape == w.shape[1:] for w, b in layers)
    follows = fits and all(a[1] == b[0] for a, b in itertools.pairwise(wide))
    if not layers or 2 * len(layers) != len(arrays) or not follows or wide[-1][1] % OUTPUTS:
        raise InputError(path, "layers", f"finite layers of which each reads the one before it; found {wide}")
    return ScanEncoder([(jnp.asarray(w), jnp.asarray(b)) for w, b in layers], prior, jnp.float32(max_range))
