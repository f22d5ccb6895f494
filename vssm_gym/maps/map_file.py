"""Write and read map files: a versioned ``.npz`` without pickle, written atomically.

Version 1 holds the rows of all blocks of a grid; version 2 holds the stored rows of a block-sparse map and the numbers
of their blocks.
"""

import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.files import atomic_write
from vssm_gym.maps.block_table import CELLS

FORMAT, DENSE, SPARSE = "vssm_gym.VoxelMap", 1, 2
BELIEF = ("occupancy", "occupancy_precision", "colour", "colour_precision")  # arrays of rows
_POSITIVE = ("occupancy_precision", "colour_precision", "voxel_size")


@dataclass(frozen=True)
class StoredMap:
    """Hold the complete and checked content of a map file of a known version."""

    blocks: tuple[int, int, int]
    arrays: dict[str, np.ndarray]  # BELIEF, origin, voxel_size; float32
    stored: np.ndarray | None = None  # ascending block numbers of the rows; None: all blocks
    slots: int = 0  # capacity of a block-sparse map


def write(path: str | Path, m: StoredMap, metadata: dict[str, Any]) -> None:
    """Write a map and ``metadata``."""
    header: dict[str, Any] = {"format": FORMAT, "version": DENSE, "blocks": list(m.blocks)}
    arrays: dict[str, Any] = dict(m.arrays)
    if m.stored is not None:
        header |= {"version": SPARSE, "slots": m.slots}
        arrays["stored"] = m.stored
    encoded = np.frombuffer(json.dumps({**header, **metadata}).encode(), np.uint8)
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, header=encoded, **arrays)


def read(path: str | Path) -> StoredMap:
    """Read and check a map file.

    Raises:
        InputError: the file is missing, truncated, of another format or version, or its arrays do not fit.
    """
    header, arrays = _read(Path(path))
    blocks = _blocks(path, header)
    n = blocks[0] * blocks[1] * blocks[2]
    stored, slots = None, 0
    if header["version"] == SPARSE:
        stored, slots = _stored(path, header, arrays, n)
        n = len(stored)
    shapes = {
        "occupancy": (n, CELLS),
        "occupancy_precision": (n, CELLS),
        "colour": (n, 3, CELLS),
        "colour_precision": (n, CELLS),
        "origin": (3,),
        "voxel_size": (),
    }
    for name, shape in shapes.items():
        array = arrays[name]
        if array.shape != shape or array.dtype.kind != "f" or not np.isfinite(array).all():
            raise InputError(path, name, f"finite floats of shape {shape}, found {array.dtype} {array.shape}")
        if name in _POSITIVE and not (array > 0.0).all():
            raise InputError(path, name, "positive numbers")
    return StoredMap(blocks, {name: arrays[name].astype(np.float32) for name in shapes}, stored, slots)


def _read(path: Path) -> tuple[dict, dict[str, np.ndarray]]:
    header, arrays = _unpacked(path)
    known = header if isinstance(header, dict) else {}
    if known.get("format") != FORMAT or known.get("version") not in (DENSE, SPARSE):
        found = f"{known.get('format')} version {known.get('version')}"
        raise InputError(path, "version", f"{FORMAT} version {DENSE} or {SPARSE}, found {found}")
    missing = [name for name in (*BELIEF, "origin", "voxel_size") if name not in arrays]
    if missing:
        raise InputError(path, missing[0], "this array in the map file")
    return header, arrays


def _unpacked(path: Path) -> tuple[Any, dict[str, np.ndarray]]:
    """Return the header and the arrays of a file of this package, unchecked."""
    if not path.is_file():
        found = "; this is a folder" if path.is_dir() else ""
        raise InputError(path, "file", f"an existing map file (.npz); `vssm-gym map build` makes one{found}")
    if not zipfile.is_zipfile(path):  # NumPy would advise to load it as a pickle
        raise InputError(path, "file", "a whole vssm_gym map; it cannot be read (no .npz file)")
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        header = json.loads(arrays.pop("header").tobytes().decode())
    except Exception as error:  # zipfile, zlib and NumPy raise errors of many types on damaged files
        raise InputError(path, "file", f"a whole vssm_gym map; it cannot be read ({error})") from error
    return header, arrays


def _blocks(path: str | Path, header: dict) -> tuple[int, int, int]:
    """Return the number of blocks along x, y, z that a header declares."""
    match header.get("blocks"):
        case [int(x), int(y), int(z)] if min(x, y, z) > 0:
            return x, y, z
    raise InputError(path, "blocks", f"three positive whole numbers, found {header.get('blocks')!r}")


def _stored(path: str | Path, header: dict, arrays: dict[str, np.ndarray], blocks: int) -> tuple[np.ndarray, int]:
    """Return the block numbers of a sparse map's rows, and its number of slots."""
    stored, slots = arrays.get("stored"), header.get("slots")
    if not isinstance(stored, np.ndarray) or stored.ndim != 1 or stored.dtype.kind != "i":
        raise InputError(path, "stored", "a list of block numbers")
    if len(stored) and (stored[0] < 0 or stored[-1] >= blocks or (np.diff(stored) <= 0).any()):
        raise InputError(path, "stored", f"ascending block numbers below {blocks}")
    if not isinstance(slots, int) or slots <= len(stored):
        raise InputError(path, "slots", f"a whole number above the {len(stored)} stored blocks, found {slots!r}")
    return stored, slots


def read_metadata(path: str | Path) -> dict:
    """Return the header of a map file: format, version and the metadata passed to ``VoxelMap.save``."""
    return _read(Path(path))[0]


def read_header(path: str | Path, formats: set[str]) -> dict[str, Any]:
    """Read the header of a map file, or of another file of this package whose format is one of ``formats``."""
    header, _ = _unpacked(Path(path))
    found = header.get("format") if isinstance(header, dict) else None
    if found not in formats:
        raise InputError(path, "format", f"one of {', '.join(sorted(formats))}; found {found!r:.80}")
    return header
