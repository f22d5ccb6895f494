"""Test ``vssm-gym reproduce``: equal outcomes pass, an altered row is named, and what cannot be run is refused."""

import json
import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.box_rooms import two_rooms
from tests.helpers.paths import CHECKOUT
from tests.helpers.straight_policy import straight
from tests.helpers.sweeps.benchmark_suites import write_suite
from vssm_gym.agents.policy import policy_file
from vssm_gym.agents.policy.policy_file import agent_label
from vssm_gym.cli.sweeps.reproduce import reproduce
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.scene import load_scene, save_scene
from vssm_gym.envs.tasks.navigation import save, task_set
from vssm_gym.errors import InputError
from vssm_gym.eval.bench.prediction.measure import measure
from vssm_gym.eval.bench.prediction.models import models
from vssm_gym.eval.bench.prediction.run import HORIZONS
from vssm_gym.eval.benchmark.run import run_benchmark
from vssm_gym.eval.benchmark.units import ROWS
from vssm_gym.eval.episodes.log import FILE, read_rows
from vssm_gym.eval.metrics.training_runs import training_name
from vssm_gym.eval.reproduction import benchmark_rows, prediction_rows
from vssm_gym.eval.reproduction.comparison import NOT_OUTCOMES, first_difference, spread_evenly
from vssm_gym.eval.reproduction.studies import STUDIES
from vssm_gym.eval.reproduction.sweep_rows import POLICY_FOLDER, policies_of
from vssm_gym.eval.studies.calibration import study as calibration
from vssm_gym.eval.studies.maze_exploration.run import ExplorationSetting
from vssm_gym.eval.studies.maze_exploration.run import run as run_exploration
from vssm_gym.eval.studies.maze_slam.run import MazeSlamSetting
from vssm_gym.eval.studies.maze_slam.run import run as run_maze_slam
from vssm_gym.eval.studies.page import write_study
from vssm_gym.eval.sweep.config import SweepConfig
from vssm_gym.eval.sweep.runner import run_sweep

CONFIG = SweepConfig(
    env=("vssm_gym/LidarMaze-v0",),
    scenes=("pillars-v1",),
    agents=("dist_bug",),
    robot=("disc",),
    physics=("none",),
    noise=("none", "low"),
    tasks=(0, 7, 9),
)


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sweep") / "out"
    run_sweep(CONFIG, folder, workers=1)
    return folder


def altered(folder, tmp_path, **change):
    """Return a copy of a sweep's folder whose last row has other values."""
    copy = tmp_path / "altered"
    copy.mkdir()
    (copy / "sweep.json").write_text((folder / "sweep.json").read_text())
    rows = [json.loads(line) for line in (folder / FILE).read_text().splitlines()]
    rows[-1] |= change
    (copy / FILE).write_text("".join(json.dumps(row) + "\n" for row in rows))
    return copy


def test_rows_have_the_same_outcome_once_more(sweep, tmp_path, capsys):
    reproduce(sweep, tmp_path / "again", episodes=4, workers=1)
    assert "4 of 4 rows have the same outcome" in capsys.readouterr().out
    again = (tmp_path / "again" / FILE).read_text().splitlines()
    assert len(again) == 4


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
        reproduce(CHECKOUT / "eval" / "baselines" / "procthor", tmp_path / "again", episodes=1, workers=1)


def test_rows_are_never_written_beside_others_and_a_missing_folder_is_named(sweep, tmp_path):
    with pytest.raises(
        InputError, match=r"a folder without rows, which are never overwritten; it holds episodes\.jsonl"
    ):
        reproduce(sweep, sweep, workers=1)
    with pytest.raises(InputError, match="a folder with the rows of a sweep or a study; there is none"):
        reproduce(tmp_path / "nothing", tmp_path / "other")


# policies

BASELINES = CHECKOUT / "eval" / "baselines"
POLICY_BYTES = 200_000  # of a committed file
WITH_POLICIES = [folder for folder in sorted(BASELINES.iterdir()) if (folder / POLICY_FOLDER).is_dir()]


def check_policies(folder):
    """Assert that a sweep's folder holds the policies that drove its rows, all of them and no other, in small files."""
    drove = {row["agent"] for row in read_rows(folder / FILE) if training_name(row["agent"]) is not None}
    assert policies_of(folder).keys() == drove
    assert all(path.stat().st_size <= POLICY_BYTES for path in (folder / POLICY_FOLDER).iterdir())


@pytest.mark.parametrize("folder", WITH_POLICIES, ids=lambda folder: folder.name)
def test_committed_policies_are_those_of_the_rows(folder):
    check_policies(folder)


def test_the_check_of_committed_policies_finds_a_missing_and_a_foreign_one(sweep, tmp_path):
    file = tmp_path / "straight.npz"
    policy_file.save(file, straight())
    copy = altered(sweep, tmp_path, agent=policy_file.label(file))
    (copy / POLICY_FOLDER).mkdir()
    with pytest.raises(AssertionError):
        check_policies(copy)
    (copy / POLICY_FOLDER / "any-name.npz").write_bytes(file.read_bytes())
    check_policies(copy)
    policy_file.save(copy / POLICY_FOLDER / "other.npz", straight(step=0.5))
    with pytest.raises(AssertionError):
        check_policies(copy)


def test_policies_of_the_package_are_found(sweep, tmp_path):
    """Without a file in the folder; such a policy does not drive the disc of a maze, which is said next."""
    with pytest.raises(InputError, match=r"agents: expected one of .*; found 'policy:.*oak\.npz'"):
        reproduce(altered(sweep, tmp_path, agent=agent_label("policy:oak")), tmp_path / "again", workers=1)


@pytest.mark.slow
def test_the_rows_of_a_policy_are_run_by_its_file_in_the_folder(tmp_path, capsys):
    save_scene(two_rooms(), tmp_path / "rooms.json")
    policy_file.save(tmp_path / "straight.npz", straight())
    scene, agent = str(tmp_path / "rooms.json"), f"policy:{tmp_path / 'straight.npz'}"
    config = SweepConfig(scenes=(scene,), agents=(agent,), tasks=(0, 1))
    run_sweep(config, tmp_path / "out", workers=1)
    (tmp_path / "straight.npz").unlink()
    with pytest.raises(InputError, match=r"config\.agents: expected .* straight@\w+ is none"):
        reproduce(tmp_path / "out", tmp_path / "without", episodes=1, scenes=(scene,), workers=1)
    (tmp_path / "out" / POLICY_FOLDER).mkdir()
    policy_file.save(tmp_path / "out" / POLICY_FOLDER / "straight-0.npz", straight())
    reproduce(tmp_path / "out", tmp_path / "again", scenes=(scene,), workers=1)
    assert "2 of 2 rows have the same outcome" in capsys.readouterr().out


# studies

STUDY_FOLDERS = {
    "maze_slam": "maze-slam",
    "maze_exploration": "maze-exploration",
    "slam2d_strips": "slam2d by strips",
    "slam2d_graph": "slam2d by a pose graph",
}


@pytest.mark.parametrize("folder", STUDY_FOLDERS)
def test_committed_rows_of_a_study_are_of_one_kind(folder):
    """The rows of each study can be run again, but for two of recorded logs."""
    (kind,) = [kind for kind in STUDIES if kind.rows(BASELINES / folder)]
    assert kind.name == STUDY_FOLDERS[folder]
    lines = len((BASELINES / folder / kind.file).read_text().splitlines())
    assert len(kind.rows(BASELINES / folder)) == lines - (2 if folder == "slam2d_graph" else 0)


TABLE_ROWS = {"calibration": 22, "smoothing": 24, "relocalisation": 6}  # rows of recordings apart


@pytest.mark.parametrize("folder", TABLE_ROWS)
def test_committed_rows_of_a_table_can_be_run_again(folder):
    (kind,) = [kind for kind in STUDIES if kind.rows(BASELINES / folder)]
    rows = kind.rows(BASELINES / folder)
    assert kind.name == folder and len({row["row"] for row in rows}) == len(rows) == TABLE_ROWS[folder]
    assert all(len(row.keys() - {"row", "setting"}) > 1 for row in rows)
    assert "seconds" not in json.dumps([{name: row[name] for name in row.keys() - {"row", "setting"}} for row in rows])


def test_committed_predictions_can_be_run_again_and_recorded_motions_are_left_out():
    (kind,) = [kind for kind in STUDIES if kind.rows(BASELINES / "prediction")]
    rows = kind.rows(BASELINES / "prediction")
    assert [row["model"] for row in rows] == [model.name for model in models()]
    assert all([part["seconds"] for part in row["horizons"]] == list(HORIZONS) for row in rows)


@pytest.mark.slow
def test_predictions_are_made_again_and_an_altered_score_is_named(tmp_path, capsys, monkeypatch):
    last = models()[-1]  # the cheapest
    monkeypatch.setattr(prediction_rows, "models", lambda: [last])
    study = tmp_path / "study"
    study.mkdir()
    found = measure(split="train", runs=1, seed=3, folder=tmp_path, candidates=[last])
    (study / "test.json").write_text(json.dumps(found))
    reproduce(study, tmp_path / "again")
    assert "1 of 1 rows have the same outcome" in capsys.readouterr().out
    found["rows"][1]["nats"]["mean"] += 0.02
    (study / "test.json").write_text(json.dumps(found))
    with pytest.raises(SystemExit):
        reproduce(study, tmp_path / "altered")
    assert f"model {last.name}: horizons[1].nats.mean: expected" in capsys.readouterr().out
    found["rows"][0]["model"] = "nobody"
    (study / "test.json").write_text(json.dumps(found))
    with pytest.raises(InputError, match="model: expected"):
        reproduce(study, tmp_path / "refused")
    (study / "test.json").write_text(json.dumps(found | {"setting": {}}))
    with pytest.raises(InputError, match="setting: expected that of bench prediction"):
        reproduce(study, tmp_path / "without")


@pytest.mark.parametrize("track", ["slam", "prediction"])
def test_committed_rows_of_the_benchmark_can_be_run_again(track):
    folder = BASELINES / "benchmark" / "small-v1" / track
    (kind,) = [kind for kind in STUDIES if kind.rows(folder)]
    assert kind.name == "benchmark"
    assert {(row["suite"], row["track"]) for row in kind.rows(folder)} == {("small-v1", track)}


WALK = """name: walk
tracks:
  slam:
    kind: slam
    about: Follow a camera.
    seconds: 20
    recordings:
      - {scene: rooms.json, motion: handheld, length: 1}
"""


@pytest.mark.slow
def test_rows_of_the_benchmark_are_run_again_and_an_altered_score_is_named(tmp_path, capsys, monkeypatch):
    suite, out = write_suite(tmp_path, WALK), tmp_path / "out"
    monkeypatch.setattr(benchmark_rows, "suite_file", lambda name: {"walk": suite}[name])
    run_benchmark(suite, ["standing_still"], out)
    reproduce(out / "slam", tmp_path / "again")
    assert "1 of 1 rows have the same outcome" in capsys.readouterr().out
    rows = out / "slam" / ROWS
    (row,) = map(json.loads, rows.read_text().splitlines())
    rows.write_text(json.dumps(row | {"score": row["score"] + 0.01}) + "\n")
    with pytest.raises(SystemExit):
        reproduce(out / "slam", tmp_path / "altered")
    assert (
        f"suite walk, track slam, entry standing_still, unit {row['unit']}: score: expected" in capsys.readouterr().out
    )
    rows.write_text(json.dumps(row | {"unit": "another"}) + "\n")
    with pytest.raises(InputError, match="unit: expected one of rooms-handheld"):
        reproduce(out / "slam", tmp_path / "refused")


CALIBRATED = calibration.Setting(runs=1)


def calibration_study(out):
    """Write the calibration of two rows without a map, of one run each."""
    for study in calibration.run(
        [], calibration.chosen("dead-reckoning-l*,dead-reckoning-h*"), CALIBRATED, folder=out, done={}
    ):
        write_study(study, out)


def test_rows_of_a_table_are_run_again_and_an_altered_one_is_named(tmp_path, capsys):
    study = tmp_path / "study"
    study.mkdir()
    calibration_study(study)
    reproduce(study, tmp_path / "again")
    assert "2 of 2 rows have the same outcome" in capsys.readouterr().out
    stored = json.loads((study / "calibration.json").read_text())
    stored["figures"]["rows"]["dead-reckoning-high"]["nees"]["mean"] *= 1.1
    (study / "calibration.json").write_text(json.dumps(stored))
    with pytest.raises(SystemExit):
        reproduce(study, tmp_path / "altered")
    with pytest.raises(SystemExit):  # the rows that are there are kept
        reproduce(study, tmp_path / "again", resume=True)
    assert len((tmp_path / "again" / "calibration.jsonl").read_text().splitlines()) == 2
    assert capsys.readouterr().out.count("row dead-reckoning-high: nees.mean: expected") == 2
    rows = stored["figures"].pop("rows")
    (study / "calibration.json").write_text(json.dumps(stored))
    with pytest.raises(InputError, match=r"figures\.rows: expected the rows of a study"):
        reproduce(study, tmp_path / "without")
    stored["figures"]["rows"] = rows
    stored["setting"]["more"] = 1
    (study / "calibration.json").write_text(json.dumps(stored))
    with pytest.raises(InputError, match=r"setting: expected that of a study"):
        reproduce(study, tmp_path / "refused")


RUNS = {
    "maze-slam.jsonl": lambda out: run_maze_slam(
        MazeSlamSetting(("rings-v1",), ("odometry",), traversals=3, seeds=1, steps=150), out
    ),
    "maze-exploration.jsonl": lambda out: run_exploration(
        ExplorationSetting(("rings-v1",), ("maze_random",), seeds=2, steps=25), out
    ),
}


@pytest.mark.parametrize("file", RUNS)
def test_rows_of_a_study_are_run_again_and_an_altered_one_is_named(file, tmp_path, capsys):
    study = tmp_path / "study"
    study.mkdir()
    ran = RUNS[file](study)
    reproduce(study, tmp_path / "again")
    assert f"{len(ran)} of {len(ran)} rows have the same outcome" in capsys.readouterr().out
    lines = (study / file).read_text().splitlines()
    assert len((tmp_path / "again" / file).read_text().splitlines()) == len(lines)
    row = json.loads(lines[-1])
    name = "mean" if "mean" in row else "path_length"
    (study / file).write_text("\n".join([*lines[:-1], json.dumps(row | {name: row[name] + 0.01})]) + "\n")
    with pytest.raises(SystemExit):
        reproduce(study, tmp_path / "altered")
    assert re.search(rf"maze rings-v1, .*: {name}: expected", capsys.readouterr().out)


def test_a_folder_of_neither_is_refused(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"expected a sweep or a study whose rows can be run again \(episodes\.jsonl"):
        reproduce(tmp_path / "empty", tmp_path / "out")
    with pytest.raises(InputError, match="the folder of one track of this run of the benchmark: car, exploration"):
        reproduce(BASELINES / "benchmark" / "small-v1", tmp_path / "out")


@given(st.integers(1, 60), st.integers(1, 60))
def test_rows_are_chosen_from_the_first_to_the_last(rows, most):
    chosen = [row["k"] for row in spread_evenly([{"k": k} for k in range(rows)], most)]
    assert len(chosen) == min(rows, most) and chosen == sorted(set(chosen))
    assert chosen[0] == 0 and (most == 1 or chosen[-1] == rows - 1)


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-5, 5) | st.floats(-5.0, 5.0) | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=2), inner, max_size=3),
    max_leaves=8,
)


@given(row=st.dictionaries(st.text(max_size=4), VALUES, max_size=5), later=VALUES)
def test_a_row_agrees_with_itself_and_with_fields_that_came_later(row, later):
    assert first_difference(row, row, 0.0) is None
    assert first_difference(row, {"came_later": later} | row, 0.0) is None


@given(value=st.floats(-10.0, 10.0), off=st.floats(0.0, 0.1))
def test_numbers_agree_within_the_tolerance(value, off):
    found = first_difference({"outer": [{"inner": value}]}, {"outer": [{"inner": value + off}]}, 0.01)
    allowed = 0.01 * max(1.0, abs(value), abs(value + off))
    if not math.isclose(off, allowed, abs_tol=1e-9):
        assert (found is None) == (off < allowed)
    assert found is None or found.startswith("outer[0].inner: expected")


def test_kinds_that_differ_never_agree():
    assert first_difference({"success": True}, {"success": 1}, 0.5) == "success: expected True, now 1"
    assert first_difference({"status": "arrived"}, {}, 0.5) == "status: expected 'arrived'; now it is not there"
    assert first_difference({"goal": [1.0]}, {"goal": [1.0, 2.0]}, 0.5) is not None
    assert first_difference(dict.fromkeys(NOT_OUTCOMES, 1), dict.fromkeys(NOT_OUTCOMES, 2), 0.0) is None
