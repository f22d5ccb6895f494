"""Test that users' JSON is plain data: finite numbers, bounded nesting, bounded size."""

import gzip
import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.errors import InputError
from vssm_gym.files import json_file
from vssm_gym.files.json_file import JSON_DEPTH, LARGEST_WHOLE, parse_json, parse_json_lines, read_json, read_json_line

texts = st.text(st.characters(codec="utf-8"))  # a lone surrogate has no UTF-8
plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(1 - LARGEST_WHOLE, LARGEST_WHOLE - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | texts,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(texts, inner, max_size=4),
    max_leaves=20,
)


@given(plain)
def test_plain_data_is_read_as_the_library_reads_it(data: Any) -> None:
    assert parse_json(json.dumps(data, ensure_ascii=False).encode(), "file") == data


@pytest.mark.parametrize("brackets", ["[]", '{"a":}'])
@pytest.mark.parametrize("depth", [JSON_DEPTH, JSON_DEPTH + 1, 3000, 200_000])
def test_nesting_is_bounded(brackets: str, depth: int) -> None:
    text = (brackets[:-1] * depth + "1" * (len(brackets) > 2) + brackets[-1] * depth).encode()
    if depth <= JSON_DEPTH:
        assert parse_json(text, "file")
    else:
        with pytest.raises(InputError, match="nested"):
            parse_json(text, "file")


@pytest.mark.parametrize("text", ["NaN", "[-Infinity]", "1e400", "9" * 19, "-" + "9" * 5000, f"{LARGEST_WHOLE}"])
def test_numbers_that_no_array_holds_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="numbers"):
        parse_json(text.encode(), "file")


@pytest.mark.parametrize("text", [b"", b"{", b"\xff", b"[1,]", b"{'a': 1}", b"[1] 2"])
def test_invalid_json_is_refused(text: bytes) -> None:
    with pytest.raises(InputError):
        parse_json(text, "file")


def test_sizes_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "scene.json"
    path.write_text(json.dumps(list(range(100))))
    assert read_json(path) == list(range(100))
    with pytest.raises(InputError, match="at most 10 bytes"):
        read_json(path, 10)


@pytest.mark.parametrize("suffix", ["jsonl", "jsonl.gz"])
def test_lines_are_found_and_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str) -> None:
    path = tmp_path / f"scenes.{suffix}"
    content = "".join(f"[{i}]\n" for i in range(50)).encode()
    path.write_bytes(gzip.compress(content) if suffix.endswith("gz") else content)
    assert [read_json_line(path, i) for i in (0, 49)] == [[0], [49]]
    with pytest.raises(InputError, match="below 50"):
        read_json_line(path, 50)
    monkeypatch.setattr(json_file, "LINES", 10)
    with pytest.raises(InputError, match="below 10"):  # at once, for every content
        read_json_line(path, 49)
    monkeypatch.setattr(json_file, "LINES_BYTES", 20)
    with pytest.raises(InputError, match="20 in all"):
        read_json_line(path, 9)


def test_rows_are_numbered_and_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    content = b'{"a": 0}\r\n{"a": 1}\n{"a": 2}'
    assert list(parse_json_lines(content, "log", "a row")) == [(1, {"a": 0}), (2, {"a": 1}), (3, {"a": 2})]
    monkeypatch.setattr(json_file, "ROWS", 1)
    with pytest.raises(InputError, match="log: lines: expected at most 1"):
        list(parse_json_lines(content, "log", "a row"))
