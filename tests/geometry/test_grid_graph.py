"""Test the 16-neighbour graph: its moves, its edges by brute force, and the excess length of its paths."""

import math

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from scipy.sparse.csgraph import dijkstra

from tests.helpers.planning_worlds import grids
from vssm_gym.geometry.grid_graph import LENGTHS, LONGEST, MOVES, edge_free, edges, graph


def test_moves_are_all_directions_up_to_a_knights_move():
    expected = {(i, j) for i in range(-2, 3) for j in range(-2, 3) if math.gcd(i, j) == 1}
    assert {tuple(int(v) for v in move) for move in MOVES} == expected
    assert len(MOVES) == 16
    assert np.array_equal(LENGTHS, np.linalg.norm(MOVES, axis=1))
    assert pytest.approx(math.sqrt(5.0)) == LONGEST


@given(grids())
def test_every_edge_once(occupied):
    free = ~occupied
    begin, end, length = edges(free)
    found = {frozenset(pair) for pair in zip(begin.tolist(), end.tolist(), strict=True)}
    assert len(found) == len(begin)
    ny = free.shape[1]
    expected = {
        frozenset((i * ny + j, (i + di) * ny + j + dj))
        for i, j in np.argwhere(free).tolist()
        for di, dj in MOVES.tolist()
        if 0 <= i + di < free.shape[0] and 0 <= j + dj < ny and free[i + di, j + dj]
    }
    assert found == expected
    apart = np.hypot(begin // ny - end // ny, begin % ny - end % ny)
    assert np.array_equal(length, apart)


@given(grids(), st.integers(0, 15), st.integers(0, 2**32 - 1))
def test_a_free_edge_reads_free_cells_only(occupied, m, seed):
    """Samples along the edge: each cell with a bilinear weight there is free, and only then is the edge."""
    free = ~occupied
    if not free.any():
        return
    i, j = np.random.default_rng(seed).choice(np.argwhere(free))
    di, dj = MOVES[m]
    inside = 0 <= i + di < free.shape[0] and 0 <= j + dj < free.shape[1]
    read = {
        (a, b)
        for t in np.linspace(0.0, 1.0, 61)
        for a in (math.floor(i + t * di + 1e-9), math.ceil(i + t * di - 1e-9))
        for b in (math.floor(j + t * dj + 1e-9), math.ceil(j + t * dj - 1e-9))
    }
    assert edge_free(free.astype(np.uint8), int(i), int(j), int(di), int(dj)) == (
        inside and all(free[cell] for cell in read)
    )


def test_paths_exceed_straight_lines_by_at_most_2_75_per_cent():
    """The bound of the module, reached half-way between a straight and a knight's move."""
    shape = (61, 61)
    free = np.ones(shape, bool)
    found = dijkstra(graph(free.size, *edges(free)), directed=False, indices=30 * 61 + 30).reshape(shape)
    i, j = np.indices(shape) - 30
    straight = np.hypot(i, j)
    ratio = found[straight > 0.0] / straight[straight > 0.0]
    assert ratio.min() >= 1.0 - 1e-12
    assert 1.027 < ratio.max() <= 1.0 / math.cos(0.5 * math.atan(0.5)) + 1e-12
