"""Test Habitat's episode files: frames by a round trip, files that come back as they were, and damaged ones refused."""

import copy
import gzip
import json
import tempfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.helpers.damage import damaged_json
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.tasks import habitat
from vssm_gym.envs.tasks.navigation import TaskSampler, task_set
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import wrap_angle

R_WORLD_HABITAT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
COORDINATES = st.floats(-1e4, 1e4)


@pytest.fixture(scope="module")
def oak():
    return load_scene("oak")


@pytest.fixture(scope="module")
def sampler(oak):
    return TaskSampler(oak, HolonomicRobot())


@pytest.fixture(scope="module")
def tasks(oak):
    return task_set(oak, HolonomicRobot(), "test", 6)


def foreign(tasks: Any) -> dict[str, Any]:
    """Return a file as Habitat's generator writes it: rounded quaternions, heights, fields that we do not use."""
    episodes = []
    for task in tasks.tasks:
        angle = task.start[2] - np.pi / 2
        episodes.append(
            {
                "episode_id": f"{task.id}",
                "scene_id": "data/scene_datasets/gibson/oak.glb",
                "start_position": [task.start[0], 0.0833, -task.start[1]],
                "start_rotation": [0, -round(np.sin(angle / 2), 7), 0, -round(np.cos(angle / 2), 7)],
                "info": {"geodesic_distance": 6.34, "difficulty": "easy"},
                "goals": [{"position": [task.goal[0], 0.0833, -task.goal[1]], "radius": None, "iou": [1, 2.5e-7]}],
                "shortest_paths": [[{"position": [0.1, 0.2, 0.3], "action": 1}]],
                "start_room": None,
                "is_thda": False,
            }
        )
    return {"content_scenes_path": "{data_path}/content/{scene}.json.gz", "episodes": episodes, "extra": {"a": [None]}}


@given(COORDINATES, COORDINATES, COORDINATES)
def test_positions_round_trip_exactly(x, y, height):
    there = habitat.to_habitat((x, y), height)
    assert habitat.from_habitat(there) == (x, y)
    np.testing.assert_array_equal(R_WORLD_HABITAT @ there, [x, y, height])
    assert np.linalg.det(R_WORLD_HABITAT) == 1.0


@given(st.floats(-np.pi, np.pi), st.sampled_from([1.0, -1.0]))
def test_headings_round_trip_and_point_where_the_agent_looks(heading, sign):
    """A quaternion and its negative are one rotation; Habitat's agent looks along -z."""
    rotation = [sign * value for value in habitat.rotation_of(heading)]
    back = habitat.heading_of(rotation)
    assert abs(wrap_angle(back - heading)) < 1e-11
    looks = R_WORLD_HABITAT @ Rotation.from_quat(rotation).apply([0.0, 0.0, -1.0])
    np.testing.assert_allclose(looks, [np.cos(heading), np.sin(heading), 0.0], atol=1e-12)


def test_tasks_come_back_from_a_file(tasks, sampler, oak, tmp_path):
    path = tmp_path / "oak.json.gz"
    habitat.write_habitat(habitat.habitat_file(tasks, sampler), path)
    assert habitat.read_habitat(path).task_set(oak, HolonomicRobot()) == tasks


def test_distances_are_those_to_the_goal_itself(tasks, sampler):
    for task, episode in zip(tasks.tasks, habitat.habitat_file(tasks, sampler).content["episodes"], strict=True):
        outside = episode["info"]["geodesic_distance"] - task.geodesic  # of the success region, 0.4 m
        assert 0.4 - 1e-5 <= outside < 0.8
        assert episode["goals"][0]["radius"] == 0.4


def test_a_foreign_file_drives_the_environment_and_comes_back_unchanged(tasks, sampler, oak, tmp_path):
    path, back = tmp_path / "val.json.gz", tmp_path / "back.json.gz"
    content = foreign(tasks)
    path.write_bytes(gzip.compress(json.dumps(content).encode()))
    file = habitat.read_habitat(path)
    read = file.task_set(oak, HolonomicRobot())
    for found, task in zip(read.tasks, tasks.tasks, strict=True):
        np.testing.assert_allclose((*found.start, *found.goal), (*task.start, *task.goal), atol=1e-6)

    env = gym.make("vssm_gym/PointNav-v0", scene=oak, tasks=read, noise="none")
    for task in read.tasks[:3]:
        observation, info = env.reset(seed=0, options={"task": task})
        np.testing.assert_allclose(info["start_pose"], task.start)
        np.testing.assert_allclose(observation["goal"], task.goal, rtol=1e-6)
        env.step(np.zeros(4, np.float32))
    env.reset(seed=1)
    assert env.unwrapped.task in read.tasks
    env.close()

    habitat.write_habitat(file.with_tasks(read.tasks, sampler), back)
    assert gzip.decompress(back.read_bytes()).decode() == json.dumps(content)


def test_a_changed_task_changes_its_episode_alone(tasks, sampler, oak):
    content = foreign(tasks)
    file = habitat.HabitatFile("val", copy.deepcopy(content))
    read = file.task_set(oak, HolonomicRobot())
    moved = read.tasks[2].model_copy(update={"goal": read.tasks[0].goal})
    others = [*read.tasks[:2], moved, *read.tasks[3:]]
    changed = file.with_tasks(others, sampler).content
    assert file.content == content
    assert changed["episodes"][:2] + changed["episodes"][3:] == content["episodes"][:2] + content["episodes"][3:]
    new, old = changed["episodes"][2], content["episodes"][2]
    assert new["goals"][0]["position"] == content["episodes"][0]["goals"][0]["position"]
    assert (new["goals"][0]["iou"], new["info"]["difficulty"]) == (old["goals"][0]["iou"], "easy")
    assert new["info"]["geodesic_distance"] != old["info"]["geodesic_distance"]
    assert new["shortest_paths"] is None
    fewer, more = (file.with_tasks(some, sampler).content["episodes"] for some in (others[:4], [*others, moved]))
    assert len(fewer) == 4 and len(more) == 7 and more[6]["scene_id"] == "data/scene_datasets/gibson/oak.glb"
    assert len({str(episode["episode_id"]) for episode in more}) == 7


def test_scenes_of_a_file_are_kept_apart(tasks, oak):
    content = foreign(tasks)
    for episode in content["episodes"][::2]:
        episode["scene_id"] = "gibson/Cantwell.glb"
    file = habitat.HabitatFile("val", content)
    assert file.of_scene("oak") == [1, 3, 5] and file.of_scene("gibson/Cantwell.glb") == [0, 2, 4]
    assert len(file.task_set(oak, HolonomicRobot(), scene_id="Cantwell").tasks) == 3
    with pytest.raises(
        InputError, match=r"val: episodes.scene_id: expected an episode of scene 'elm'; it has those of"
    ):
        file.of_scene("elm")


def test_an_episode_in_a_wall_is_named(tasks, oak):
    content = foreign(tasks)
    content["episodes"][4]["goals"][0]["position"] = [500.0, 0.0, 0.0]
    with pytest.raises(InputError, match=r"val: episodes\[4\].goal: expected a position where the robot fits"):
        habitat.HabitatFile("val", content).task_set(oak, HolonomicRobot())


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda e: e.pop("start_position"), r"episodes\[1\].start_position: expected numbers"),
        (lambda e: e.update(start_position=[1, 2]), r"start_position: expected numbers of at most 10000, 3 of them"),
        (lambda e: e.update(start_rotation=[0, 0, 0, 2]), "start_rotation: expected numbers of at most 1.001"),
        (lambda e: e.update(start_rotation=[0, 0, 0, 0.5]), "start_rotation: expected a unit quaternion"),
        (
            lambda e: e.update(start_rotation=[1, 0, 0, 0]),
            "start_rotation: expected a unit quaternion x, y, z, w about",
        ),
        (lambda e: e.update(goals=[]), "goals: expected a list of one goal"),
        (lambda e: e["goals"][0].update(position=["0", 0, 0]), r"goals\[0\].position: expected numbers"),
        (lambda e: e.update(scene_id=7), "scene_id: expected a text"),
        (lambda e: e.update(episode_id=None), "episode_id: expected a text or a whole number"),
        (lambda e: e.update(info=[]), "info: expected an object, or null"),
    ],
)
def test_a_wrong_field_is_named(tasks, tmp_path, change, complaint):
    content = foreign(tasks)
    change(content["episodes"][1])
    path = tmp_path / "val.json"
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=complaint):
        habitat.read_habitat(path)


@pytest.mark.parametrize("content", [b"", b"{}", b"[]", b'{"episodes": []}', b'{"episodes": [1]}', b"\x1f\x8b\x08\x00"])
@pytest.mark.parametrize("name", ["val.json", "val.json.gz"])
def test_what_is_no_file_of_episodes_is_refused(tmp_path, content, name):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=name):
        habitat.read_habitat(tmp_path / name)


def test_a_packed_bomb_is_refused(tmp_path):
    (tmp_path / "val.json.gz").write_bytes(gzip.compress(b" " * (habitat.HABITAT_BYTES + 1)))
    with pytest.raises(InputError, match="at most 67,108,864 bytes when unpacked"):
        habitat.read_habitat(tmp_path / "val.json.gz")


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_damaged_files_are_read_or_refused(data):
    """Read files have finite tasks, and refusals are one sentence."""
    episode = {"episode_id": "0", "scene_id": "a.glb", "start_position": [0, 0, 0], "start_rotation": [0, 0, 0, 1]}
    valid = {"episodes": [episode | {"goals": [{"position": [1.0, 0.0, 2.0], "radius": 0.2}], "info": {}}]}
    damaged = data.draw(damaged_json(valid))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "val.json"
        path.write_text(json.dumps(damaged))
        try:
            file = habitat.read_habitat(path)
        except InputError as error:
            assert "\n" not in str(error)
            return
    for episode in file.content["episodes"]:
        start, goal = habitat.endpoints(episode)
        assert np.isfinite([*start, *goal]).all()
