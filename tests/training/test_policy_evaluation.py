"""Test the evaluation of policies: imagined episodes by hand, and the gap between imagination and the simulator."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.box_rooms import two_rooms
from tests.helpers.dynamics.transitions import random_transition
from tests.helpers.imagined_room import room, task
from tests.helpers.straight_policy import straight
from vssm_gym.agents.policy import policy_file
from vssm_gym.envs.pointnav import POINTNAV_REWARD
from vssm_gym.envs.scenes.scene import save_scene
from vssm_gym.envs.tasks.navigation import load
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.log import read_rows
from vssm_gym.eval.sweep.config import SweepConfig
from vssm_gym.eval.sweep.runner import run_sweep
from vssm_gym.maps.map_file import map_hash
from vssm_gym.model.transition.learned_file import calibrated, save_transition
from vssm_gym.training.evaluation import METRICS, evaluate_policy, files_of
from vssm_gym.training.imagined_episodes import STEPS, imagine, real_return


@pytest.fixture
def ahead():
    """Return tasks with the goal 2 m straight ahead, the success region 1.6 m away."""
    one = task((1.0, 1.2, 0.0), (3.0, 1.2))
    object.__setattr__(one, "geodesic", 1.6)
    return one


@pytest.mark.slow
def test_an_imagined_success_by_hand(tmp_path, ahead):
    room().save(tmp_path / "room.npz")
    (row,) = imagine(straight(), tmp_path / "room.npz", [ahead], "none")
    assert row["success"] and row["collisions"] == 0
    assert 10 <= row["steps"] <= 14  # 16 cm each, and the stop
    assert 1.6 <= row["path_length"] < 1.85
    assert row["spl"] == pytest.approx(1.6 / row["path_length"])
    assert row["return"] == pytest.approx(1.6 - POINTNAV_REWARD.step_cost * row["steps"] + POINTNAV_REWARD.success)


def test_an_imagined_failure_by_hand(tmp_path, ahead):
    """The robot stands still until the time limit: no progress, and a cost for every step."""
    room().save(tmp_path / "room.npz")
    (row,) = imagine(straight(step=-1.0), tmp_path / "room.npz", [ahead], "none")
    assert not row["success"] and row["spl"] == 0.0 and row["steps"] == STEPS
    assert row["path_length"] < 1e-3
    assert row["return"] == pytest.approx(-POINTNAV_REWARD.step_cost * STEPS, abs=0.1)  # 3 % of a grid's ways


@pytest.mark.slow
def test_the_gap_is_imagined_minus_simulated(tmp_path):
    """The sweep in two rooms gives rows; means and gap are those of the rows, task by task."""
    file, out, scene = tmp_path / "straight.npz", tmp_path / "out", str(tmp_path / "rooms.json")
    policy_file.save(file, straight())
    save_scene(two_rooms(), tmp_path / "rooms.json")
    found = evaluate_policy(file, out, scene=scene, tasks=2)
    real = [{**row, "return": real_return(row)} for row in read_rows(out / "episodes.jsonl")]
    tasks, map_file = files_of(out, scene)
    imagined = imagine(straight(), map_file, load(tasks).tasks[:2], "low", 0)
    stored = json.loads((out / "evaluation.json").read_text())
    assert found.imagined is not None and found.gap is not None and found.notice == ""
    assert sorted(row["task"] for row in real) == [row["task"] for row in imagined]
    for metric in METRICS:
        there, here = (np.mean([row[metric] for row in rows]) for rows in (imagined, real))
        assert found.imagined[metric].mean == pytest.approx(there)
        assert found.real[metric].mean == pytest.approx(here)
        assert found.gap[metric].mean == pytest.approx(there - here)
        assert stored["gap"][metric][0] == pytest.approx(found.gap[metric].mean)

    # A given map is that of the agents and of imagination: nothing is recorded, and the same map gives the same rows.
    given, again = tmp_path / "given.npz", tmp_path / "again"
    given.write_bytes(map_file.read_bytes())
    same = evaluate_policy(file, again, scene=scene, tasks=2, map_file=given)
    assert same == found and not (again / "recordings").exists()
    assert files_of(again, scene)[1].read_bytes() == given.read_bytes()
    hashes = {row["map_hash"] for row in read_rows(again / "episodes.jsonl")}
    assert hashes == {map_hash(given)} == {json.loads((again / "evaluation.json").read_text())["map"]}
    assert evaluate_policy(file, again, scene=scene, tasks=2, map_file=given, resume=True) == found
    shipped = evaluate_policy(Path("reactive"), tmp_path / "shipped", scene=scene, tasks=1, map_file=given)
    assert shipped.label.startswith("reactive@")
    room().save(tmp_path / "room.npz")
    for other in (tmp_path / "room.npz", None):
        with pytest.raises(InputError, match=r"map_hash: expected .* another sweep belongs into another folder"):
            evaluate_policy(file, again, scene=scene, tasks=2, map_file=other, resume=True)


def saved_transition(folder, kind):
    """Write a learned transition of a kind of robot."""
    save_transition(folder / f"{kind}.npz", random_transition(calibrated(kind)), kind, {})
    return folder / f"{kind}.npz"


def test_a_map_or_transition_that_does_not_fit_is_refused(tmp_path):
    """No file, a map in its first camera's frame, another robot's motion: nothing runs and nothing is written."""
    file, out, scene = tmp_path / "straight.npz", tmp_path / "out", str(tmp_path / "rooms.json")
    policy_file.save(file, straight())
    save_scene(two_rooms(), tmp_path / "rooms.json")
    room().save(tmp_path / "walk.npz", sequence="walk")
    for given, message in ((tmp_path / "none.npz", "an existing map file"), (tmp_path / "walk.npz", "frame: expected")):
        with pytest.raises(InputError, match=message):
            evaluate_policy(file, out, scene=scene, tasks=1, map_file=given)
    wrong = saved_transition(tmp_path, "car")
    for given, message in ((tmp_path / "none.npz", "a learned transition"), (wrong, "kind: expected holonomic")):
        with pytest.raises(InputError, match=message):
            evaluate_policy(file, out, scene=scene, tasks=1, transition=given)
    assert not out.exists()
    config = SweepConfig(scenes=(scene, "oak"), agents=("oracle",), tasks=(0,))
    with pytest.raises(InputError, match="map: expected a configuration of one scene; found 2"):
        run_sweep(config, out, map_file=tmp_path / "walk.npz")
    assert not out.exists()
