"""Test laws of SPL and SoftSPL, examples that a reader can check by hand, and errors."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from vssm_gym.errors import InputError
from vssm_gym.eval.metrics import navigation as metrics

lengths = st.floats(0.01, 100.0)


@given(success=st.booleans(), geodesic=lengths, taken=st.floats(0.0, 100.0), remaining=st.floats(0.0, 200.0))
def test_bounds(success: bool, geodesic: float, taken: float, remaining: float) -> None:
    value, soft = metrics.spl(success, geodesic, taken), metrics.soft_spl(remaining, geodesic, taken)
    assert 0.0 <= value <= success and 0.0 <= soft <= 1.0
    assert metrics.soft_spl(0.0, geodesic, taken) == metrics.spl(True, geodesic, taken)
    assert soft <= metrics.soft_spl(0.0, geodesic, taken)
    assert metrics.soft_spl(geodesic, geodesic, taken) == 0.0
    if taken <= geodesic:
        assert value == float(success)


@given(geodesic=lengths, taken=lengths, longer=st.floats(0.0, 10.0), scale=st.floats(0.1, 10.0))
def test_longer_paths_are_worth_less_and_units_do_not_matter(
    geodesic: float, taken: float, longer: float, scale: float
) -> None:
    value = metrics.spl(True, geodesic, taken)
    assert metrics.spl(True, geodesic, taken + longer) <= value
    assert metrics.spl(True, geodesic * scale, taken * scale) == pytest.approx(value)


def test_by_hand() -> None:
    values = metrics.spl([True, True, False, True], [2.0, 2.0, 2.0, 3.0], [2.0, 4.0, 2.0, 2.9])
    np.testing.assert_array_equal(values, [1.0, 0.5, 0.0, 1.0])
    np.testing.assert_array_equal(
        metrics.soft_spl([0.0, 1.0, 3.0, np.inf], 2.0, [4.0, 1.0, 1.0, 1.0]), [0.5, 0.5, 0.0, 0.0]
    )


def test_episode_by_hand() -> None:
    positions = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 4.0]])
    estimates = np.array([[0.0, 0.0], [3.0, 0.3], [3.0, 4.4]])
    row = metrics.episode_metrics(
        success=True,
        geodesic=3.5,
        remaining=0.0,
        positions=positions,
        goal=np.array([3.0, 4.25]),
        contacts=[False, True],
        estimates=estimates,
    )
    assert row == {
        "success": True,
        "spl": 0.5,
        "soft_spl": 0.5,
        "path_length": 7.0,
        "geodesic": 3.5,
        "steps": 2,
        "collisions": 1,
        "distance_to_goal": 0.25,
        "location_error_mean": pytest.approx(0.7 / 3),
        "location_error_rmse": pytest.approx(np.sqrt(0.25 / 3)),
        "location_error_max": pytest.approx(0.4),
        "location_error_final": pytest.approx(0.4),
    }
    assert {type(value) for value in row.values()} <= {bool, int, float}


def test_missing_estimates() -> None:
    positions = np.array([[0.0, 0.0], [1.0, 0.0]])
    assert set(metrics.location_errors(positions, None).values()) == {None}
    assert set(metrics.location_errors(positions, np.full((2, 2), np.nan)).values()) == {None}
    partly = metrics.location_errors(positions, np.array([[np.nan, np.nan], [1.0, 0.5]]))
    assert set(partly.values()) == {0.5}


@pytest.mark.parametrize("geodesic", [0.0, -1.0, np.inf, np.nan])
def test_bad_geodesic(geodesic: float) -> None:
    with pytest.raises(InputError, match="geodesic"):
        metrics.spl(True, geodesic, 1.0)


@pytest.mark.parametrize("taken", [-1.0, np.inf, np.nan])
def test_bad_path_length(taken: float) -> None:
    with pytest.raises(InputError, match="path_length"):
        metrics.soft_spl(0.0, 1.0, taken)
    with pytest.raises(InputError, match="remaining"):
        metrics.soft_spl(-1.0, 1.0, 1.0)
