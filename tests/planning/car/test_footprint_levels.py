"""Test that levels hold for every pose of a bin, not only at cell centres, against exact rectangles."""

import math

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from tests.helpers.car_worlds import CAR, PARKING, RESOLUTION, collides, levels, solid
from vssm_gym.errors import InputError
from vssm_gym.planning.car.footprint_levels import CLEAR, COLLIDING, TIGHT
from vssm_gym.planning.grid_search.goal_distance import goal_distance


def test_no_pose_below_the_colliding_level_collides():
    """This holds anywhere in a bin; a pose with level COLLIDING collides within the size of a bin."""
    rng = np.random.default_rng(0)
    poses = rng.uniform([0.0, 0.0, -7.0], [2.4, 1.6, 7.0], (5_000, 3))
    table, shape = levels(PARKING), solid(PARKING)
    level, colliding = table.at(poses), collides(shape, poses)
    assert not colliding[level < COLLIDING].any()
    needless = ~collides(shape.buffer(RESOLUTION + CAR.length * math.pi / 36), poses) & (level == COLLIDING)
    assert not needless.any()
    assert {CLEAR, TIGHT, COLLIDING} == set(np.unique(level))


def test_every_pose_beyond_the_grid_collides():
    assert levels(PARKING).at(np.array([[-3.0, 0.5, 0.0], [0.5, 9.0, 1.0]])).tolist() == [COLLIDING, COLLIDING]


@pytest.mark.parametrize("seed", range(4))
def test_goal_distance_is_that_of_a_graph(seed):
    """The oracle is scipy's Dijkstra on the graph of 16 neighbours, with the goal as one more node."""
    rng = np.random.default_rng(seed)
    free = rng.random((14, 11)) > 0.35
    gx, gy = rng.uniform(1.0, 9.0, 2)
    index = np.arange(free.size).reshape(free.shape)
    rows, columns, lengths = [], [], []
    for i, j in np.ndindex(free.shape):
        near = max(abs(i - gx), abs(j - gy))
        if near < 1.0 and 0 <= i - math.floor(gx) <= 1 and 0 <= j - math.floor(gy) <= 1:
            rows, columns = [*rows, free.size], [*columns, index[i, j]]
            lengths.append(math.hypot(i - gx, j - gy))
        for a in range(-2, 3):
            for b in range(-2, 3):
                p, q = i + a, j + b
                if math.gcd(a, b) == 1 and 0 <= p < 14 and 0 <= q < 11 and free[p, q]:
                    rows, columns = [*rows, index[i, j]], [*columns, index[p, q]]
                    lengths.append(math.hypot(a, b))
    graph = coo_array((lengths, (rows, columns)), shape=(free.size + 1, free.size + 1)).tocsr()
    expected = dijkstra(graph, indices=free.size)[:-1].reshape(free.shape)
    np.testing.assert_allclose(goal_distance(free, gx, gy), expected, rtol=1e-5)


def test_few_headings_are_refused():
    with pytest.raises(InputError, match="headings"):
        levels(PARKING, headings=4)
