"""Test that maps and policies that come with the package load by name, wherever a path is asked for."""

import json
from pathlib import Path

import numpy as np
import pytest

from vssm_gym.agents.policy.policy_file import agent_label, label, policy_at
from vssm_gym.agents.registry import make_agent
from vssm_gym.errors import InputError
from vssm_gym.files.shipped import ASSETS, MAPS, POLICIES, beside, names, shipped
from vssm_gym.maps.voxel_map import VoxelMap, read_metadata
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.planners import plan

SIZES = {MAPS: 2_000_000, POLICIES: 300_000}


@pytest.mark.parametrize("folder", SIZES)
def test_they_are_small(folder):
    assert names(folder)
    for name in names(folder):
        assert shipped(name, folder).stat().st_size <= SIZES[folder]


def test_a_file_that_is_there_hides_a_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert shipped("oak", MAPS) == ASSETS / "maps" / "oak.npz"
    (tmp_path / "oak").write_bytes(b"mine")
    assert shipped("oak", MAPS) == Path("oak")
    assert shipped("oak.npz", MAPS) == Path("oak.npz")
    assert shipped("maps/oak", MAPS) == Path("maps/oak")


def test_a_path_in_a_file_is_taken_from_its_folder(tmp_path):
    assert beside("mine.npz", tmp_path, MAPS) == tmp_path / "mine.npz"
    assert beside("sub/oak", tmp_path, MAPS) == tmp_path / "sub" / "oak"
    assert beside("oak", tmp_path, MAPS) == ASSETS / "maps" / "oak.npz"
    (tmp_path / "oak").write_bytes(b"mine")
    assert beside("oak", tmp_path, MAPS) == tmp_path / "oak"


def test_an_unknown_name_says_which_there_are():
    with pytest.raises(InputError, match="comes with the package: oak"):
        VoxelMap.load("nowhere")


@pytest.mark.parametrize("name", names(POLICIES))
def test_a_policy_is_an_agent_by_its_name(name, tmp_path):
    agent = make_agent(f"policy:{name}")
    assert agent.needs_map
    assert agent_label(policy_at(f"policy:{name}", tmp_path)) == label(ASSETS / "policies" / f"{name}.npz")


def test_the_map_of_oak_shows_its_rooms():
    """Paths planned in it are as long as the shortest ones in the apartment."""
    floor = ClearanceMap.from_voxel_map(VoxelMap.load("oak"))
    tasks = json.loads((ASSETS / "tasks" / "oak-test.json").read_text())["tasks"][:8]
    for task in tasks:
        found = plan(np.array(task["start"]), np.array(task["goal"]), floor, 0.2, goal_radius=0.4)
        assert found.found
        assert found.cost == pytest.approx(task["geodesic"], rel=0.08)
    assert read_metadata("oak")["format"] == "vssm_gym.VoxelMap"
