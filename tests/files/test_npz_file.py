"""Test that arrays in ``.npz`` files are read as by NumPy, or refused with one error before they are unpacked."""

import io
import zipfile
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from vssm_gym.errors import InputError
from vssm_gym.files.npz_file import open_npz

KINDS = st.sampled_from([np.dtype(name) for name in ("<f4", ">f8", "<i8", "|u1", "|b1", "<U3")])


def packed(compressed: bool = True, **arrays: Any) -> bytes:
    file = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(file, **arrays)
    return file.getvalue()


def unpacked(content: bytes, limit: int = 1_000_000) -> dict[str, np.ndarray]:
    with open_npz(io.BytesIO(content), "file", limit, "numbers") as stored:
        return stored.read_all()


@given(
    hnp.arrays(KINDS, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=5)), st.booleans(), st.booleans()
)
def test_arrays_are_read_back(array: np.ndarray, compressed: bool, fortran: bool) -> None:
    array = np.asfortranarray(array) if fortran else array
    with open_npz(io.BytesIO(packed(compressed, a=array, b=1.5)), "file", 100_000, "numbers") as stored:
        assert stored.shapes == {"a": array.shape, "b": ()}
        np.testing.assert_array_equal(stored.read("a"), array)
        assert stored.read("b") == 1.5 and stored.read("a").flags.writeable


@given(st.data())
def test_damage_is_refused_or_changes_nothing(data: st.DataObject) -> None:
    arrays = {"a": np.arange(60, dtype=np.float32).reshape(3, 20), "b": np.arange(5)}
    content = bytearray(packed(data.draw(st.booleans()), **arrays))
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    kept = data.draw(st.integers(len(content) // 2, len(content)))
    try:
        found = unpacked(bytes(content[:kept]))
    except InputError:
        return
    for name in arrays.keys() & found.keys():  # the checksum covers the data, not the names of members
        np.testing.assert_array_equal(found[name], arrays[name])


def test_a_bomb_is_refused_before_it_is_unpacked(monkeypatch: pytest.MonkeyPatch) -> None:
    content = packed(a=np.zeros(10_000_000, np.uint8))
    assert len(content) < 20_000
    monkeypatch.setattr(np, "empty", lambda *_: pytest.fail("memory was asked for"))
    with pytest.raises(InputError, match="at most 1,000,000 bytes"):
        unpacked(content)


def member(content: bytes, flag: int = 0) -> bytes:
    """Return an archive with one member of these bytes under the name of an array."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("a.npy", content)
    archived = bytearray(file.getvalue())
    if flag:
        for signature in (b"PK\x03\x04", b"PK\x01\x02"):
            archived[archived.index(signature) + (6 if signature[2] == 3 else 8)] |= flag
    return bytes(archived)


def header(text: str) -> bytes:
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"no archive",
        packed(a=np.array([{}], dtype=object)),
        member(b""),
        member(b"\x93NUMPY\x03\x00"),
        member(header("{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000,), }")),
        member(header("{'descr': '<f4', 'fortran_order': False, 'shape': (-1,), }")),
        member(header("{'descr': '<f4', 'fortran_order': False, 'shape': (2,), }") + b"\0" * 4),
        member(header("{'descr': '<f4', 'fortran_order': False, 'shape': " + "(" * 3000)),
        member(header("__import__('os').system('true')")),
        member(header("{'descr': '<f4', 'fortran_order': False, 'shape': (1,), }") + b"\0" * 4, flag=1),
        packed(**{f"a{i}": 1 for i in range(300)}),
    ],
)
def test_special_cases_are_refused(content: bytes) -> None:
    with pytest.raises(InputError, match="file: file: expected"):
        unpacked(content)


def test_a_missing_array_is_named() -> None:
    with (
        pytest.raises(InputError, match="weights: expected this array of numbers"),
        open_npz(io.BytesIO(packed(a=1)), "file", 1000, "numbers") as stored,
    ):
        stored.read("weights")
