"""Test the number of collisions per metre, by hand and as a law."""

import hypothesis.strategies as st
import pytest
from hypothesis import given

from vssm_gym.eval.metrics.collision_rate import collision_rate


def test_by_hand():
    assert collision_rate({"collisions": 6, "path_length": 4.0}) == 1.5
    assert collision_rate({"collisions": 0, "path_length": 4.0}) == 0.0


@pytest.mark.parametrize("row", [{}, {"collisions": 3}, {"path_length": 2.0}, {"collisions": 3, "path_length": 0.0}])
def test_a_row_without_the_fields_has_no_rate(row):
    assert collision_rate(row) is None


@given(collisions=st.integers(0, 500), path=st.floats(0.01, 500.0), scale=st.floats(0.1, 10.0))
def test_a_longer_path_with_as_many_collisions_has_a_lower_rate(collisions, path, scale):
    rate = collision_rate({"collisions": collisions, "path_length": path})
    assert collision_rate({"collisions": collisions, "path_length": scale * path}) == pytest.approx(rate / scale)
