"""Test what the table keeps of a model: clearances of a formula, the sigmoid's sum, ranges by direction."""

import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.plane.scan_room import AnalyticRoom, full_circle
from vssm_gym.errors import InputError
from vssm_gym.model.scan_model import ScanModel
from vssm_gym.planning.scans.range_table import RangeTableConfig, range_table
from vssm_gym.planning.scans.search import clearance_at, sees

ROOM = AnalyticRoom(full_circle(), pillar=(0.3, 0.4, 0.0))  # no pillar


@pytest.fixture(scope="module")
def table():
    return range_table(ROOM, np.array([0.1, 0.1]), np.array([0.9, 0.5]), RangeTableConfig(0.02, near=0.1, width=0.02))


def test_the_clearance_is_the_distance_to_the_nearest_wall(table):
    assert isinstance(ROOM, ScanModel)
    i, j = np.indices(table.clearance.shape)
    x, y = 0.1 + 0.02 * i, 0.1 + 0.02 * j
    nearest = np.minimum(np.minimum(x, 1.0 - x), np.minimum(y, 0.6 - y))
    # Beams 1/64 of a circle apart, headings between: the nearest is within 1.4 degrees of the wall's normal
    np.testing.assert_allclose(table.clearance, nearest, rtol=4e-4)
    assert clearance_at(table, 0.51, 0.31) == pytest.approx(0.29, abs=0.01)
    assert clearance_at(table, 0.05, 0.3) == -1.0


def test_the_danger_sums_the_sigmoid_over_one_scan(table):
    state = np.stack(np.broadcast_arrays(0.5, 0.12, [0.0, np.pi * (1.0 + 1.0 / 64.0)]), axis=-1)
    ranges = np.asarray(ROOM.ranges(jnp.asarray(state, jnp.float32)))
    expected = (0.5 - 0.5 * np.tanh(0.5 * (ranges - 0.1) / 0.02)).sum(axis=-1).mean()
    assert table.danger[20, 1] == pytest.approx(expected, rel=1e-3)


def test_a_range_is_found_by_its_direction(table):
    assert sees(table, 0.5, 0.3, 0.6, 0.3, 0.49)
    assert not sees(table, 0.5, 0.3, 0.6, 0.3, 0.51)
    assert not sees(table, 0.5, 0.3, 0.5, 0.2, 0.31)
    assert sees(table, 0.5, 0.3, 0.4, 0.3, 0.49)


def test_a_scanner_that_looks_ahead_is_turned_all_around():
    """Two headings of half a circle see what one of a full circle does."""
    angles = np.pi * ((np.arange(64) + 0.5) / 64 - 0.5)
    ahead = AnalyticRoom(type(ROOM.scanner)(jnp.asarray(angles, jnp.float32), jnp.zeros(3), jnp.float32(1.5)))
    half = range_table(ahead, np.array([0.1, 0.1]), np.array([0.2, 0.2]))
    whole = range_table(AnalyticRoom(full_circle()), np.array([0.1, 0.1]), np.array([0.2, 0.2]))
    np.testing.assert_allclose(half.clearance, whole.clearance, rtol=2e-3)


def test_what_cannot_be_a_table_is_refused():
    with pytest.raises(InputError, match="2 x 2"):
        range_table(ROOM, np.zeros(2), np.zeros(2))
    with pytest.raises(InputError, match="spacing"):
        RangeTableConfig(spacing=0.0)
    with pytest.raises(InputError, match="headings"):
        RangeTableConfig(headings=0)
