"""Test sweeps whose tasks come from a file: one of ours, or PointNav episodes of Habitat."""

import json

import pytest

from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.tasks import habitat, navigation
from vssm_gym.envs.tasks.navigation import TaskSampler, task_set
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.log import read_rows
from vssm_gym.eval.sweep.config import load_config
from vssm_gym.eval.sweep.manifest import config_hash
from vssm_gym.eval.sweep.runner import run_sweep


@pytest.fixture(scope="module")
def tasks():
    """Return four tasks of the training split, which a sweep does not take by itself."""
    return task_set(load_scene("oak"), HolonomicRobot(), "train", 4)


def configuration(folder, tasks, name, extra=""):
    """Write a file of tasks and a configuration beside it."""
    if name.endswith(".gz"):
        sampler = TaskSampler(load_scene("oak"), HolonomicRobot())
        habitat.write_habitat(habitat.habitat_file(tasks, sampler), folder / name)
    else:
        navigation.save(tasks, folder / name)
    (folder / "s.yaml").write_text(f"scenes: oak\nagents: random\ntasks: 2\ntask_file: {name}\n{extra}")
    return load_config(folder / "s.yaml")


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param("tasks.json", marks=pytest.mark.slow), "val.json.gz"])
def test_a_sweep_drives_the_tasks_of_a_file(tmp_path, tasks, name):
    config = configuration(tmp_path, tasks, name)
    log = run_sweep(config, tmp_path / "out", workers=1)
    rows = sorted(read_rows(log), key=lambda row: row["task"])
    assert [tuple(row["goal"]) for row in rows] == [task.goal for task in tasks.tasks[:2]]
    manifest = json.loads((tmp_path / "out/sweep.json").read_text())
    assert len(manifest["config"]["task_file"]) == 16


def test_another_content_is_another_sweep(tmp_path, tasks):
    config = configuration(tmp_path, tasks, "val.json.gz")
    first = config_hash(config, {"oak": "0"}, 0)
    assert config_hash(config.model_copy(update={"task_file": None}), {"oak": "0"}, 0) != first
    other = tasks.model_copy(update={"tasks": tasks.tasks[::-1]})
    assert config_hash(configuration(tmp_path, other, "val.json.gz"), {"oak": "0"}, 0) != first


def test_too_few_tasks_are_refused(tmp_path, tasks):
    config = configuration(tmp_path, tasks, "val.json.gz", "").model_copy(update={"tasks": (0, 4)})
    with pytest.raises(InputError, match=r"val.json.gz: tasks: expected tasks numbered below 4, as many as the file"):
        run_sweep(config, tmp_path / "out", workers=1)


def test_another_robot_is_refused(tmp_path, tasks):
    navigation.save(tasks, tmp_path / "t.json")
    (tmp_path / "s.yaml").write_text(
        "env: vssm_gym/CarNav-v1\nrobot: car\nscenes: depot\nagents: greedy\ntasks: 1\ntask_file: t.json\n"
    )
    with pytest.raises(InputError, match=r"s.yaml: task_file: expected none with vssm_gym/CarNav-v1"):
        load_config(tmp_path / "s.yaml")


def test_a_file_that_is_missing_is_named(tmp_path):
    (tmp_path / "s.yaml").write_text("scenes: oak\nagents: random\ntasks: 1\ntask_file: gone.json.gz\n")
    with pytest.raises(InputError, match=r"gone.json.gz: file: expected a readable file of tasks"):
        run_sweep(load_config(tmp_path / "s.yaml"), tmp_path / "out", workers=1)
    assert not (tmp_path / "out").exists()
