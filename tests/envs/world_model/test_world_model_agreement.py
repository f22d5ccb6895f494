"""Test that imagined and simulated robots agree, by the same commands without noise in a map learned from images."""

from pathlib import Path

import pytest

from vssm_gym.eval.bench.imagined_replay import replay
from vssm_gym.slam.map_building import ensure_map

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def learned(tmp_path_factory) -> Path:
    return ensure_map("oak", tmp_path_factory.mktemp("learned"), voxel=0.05, seed=0)


def test_positions_scans_and_rewards_of_imagined_robots_equal_the_simulated_ones(learned):
    """Medians over rollouts of 5 s: position within 2 cm, scans within 5 cm."""
    found = replay("oak", learned, rollouts=100, seed=0)
    assert found["all"]["position_m"]["p50"] < 0.02
    assert found["all"]["scan_m"]["p50"] < 0.05
    assert found["free"]["position_m"]["p90"] < 0.001  # without contact the motion is the same law
    assert found["all"]["rays_compared"] > 0.9
    assert found["free"]["return"]["p50"] < 0.1  # of some m driven: two grids of distances
    assert found["collisions"] > 0
