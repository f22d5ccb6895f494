"""Test that imagined and simulated robots agree, by the same commands without noise in a map learned from images."""

from pathlib import Path

import pytest

from tests.helpers.box_rooms import furniture, two_rooms
from vssm_gym.envs.scenes.scene import save_scene
from vssm_gym.eval.bench.imagined_replay import replay
from vssm_gym.slam.map_building import ensure_map

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def rooms(tmp_path_factory) -> Path:
    """A scene of two rooms with furniture: a built-in apartment takes more than a minute to record and learn."""
    pieces = (
        furniture("table", (1.5, 2.9, 0.3), (0.7, 0.6, 0.6)),
        furniture("chest", (4.9, 0.9, 0.45), (0.6, 0.8, 0.9)),
    )
    path = tmp_path_factory.mktemp("scene") / "rooms.json"
    save_scene(two_rooms(pieces=pieces), path)
    return path


@pytest.fixture(scope="module")
def learned(rooms, tmp_path_factory) -> Path:
    return ensure_map(str(rooms), tmp_path_factory.mktemp("learned"), voxel=0.05, seed=0)


def test_positions_scans_and_rewards_of_imagined_robots_equal_the_simulated_ones(rooms, learned):
    """Medians over rollouts of 5 s: position within 2 cm, scans within 5 cm."""
    found = replay(str(rooms), learned, rollouts=60, seed=0)
    assert found["all"]["position_m"]["p50"] < 0.02
    assert found["all"]["scan_m"]["p50"] < 0.05
    assert found["free"]["position_m"]["p90"] < 0.001  # without contact the motion is the same law
    assert found["all"]["rays_compared"] > 0.9
    assert found["free"]["return"]["p50"] < 0.1  # of some m driven: two grids of distances
    assert found["collisions"] > 0
