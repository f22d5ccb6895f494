"""Test rows of sweeps run again: equal outcomes pass, an altered row is named, and what cannot be run is refused."""

import json

import pytest

from tests.helpers.paths import BASELINES
from tests.helpers.sweeps.finished_sweep import altered
from vssm_gym.cli.sweeps.reproduce import reproduce
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.tasks.navigation import save, task_set
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.log import FILE
from vssm_gym.eval.sweep.config import SweepConfig
from vssm_gym.eval.sweep.runner import run_sweep


def test_rows_have_the_same_outcome_once_more(sweep, tmp_path, capsys):
    reproduce(sweep, tmp_path / "again", episodes=4, workers=1)
    assert "4 of 4 rows have the same outcome" in capsys.readouterr().out
    again = (tmp_path / "again" / FILE).read_text().splitlines()
    assert len(again) == 4


@pytest.mark.slow
def test_an_interrupted_run_goes_on(sweep, tmp_path, capsys):
    out = tmp_path / "again"
    reproduce(sweep, out, episodes=4, workers=1)
    whole = (out / FILE).read_text().splitlines(keepends=True)
    first = json.loads(whole[0]) | {"steps": 123_456}  # so that it is seen which rows are kept
    (out / FILE).write_text(json.dumps(first) + "\n" + whole[1][:40])
    with pytest.raises(InputError, match="a folder without rows"):
        reproduce(sweep, out, episodes=4, workers=1)
    capsys.readouterr()
    with pytest.raises(SystemExit):
        reproduce(sweep, out, episodes=4, workers=1, resume=True)
    said = capsys.readouterr().out
    assert "steps: expected" in said and "3 of 4 rows have the same outcome" in said
    assert len((out / FILE).read_text().splitlines()) == 4
    with pytest.raises(InputError, match="a folder without rows"):
        reproduce(sweep, sweep, workers=1, resume=True)  # its own rows are no second run


def test_the_task_file_of_a_sweep_is_asked_for(sweep, tmp_path):
    """By the hash that the sweep wrote down; a sweep that drew its tasks takes none."""
    copy, other = altered(sweep, tmp_path), tmp_path / "tasks.json"
    other.write_text("{}")
    with pytest.raises(InputError, match=r"tasks\.json: task_file: expected none: the sweep drew its tasks"):
        reproduce(copy, tmp_path / "again", workers=1, task_file=other)
    manifest = json.loads((copy / "sweep.json").read_text())
    manifest["config"]["task_file"] = "0123456789abcdef"
    (copy / "sweep.json").write_text(json.dumps(manifest))
    with pytest.raises(InputError, match=r"sweep\.json: task_file: expected .*0123456789abcdef, as --task-file"):
        reproduce(copy, tmp_path / "again", workers=1)
    with pytest.raises(InputError, match=r"tasks\.json: task_file: expected .*0123456789abcdef, .*; this is "):
        reproduce(copy, tmp_path / "again", workers=1, task_file=other)


@pytest.mark.slow
def test_rows_of_a_task_file_are_run_with_it(tmp_path, capsys):
    tasks = tmp_path / "tasks.json"
    save(task_set(load_scene("oak"), HolonomicRobot(), "test", 2), tasks)
    config = SweepConfig(scenes=("oak",), agents=("random",), tasks=(1,), task_file=str(tasks))
    run_sweep(config, tmp_path / "sweep", workers=1)
    reproduce(tmp_path / "sweep", tmp_path / "again", workers=1, task_file=tasks)
    assert "1 of 1 rows have the same outcome" in capsys.readouterr().out


def test_an_altered_row_fails_and_the_field_is_named(sweep, tmp_path, capsys):
    length = json.loads((sweep / FILE).read_text().splitlines()[-1])["path_length"]
    with pytest.raises(SystemExit):
        reproduce(altered(sweep, tmp_path, path_length=length + 0.01), tmp_path / "again", workers=1)
    said = capsys.readouterr().out
    assert "pillars-v1, dist_bug, noise low, task 9: path_length: expected" in said
    assert "5 of 6 rows have the same outcome" in said


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"agent": "policy@12345678"}, r"config\.agents: expected agents of the registry, or policies of the package"),
        ({"agent": "astar"}, "agents"),
    ],
)
def test_what_cannot_be_run_is_refused(sweep, tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        reproduce(altered(sweep, tmp_path, **change), tmp_path / "again", workers=1)
    with pytest.raises(InputError, match="sweep"):
        reproduce(tmp_path / "nothing", tmp_path / "other")


def test_a_scene_that_has_changed_is_refused(sweep, tmp_path):
    copy = altered(sweep, tmp_path)
    manifest = json.loads((copy / "sweep.json").read_text())
    manifest["scene_hashes"]["pillars-v1"] = "0" * 16
    (copy / "sweep.json").write_text(json.dumps(manifest))
    with pytest.raises(InputError, match=r"scene_hashes\.pillars-v1"):
        reproduce(copy, tmp_path / "again", workers=1)


def test_the_option_that_names_a_scene_of_a_file_is_said(tmp_path):
    with pytest.raises(InputError, match=r"scenes, whose files --scenes names: expected a built-in scene .*'house_0'"):
        reproduce(BASELINES / "procthor", tmp_path / "again", episodes=1, workers=1)


def test_rows_are_never_written_beside_others_and_a_missing_folder_is_named(sweep, tmp_path):
    with pytest.raises(
        InputError, match=r"a folder without rows, which are never overwritten; it holds episodes\.jsonl"
    ):
        reproduce(sweep, sweep, workers=1)
    with pytest.raises(InputError, match="a folder with the rows of a sweep or a study; there is none"):
        reproduce(tmp_path / "nothing", tmp_path / "other")
