"""Damage files: every importer must return a valid apartment or raise one `InputError`."""

import copy
import math
from typing import Any

from hypothesis import strategies as st

from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.errors import InputError

VALUES = [
    None, True, 0, -1, 1e-300, 1e30, -1e30, 10**400, math.nan, math.inf, "", "x" * 500, "\0", "../../etc/passwd", [],
    {}, [[]], {"x": 1}, [1e9, 1e9], [[0, 0]] * 50, [0, 0, 0, 0], 0.1, 2, 1000, 1e5, ["a"] * 3,
]  # fmt: skip


def _paths(data: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    keys = data.keys() if isinstance(data, dict) else range(len(data)) if isinstance(data, list) else ()
    return [path, *(inner for key in keys for inner in _paths(data[key], (*path, key)))]


def _changed(data: Any, path: tuple[Any, ...], value: Any) -> Any:
    if not path:
        return value
    data = copy.copy(data)
    if value is ... and len(path) == 1:
        del data[path[0]]
    else:
        data[path[0]] = _changed(data[path[0]], path[1:], value)
    return data


@st.composite
def damaged_json(draw: st.DrawFn, data: Any) -> Any:
    """Return ``data`` with one to three parts removed, replaced by nonsense, or copied over another part."""
    for _ in range(draw(st.integers(1, 3))):
        path = draw(st.sampled_from(_paths(data)))
        kind = draw(st.sampled_from(["remove", "value", "value", "number", "copy"]))
        value: Any = draw(st.sampled_from(VALUES))
        if kind == "remove" and path:
            value = ...
        elif kind == "number":
            value = draw(st.floats(-200, 200))
        elif kind == "copy":
            value = data
            for key in draw(st.sampled_from(_paths(data))):
                value = value[key]
        data = _changed(data, path, value)
    return data


@st.composite
def damaged_bytes(draw: st.DrawFn, content: bytes) -> bytes:
    """Return ``content`` cut off, with bytes overwritten, or with a stretch moved or repeated."""
    for _ in range(draw(st.integers(1, 3))):
        a, b = sorted(draw(st.integers(0, len(content))) for _ in range(2))
        kind = draw(st.sampled_from(["cut", "overwrite", "repeat", "insert"]))
        if kind == "cut":
            content = content[:a] + content[b:]
        elif kind == "overwrite":
            content = content[:a] + draw(st.binary(max_size=8)) + content[a + 4 :]
        elif kind == "repeat":
            content = content[:b] + content[a:b] + content[b:]
        else:
            nasty = [b"\0", b"nan", b"1e999", b"-", b"999999999", b"<!", b"&a;", b"*a", b"\xff\xfe", b"[" * 2000]
            content = content[:a] + draw(st.sampled_from(nasty)) + content[a:]
    return content


def valid_or_refused(load: Any) -> Apartment | None:
    """Return the apartment of ``load()``, with its boxes made; None for an `InputError` of one line."""
    try:
        apartment = load()
    except InputError as error:
        assert "\n" not in str(error) and len(str(error)) < 2000, str(error)
        return None
    assert isinstance(apartment, Apartment)
    boxes = apartment.boxes()
    assert all(math.isfinite(v) for box in boxes for v in (*box.center, *box.size, box.yaw))
    assert all(min(box.size) > 0.0 for box in boxes)
    return apartment
