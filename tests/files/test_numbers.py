"""Test checks of numbers: accepted ones are real, finite, of the stated shape, and stay so as float32."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.errors import InputError
from vssm_gym.files import bounded, numbers
from vssm_gym.files.numbers import LARGEST_NUMBER, as_float32, floats, read_table, whole


@given(st.lists(st.floats(-LARGEST_NUMBER, LARGEST_NUMBER) | st.integers(-1000, 1000), min_size=6, max_size=6))
def test_lists_of_numbers_become_arrays(values: list[float]) -> None:
    nested = [values[:3], values[3:]]
    for given_as in (values, nested, np.array(nested)):
        np.testing.assert_array_equal(floats(given_as, (2, 3), "file", "K"), np.array(nested, float))


@pytest.mark.parametrize(
    "value",
    [
        *(None, "1", True, {"a": 1}, [1, 2], [[1], [2]], [[[[[1, 2, 3]]]]], np.array([1, 2, 3j])),
        *([1, 2, x] for x in ("3", True, float("nan"), float("inf"), 10**400, 1e13)),
    ],
)
def test_an_invalid_list_is_refused(value: Any) -> None:
    with pytest.raises(InputError, match="file: K: expected numbers"):
        floats(value, (3,), "file", "K")


def test_positive_numbers_are_enforced() -> None:
    assert floats(2, (), "file", "f", positive=True) == 2.0
    for value in (0.0, -1.0):
        with pytest.raises(InputError, match="positive"):
            floats(value, (), "file", "f", positive=True)


@pytest.mark.parametrize("value", [0, 11, 2.0, "3", True, None, 10**400])
def test_whole_numbers_stay_in_their_range(value: Any) -> None:
    assert whole(10, "file", "n", least=1, most=10) == 10
    with pytest.raises(InputError, match="file: n: expected a whole number"):
        whole(value, "file", "n", least=1, most=10)


@pytest.mark.parametrize("value", [1e300, -1e300, np.nan, np.inf])
def test_overflow_in_the_cast_is_refused(value: float) -> None:
    with pytest.raises(InputError, match="finite"):
        as_float32(np.array([1.0, value]), "file", "a")


def test_underflow_in_the_cast_is_not_positive() -> None:
    assert as_float32(np.array([1e-300]), "file", "a") == 0.0
    with pytest.raises(InputError, match="positive"):
        as_float32(np.array([1.0, 1e-300]), "file", "a", positive=True)
    with pytest.raises(InputError, match="floats"):
        as_float32(np.array([1]), "file", "a")


@pytest.mark.parametrize("text", ["1 nan\n", "1 inf\n", "1 1e300\n", "1 x\n", "1 2\n3\n", "1 2 3\n", "\xff"])
def test_tables_hold_finite_numbers_in_columns(tmp_path: Path, text: str) -> None:
    path = tmp_path / "table.txt"
    path.write_text("# time value\n1 2\n3 4\n")
    assert read_table(path, "time and value", columns=2).tolist() == [[1, 2], [3, 4]]
    path.write_bytes(text.encode("latin1"))
    with pytest.raises(InputError, match="time and value"):
        read_table(path, "time and value", columns=2)


@pytest.mark.parametrize("text", ["", "\n", "# nothing\n"])
def test_an_empty_table_has_no_lines(tmp_path: Path, text: str) -> None:
    (tmp_path / "table.txt").write_text(text)
    assert read_table(tmp_path / "table.txt", "numbers", columns=7).shape == (0, 7)


@pytest.mark.parametrize(
    ("module", "bound", "said"),
    [
        (numbers, "TABLE_LINES", "at most 2 of them"),
        (numbers, "TABLE_NUMBERS", "at most 2 numbers"),
        (bounded, "LINE_BYTES", "at most 2 bytes in each"),
    ],
)
def test_a_table_is_bounded_by_what_it_takes_as_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: Any, bound: str, said: str
) -> None:
    """Text of two bytes a number takes four times as much when it is read."""
    path = tmp_path / "table.txt"
    path.write_text("0 1\n" * 3)
    assert read_table(path, "numbers").shape == (3, 2)
    monkeypatch.setattr(module, bound, 2)
    with pytest.raises(InputError, match=said):
        read_table(path, "numbers")
    path.write_text("# 0\n" * 3)  # comments are lines, too
    if bound != "TABLE_NUMBERS":
        with pytest.raises(InputError, match=said):
            read_table(path, "numbers")
