"""Test the choice of rows that are run again, and the comparison of a row with what was written."""

import math

from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.eval.reproduction.comparison import NOT_OUTCOMES, first_difference, spread_evenly


@given(st.integers(1, 60), st.integers(1, 60))
def test_rows_are_chosen_from_the_first_to_the_last(rows, most):
    chosen = [row["k"] for row in spread_evenly([{"k": k} for k in range(rows)], most)]
    assert len(chosen) == min(rows, most) and chosen == sorted(set(chosen))
    assert chosen[0] == 0 and (most == 1 or chosen[-1] == rows - 1)


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-5, 5) | st.floats(-5.0, 5.0) | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=2), inner, max_size=3),
    max_leaves=8,
)


@given(row=st.dictionaries(st.text(max_size=4), VALUES, max_size=5), later=VALUES)
def test_a_row_agrees_with_itself_and_with_fields_that_came_later(row, later):
    assert first_difference(row, row, 0.0) is None
    assert first_difference(row, {"came_later": later} | row, 0.0) is None


@given(value=st.floats(-10.0, 10.0), off=st.floats(0.0, 0.1))
def test_numbers_agree_within_the_tolerance(value, off):
    found = first_difference({"outer": [{"inner": value}]}, {"outer": [{"inner": value + off}]}, 0.01)
    allowed = 0.01 * max(1.0, abs(value), abs(value + off))
    if not math.isclose(off, allowed, abs_tol=1e-9):
        assert (found is None) == (off < allowed)
    assert found is None or found.startswith("outer[0].inner: expected")


def test_kinds_that_differ_never_agree():
    assert first_difference({"success": True}, {"success": 1}, 0.5) == "success: expected True, now 1"
    assert first_difference({"status": "arrived"}, {}, 0.5) == "status: expected 'arrived'; now it is not there"
    assert first_difference({"goal": [1.0]}, {"goal": [1.0, 2.0]}, 0.5) is not None
    assert first_difference(dict.fromkeys(NOT_OUTCOMES, 1), dict.fromkeys(NOT_OUTCOMES, 2), 0.0) is None
