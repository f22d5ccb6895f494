"""Test that the episode log survives a cut at any byte, and that configurations multiply and refuse unknown keys."""

import json

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.identity import Episode, episode_seed
from vssm_gym.eval.episodes.log import FILE, KEY, EpisodeLog, episode_key, read_rows
from vssm_gym.eval.episodes.manifest import MANIFEST, completed, read_manifest
from vssm_gym.eval.episodes.row import FORMAT
from vssm_gym.eval.sweep.config import expand, load_config


def row(task):
    names = dict.fromkeys(KEY, "x") | {"scene": "ä\n", "task": task, "seed": 0}
    result = {"success": True, "failure": None, "path_length": 2.5}
    return {"format": FORMAT, **names, **result, "trace": {"true": [[0.5, float(task)]]}}


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cut=st.integers(0, 10_000), finished=st.integers(0, 4))
def test_a_log_cut_at_any_byte_keeps_complete_lines_and_continues(tmp_path, cut, finished):
    """Complete lines are kept and the rest is written again, so that each episode has one row."""
    path = tmp_path / FILE
    path.unlink(missing_ok=True)
    with EpisodeLog(path) as log:
        for task in range(finished + 1):
            log.append(row(task))
    data = path.read_bytes()
    kept = data[: len(data) - 1 - cut % (len(data) // (finished + 1))]  # somewhere inside the last line
    path.write_bytes(kept)
    assert [r["task"] for r in read_rows(path)] == list(range(kept.count(b"\n")))
    with EpisodeLog(path) as log:
        done = {episode_key(r) for r in log.rows}
        for task in range(6):
            if episode_key(row(task)) not in done:
                log.append(row(task))
    assert read_rows(path) == [row(task) for task in range(6)]


def test_a_row_is_on_disk_when_append_returns(tmp_path):
    with EpisodeLog(tmp_path / FILE) as log:
        log.append(row(0))
        assert read_rows(tmp_path / FILE) == [row(0)]


def test_zeros_that_a_power_cut_leaves_at_the_end_are_dropped(tmp_path):
    path = tmp_path / FILE
    with EpisodeLog(path) as log:
        log.append(row(0))
    path.write_bytes(path.read_bytes() + bytes(100) + b"\n")
    with EpisodeLog(path) as log:
        assert log.rows == [row(0)]
        log.append(row(1))
    assert read_rows(path) == [row(0), row(1)]


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([json.dumps(row(0)), "{", json.dumps(row(1))], "line 2: expected one episode as JSON"),
        ([json.dumps(row(0)), json.dumps({"task": 1})], "line 2: expected one episode as JSON with env, .*no env"),
        ([json.dumps(row(0) | {"steps": 2.5})], "line 1: expected one episode as JSON; steps: a valid integer"),
        ([json.dumps(row(0) | {"format": FORMAT + 1})], f"line 1: expected one episode as JSON; format: {FORMAT}"),
        (
            [json.dumps({k: v for k, v in row(0).items() if k != "failure"})],
            "line 1: expected .*; failure: Field required",
        ),
        ([json.dumps(row(0) | {"weather": "rain"})], "line 1: expected one episode as JSON; weather: "),
        (["[1]"], "line 1: expected one episode as a JSON object; found ."),
        ([json.dumps(row(0)), json.dumps(row(0))], "line 2: expected each episode once; it repeats line 1"),
    ],
)
def test_a_damaged_log_is_refused_and_not_changed(tmp_path, lines, message):
    path = tmp_path / FILE
    path.write_text("\n".join(lines) + "\n")
    before = path.read_bytes()
    with pytest.raises(InputError, match=message):
        EpisodeLog(path)
    with pytest.raises(InputError, match=message):
        read_rows(path)
    assert path.read_bytes() == before


def test_nan_never_reaches_the_log(tmp_path):
    with EpisodeLog(tmp_path / FILE) as log:
        with pytest.raises(ValueError, match="finite number"):
            log.append(row(0) | {"spl": float("nan")})
        log.append(row(1))
    assert [r["task"] for r in read_rows(tmp_path / FILE)] == [1]


def write(tmp_path, text):
    path = tmp_path / "sweep.yaml"
    path.write_text(text)
    return path


def test_lists_multiply_and_scalars_count_as_lists_of_one(tmp_path):
    text = "scenes: oak\nagents: [random, dead_reckoning]\nnoise: [low, mid]\ntasks: 3\nseeds: [0, 5]\n"
    config = load_config(write(tmp_path, text))
    episodes = list(expand(config))
    assert len(episodes) == len(set(episodes)) == 2 * 2 * 3 * 2
    assert {e.condition.noise for e in episodes} == {"low", "mid"}
    # One world after the other, and within it every agent at one task before the next task.
    assert [e.condition.noise for e in episodes] == ["low"] * 12 + ["mid"] * 12
    assert [(e.task, e.seed, e.agent) for e in episodes[:3]] == [
        (0, 0, "random"),
        (0, 0, "dead_reckoning"),
        (0, 5, "random"),
    ]
    assert isinstance(episodes[0], Episode)


@pytest.mark.parametrize(("tasks", "ids"), [("3", (0, 1, 2)), ("20-22", (20, 21, 22)), ("[7, 3]", (7, 3))])
def test_tasks_are_a_count_a_range_or_a_list(tmp_path, tasks, ids):
    assert load_config(write(tmp_path, f"scenes: oak\nagents: random\ntasks: {tasks}\n")).tasks == ids


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("scenes: oak\nagents: astral\ntasks: 1", r"agents: expected one of .*astar.*; found 'astral'"),
        ("scenes: oak\nagents: random\ntasks: 1\nnoise: [low, loud]", r"noise: expected one of none, low.*'loud'"),
        (
            "scenes: baobab\nagents: random\ntasks: 1",
            r"scenes: expected a built-in scene \(.*oak.*\), procedural:SEED or",
        ),
        ("scenes: oak\nagents: random\ntasks: 1\nrobot: tank", r"robot: expected one of holonomic, worn; found 'tank'"),
        ("scenes: oak\nagents: vi_mpc\ntasks: 1", r"agents: expected one of astar, .*; found 'vi_mpc'"),
        (
            "scenes: arena\nenv: vssm_gym/CarNav-v0\nagents: vi_mpc\ntasks: 1",
            r"robot: expected one of car; found 'holonomic'",
        ),
        ("scenes: oak\nagents: random\ntasks: 1\nphysics: bullet", r"physics: expected one of mujoco; found 'bullet'"),
        ("scenes: oak\nagents: random\ntasks: 1\nrenderer: oil", r"renderer: expected one of raycast, gl; found 'oil'"),
        (
            "scenes: oak\nagents: random\ntasks: 1\nsensor_noise: fog",
            r"sensor_noise: expected one of none, kinect, stereo; found 'fog'",
        ),
        ("scenes: oak\nagents: random\ntasks: 1\nenv: CartPole-v1", r"env: expected one of vssm_gym/PointNav-v0"),
        ("scenes: oak\nagents: random\ntasks: 1\ncolour: red", r"colour: expected one of the fields env, scenes"),
        ("scenes: oak\nagents: random\n", "tasks: expected this field"),
        (f"scenes: {'x' * 500}\nagents: random\ntasks: 1", "scenes: expected a built-in scene"),
        (f"scenes: {'x' * 5000}\nagents: random\ntasks: 1", "scenes: expected a name of 1 to 1000"),
        ('scenes: "a\\0b"\nagents: random\ntasks: 1', "scenes: expected a name of 1 to 1000 printable"),
        ("scenes: oak\nagents: random\ntasks: 10000000000", "tasks: expected a number of tasks"),
        ("scenes: oak\nagents: random\ntasks: 0-999999999", "tasks: expected at most 100,000 tasks"),
        ("scenes: oak\nagents: random\ntasks: 0-²", "tasks: expected a number of tasks"),
        (f"scenes: oak\nagents: random\ntasks: 99999\nseeds: {list(range(11))}", "at most 1,000,000 episodes"),
        ("scenes: oak\nagents: random\ntasks: 1\nseeds: 99999999999999999999", "seeds: expected less than"),
        (
            "scenes: oak\nagents: random\ntasks: many",
            "tasks: expected a number of tasks .at least 1., a range like 20-39",
        ),
        ("scenes: oak\nagents: random\ntasks: 0", "tasks: expected a number of tasks"),
        ("scenes: oak\nagents: random\ntasks: -1", "tasks: expected a number of tasks.*found -1"),
        ("scenes: oak\nagents: random\ntasks: 9-3", "tasks: expected at least 1 value; found none"),
        ("scenes: oak\nagents: random\ntasks: true", "tasks: expected a number"),
        ("scenes: oak\nagents: [random, random]\ntasks: 1", "agents: expected values that differ"),
        ("scenes: oak\nagents: []\ntasks: 1", "agents: expected at least 1 value; found none"),
        ("scenes: oak\nagents: random\ntasks: 1\nseeds: -1", r"seeds: expected"),
        ("scenes: oak\nagents: random\ntasks: 1\nvoxel: .nan", "voxel: expected"),
        ("- a\n- b", "file: expected fields env, scenes.*found list"),
        ("scenes: [oak", "file: expected valid YAML"),
        ("scenes: !!python/object/apply:os.getcwd []", "file: expected valid YAML"),
    ],
)
def test_a_bad_configuration_is_one_clear_error(tmp_path, text, message):
    with pytest.raises(InputError, match=message) as caught:
        load_config(write(tmp_path, text))
    assert str(caught.value).startswith(str(tmp_path / "sweep.yaml"))


def test_a_missing_configuration_is_named(tmp_path):
    with pytest.raises(InputError, match=r"nothing\.yaml: file: expected a readable YAML file"):
        load_config(tmp_path / "nothing.yaml")


def test_scene_paths_start_at_the_configuration(tmp_path):
    (tmp_path / "house.json").write_text("{}")
    config = load_config(write(tmp_path, "scenes: [house.json, oak]\nagents: random\ntasks: 1\n"))
    assert config.scenes == (str(tmp_path / "house.json"), "oak")


def test_two_scenes_of_one_name_are_refused(tmp_path):
    (tmp_path / "a").mkdir()
    for path in (tmp_path / "house.json", tmp_path / "a" / "house.json"):
        path.write_text("{}")
    with pytest.raises(InputError, match="scenes: expected scenes whose file names differ"):
        load_config(write(tmp_path, "scenes: [house.json, a/house.json]\nagents: random\ntasks: 1\n"))


def test_the_episode_seed_depends_on_seed_scene_and_task_only():
    seeds = {episode_seed(s, scene, t) for s in range(4) for scene in ("a", "b") for t in range(50)}
    assert len(seeds) == 400
    assert all(0 <= seed < 2**32 for seed in seeds)
    assert episode_seed(3, "a", 7) == episode_seed(3, "a", 7)


@pytest.mark.parametrize("field", ["config", "common", "scene_hashes", "notices"])
@pytest.mark.parametrize("value", [5, 0.1, [1], "x", None])
def test_a_damaged_manifest_is_refused(tmp_path, field, value):
    manifest = {"config": {}, "config_hash": "", "version": "", "seed": 0, "episodes": 1}
    (tmp_path / MANIFEST).write_text(json.dumps(manifest | {field: value}))
    with pytest.raises(InputError, match=f"{field}: expected an object"):
        read_manifest(tmp_path / MANIFEST)


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("episodes", {"episodes": "1"}),
        ("episodes", {"episodes": -1}),
        ("version", {"version": 2}),
        ("config_hash", {"config_hash": [1]}),
        ("notices.oak", {"notices": {"oak": [1]}}),
        ("scene_hashes.oak", {"scene_hashes": {"oak": {}}}),
    ],
)
def test_a_value_of_another_type_in_a_manifest_is_refused(tmp_path, field, change):
    manifest = {"config": {}, "config_hash": "", "version": "", "seed": 0, "episodes": 1}
    (tmp_path / MANIFEST).write_text(json.dumps(manifest | change))
    with pytest.raises(InputError, match=f"{field}: expected a"):
        read_manifest(tmp_path / MANIFEST)


@pytest.mark.parametrize("values", [5, {"a": 1}, "oak", [[]], None])
def test_lists_of_a_manifest_that_are_none_complete_nothing(values):
    row = {"scene": values, "task": 1}
    assert completed(row, {"config": {"scenes": values}, "scene_hashes": {"oak": "0"}})["scene"] == values
