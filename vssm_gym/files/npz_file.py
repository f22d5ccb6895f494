"""Read NumPy's ``.npz`` within bounds: every array's type and size is known, and may be checked, before it is unpacked.

NumPy's own reader trusts what a file declares: 3 MB may unpack to 3 GB, and damage raises errors of many types.
"""

import math
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.files.json_file import parse_json

MEMBERS = 256  # arrays of a file; a policy of 32 layers has 65
TEXT_BYTES = 4 << 20  # of a JSON text among the arrays
HEADER_BYTES = 4096  # of an array's header; NumPy writes 128
_HEADER = re.compile(
    r"\{'descr': '(?P<dtype>[<>|=]?[biufU]\d{1,9})', 'fortran_order': (?P<fortran>True|False), "
    r"'shape': \((?P<shape>(?:\d{1,18},? ?)*)\),? ?\}\s*"
)


@dataclass(frozen=True)
class _Member:
    """Describe an array that is not unpacked yet."""

    info: zipfile.ZipInfo
    dtype: np.dtype
    shape: tuple[int, ...]
    fortran: bool
    start: int  # bytes of the header before the data


class StoredArrays:
    """Hold the arrays of an open ``.npz``; :meth:`read` unpacks one."""

    def __init__(self, archive: zipfile.ZipFile, limit: int) -> None:
        infos = archive.infolist()
        if len(infos) > MEMBERS:
            raise ValueError(f"at most {MEMBERS} arrays")
        total = sum(info.file_size for info in infos)
        if total > limit:
            raise ValueError(f"at most {limit:,} bytes of arrays, it declares {total:,}")
        self._archive = archive
        self._members = {info.filename.removesuffix(".npy"): self._member(info) for info in infos}

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Return name and declared shape of every array."""
        return {name: member.shape for name, member in self._members.items()}

    def read(self, name: str) -> np.ndarray:
        """Unpack one array; KeyError where the file has none of this name."""
        member = self._members[name]
        array = np.empty(math.prod(member.shape), member.dtype)
        with self._archive.open(member.info) as file:
            file.read(member.start)
            view, filled = array.view(np.uint8), 0  # filled in place: no second copy in memory
            while filled < array.nbytes:
                got = file.readinto(view[filled:])  # type: ignore[attr-defined]
                if not got:
                    raise ValueError(f"the array {name} is cut off")
                filled += got
            if file.read(1):  # at the end of the data the checksum is compared
                raise ValueError(f"the array {name} is longer than it declares")
        array = array.reshape(member.shape, order="F" if member.fortran else "C")
        return array.astype(member.dtype.newbyteorder("="), copy=False)

    def read_all(self) -> dict[str, np.ndarray]:
        """Unpack every array."""
        return {name: self.read(name) for name in self._members}

    def read_json(self, name: str, source: object) -> Any:
        """Return the data of a JSON text that is stored as an array of bytes."""
        array = self.read(name)
        if array.dtype != np.uint8 or array.ndim != 1 or array.size > TEXT_BYTES:
            raise InputError(
                source, name, f"JSON as a row of at most {TEXT_BYTES:,} bytes; found {array.dtype} {array.shape}"
            )
        return parse_json(array.tobytes(), source, name)

    def _member(self, info: zipfile.ZipInfo) -> _Member:
        if info.flag_bits & 0x1 or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError("arrays that are neither encrypted nor packed by another method than deflate")
        with self._archive.open(info) as file:
            magic = file.read(8)
            if magic[:6] != b"\x93NUMPY" or magic[6:] not in (b"\x01\x00", b"\x02\x00"):
                raise ValueError(f"{info.filename!r:.80} is no array of NumPy's format 1 or 2")
            wide = magic[6] == 2
            (size,) = struct.unpack("<I" if wide else "<H", file.read(4 if wide else 2))
            if size > HEADER_BYTES:
                raise ValueError(f"headers of at most {HEADER_BYTES} bytes")
            found = _HEADER.fullmatch(file.read(size).decode("latin1"))
        if found is None:
            raise ValueError(f"{info.filename!r:.80} holds neither numbers nor text")
        dtype, start = np.dtype(found["dtype"]), 8 + (4 if wide else 2) + size
        shape = tuple(int(digits) for digits in found["shape"].replace(",", " ").split())
        if start + math.prod(shape) * dtype.itemsize != info.file_size:
            raise ValueError(f"{info.filename!r:.80} declares another size than it has")
        return _Member(info, dtype, shape, found["fortran"] == "True", start)


@contextmanager
def open_npz(file: BinaryIO, source: object, limit: int, expected: str) -> Iterator[StoredArrays]:
    """Open a ``.npz`` whose arrays have at most ``limit`` bytes unpacked.

    Args:
        file: the open file, or its content as ``io.BytesIO``.
        source: its name, for errors.
        limit: bytes of all arrays together.
        expected: what the caller reads ("a whole map file"), for errors.

    Raises:
        InputError: at once or while arrays are read: damaged, too large, no ``.npz``, an array of Python objects, an
            array that is missing.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            yield StoredArrays(archive, limit)
    except InputError:
        raise
    except KeyError as error:
        raise InputError(source, str(error.args[0]), f"this array of {expected}") from error
    except (zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, ValueError, TypeError) as error:
        raise InputError(source, "file", f"{expected} ({error})") from error
    except (NotImplementedError, RuntimeError, OverflowError) as error:  # zipfile's, for what it does not know
        raise InputError(source, "file", f"{expected} ({error})") from error
