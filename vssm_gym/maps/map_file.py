"""Write and read map files: a versioned ``.npz`` without pickle, written atomically.

Version 1 holds the rows of all blocks of a grid; version 2 holds the stored rows of a block-sparse map and the numbers
of their blocks.
"""

import hashlib
import json
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.bounded import open_file
from vssm_gym.files.npz_file import StoredArrays, open_npz
from vssm_gym.files.numbers import as_float32, whole
from vssm_gym.files.shipped import MAPS, or_shipped, shipped
from vssm_gym.maps.block_table import BLOCK, CELLS

FORMAT, DENSE, SPARSE = "vssm_gym.VoxelMap", 1, 2
BELIEF = ("occupancy", "occupancy_precision", "colour", "colour_precision")  # arrays of rows
MAP_BYTES = 1_000_000_000  # of all arrays unpacked: 40 million cells of 24 bytes, the most that is built
MOST_BLOCKS = 4_000_000  # 2,000 million cells, most of them without storage
MOST_SLOTS = 65_536  # stored blocks of a block-sparse map, 12.3 kB each
LARGEST_REACH = 1e6  # m; float32 has steps of 6 cm there
_POSITIVE = ("occupancy_precision", "colour_precision", "voxel_size")


@dataclass(frozen=True)
class StoredMap:
    """Hold the complete and checked content of a map file of a known version."""

    blocks: tuple[int, int, int]
    arrays: dict[str, np.ndarray]  # BELIEF, origin, voxel_size; float32
    stored: np.ndarray | None = None  # ascending block numbers of the rows; None: all blocks
    slots: int = 0  # capacity of a block-sparse map
    header: dict[str, Any] = field(default_factory=dict)  # of a file that was read: format, version, metadata


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
    """Read and check a map file; sizes and shapes are checked before arrays are unpacked.

    Raises:
        InputError: the file is missing, truncated, larger than ``MAP_BYTES`` unpacked, of another format or version, or
            its arrays do not fit.
    """
    with _opened(path) as stored:
        header = _header(path, stored)
        blocks = _blocks(path, header)
        n = blocks[0] * blocks[1] * blocks[2]
        listed, slots = None, 0
        if header["version"] == SPARSE:
            listed, slots = _stored(path, header, stored, n)
            n = len(listed)
        shapes = {
            "occupancy": (n, CELLS),
            "occupancy_precision": (n, CELLS),
            "colour": (n, 3, CELLS),
            "colour_precision": (n, CELLS),
            "origin": (3,),
            "voxel_size": (),
        }
        for name, shape in shapes.items():
            if stored.shapes[name] != shape:
                raise InputError(path, name, f"floats of shape {shape}; found {stored.shapes[name]}")
        arrays = {name: as_float32(stored.read(name), path, name, positive=name in _POSITIVE) for name in shapes}
    _check_extent(path, blocks, arrays)
    return StoredMap(blocks, arrays, listed, slots, header)


def _opened(path: str | Path) -> AbstractContextManager[StoredArrays]:
    """Open a file of this package; its arrays are unpacked on demand."""
    path = shipped(path, MAPS)
    if not path.is_file():
        found = "; this is a folder" if path.is_dir() else ""
        wanted = f"an existing map file (.npz); `vssm-gym map build` makes one{or_shipped(MAPS)}"
        raise InputError(path, "file", wanted + found)
    return open_npz(open_file(path), path, MAP_BYTES, "a whole vssm_gym map; it cannot be read")


def _header(path: str | Path, stored: StoredArrays) -> dict[str, Any]:
    """Return the header of a map of a known version that has all arrays."""
    header = stored.read_json("header", path)
    known = header if isinstance(header, dict) else {}
    if known.get("format") != FORMAT or known.get("version") not in (DENSE, SPARSE):
        found = f"{known.get('format')!s:.100} version {known.get('version')!s:.100}"
        raise InputError(path, "version", f"{FORMAT} version {DENSE} or {SPARSE}, found {found}")
    missing = [name for name in (*BELIEF, "origin", "voxel_size") if name not in stored.shapes]
    if missing:
        raise InputError(path, missing[0], "this array in the map file")
    return known


def _check_extent(path: str | Path, blocks: tuple[int, int, int], arrays: dict[str, np.ndarray]) -> None:
    """Raise InputError for a map that reaches further than any place: coordinates lose their digits there."""
    reach = np.abs(arrays["origin"]).max() + max(blocks) * BLOCK * float(arrays["voxel_size"])
    if not reach <= LARGEST_REACH:
        raise InputError(
            path, "origin, voxel_size", f"a map within {LARGEST_REACH:g} m of its origin; found {reach:g} m"
        )


def _blocks(path: str | Path, header: dict) -> tuple[int, int, int]:
    """Return the number of blocks along x, y, z that a header declares."""
    blocks = header.get("blocks")
    if not isinstance(blocks, list) or len(blocks) != 3:
        raise InputError(path, "blocks", f"three positive whole numbers; found {blocks!r:.100}")
    x, y, z = (whole(n, path, "blocks", least=1, most=MOST_BLOCKS) for n in blocks)
    if x * y * z > MOST_BLOCKS:
        raise InputError(path, "blocks", f"at most {MOST_BLOCKS:,} blocks; found {x * y * z:,}")
    return x, y, z


def _stored(path: str | Path, header: dict, stored: StoredArrays, blocks: int) -> tuple[np.ndarray, int]:
    """Return the block numbers of a sparse map's rows, and its number of slots."""
    if len(stored.shapes.get("stored", ())) != 1 or (numbers := stored.read("stored")).dtype.kind != "i":
        raise InputError(path, "stored", "a list of block numbers")
    if len(numbers) and (numbers[0] < 0 or numbers[-1] >= blocks or (np.diff(numbers) <= 0).any()):
        raise InputError(path, "stored", f"ascending block numbers below {blocks}")
    slots = whole(header.get("slots"), path, "slots", least=len(numbers) + 1, most=MOST_SLOTS)
    return numbers, slots


def read_metadata(path: str | Path) -> dict:
    """Return the header of a map file: format, version and the metadata passed to ``VoxelMap.save``."""
    with _opened(path) as stored:
        return _header(path, stored)


def read_header(path: str | Path, formats: set[str]) -> dict[str, Any]:
    """Read the header of a map file, or of another file of this package whose format is one of ``formats``."""
    with _opened(path) as stored:
        header = stored.read_json("header", path)
    found = header.get("format") if isinstance(header, dict) else None
    if not isinstance(found, str) or found not in formats:
        raise InputError(path, "format", f"one of {', '.join(sorted(formats))}; found {found!r:.80}")
    return header


def map_hash(map_file: Path) -> str:
    """Return 16 hex digits of a map file's SHA-256, by which results name the map."""
    with shipped(map_file, MAPS).open("rb") as file:  # not as a whole: any size may be given
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]
