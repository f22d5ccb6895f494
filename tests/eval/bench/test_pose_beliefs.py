"""Test the comparison of a pose's Gaussians: the filter's is the cautious one, and a few images show it."""

import pytest

from vssm_gym.eval.bench.pose_beliefs import BELIEFS, compare


@pytest.mark.slow
def test_the_filter_states_more_than_the_curvature():
    found = compare(10)
    assert tuple(found) == BELIEFS
    assert found["filter"]["nees"] < 0.2 * found["laplace"]["nees"]
    assert found["variational"]["nees"] == pytest.approx(found["laplace"]["nees"], rel=0.05)
