"""Test suites: the public ones are frozen, and a change of file, scene or task is refused."""

import re

import pytest
import yaml

from tests.helpers.box_rooms import furniture, two_rooms
from tests.helpers.sweeps.benchmark_suites import ROOMS, write_suite
from vssm_gym.envs.robots.holonomic import HOLONOMIC_NOISES
from vssm_gym.envs.scenes.scene import save_scene
from vssm_gym.errors import InputError
from vssm_gym.eval.benchmark.suite import NEWEST, SUITES, Recording, check_frozen, freeze, read_suite, suite_file
from vssm_gym.eval.protocols import shared

PUBLIC = {"small-v1": "7a5b74e82f797bbe", "full-v1": "4eb3e979f356777f"}


OTHERS = """name: others
tracks:
  slam:
    kind: slam
    about: Follow a camera.
    seconds: 20
    recordings:
      - {scene: rooms.json, motion: handheld, length: 3}
      - {scene: rooms.json, motion: handheld, length: 4}
  prediction:
    kind: prediction
    about: Predict.
    scenes: [oak, rooms.json]
    drives: 1
    seconds: 20
"""


def test_public_suites_are_those_that_were_published():
    """A suite that changes gets a new name, and a new line here: never another hash under an old name."""
    assert {path.stem: read_suite(path).hash for path in SUITES.glob("*.yaml")} == PUBLIC
    assert all(read_suite(SUITES / f"{name}.yaml").name == name for name in PUBLIC)
    assert set(NEWEST.values()) <= PUBLIC.keys()


@pytest.mark.slow
@pytest.mark.parametrize("name", PUBLIC)
def test_scenes_tasks_and_maps_are_those_of_the_public_suites(name):
    path = suite_file(name)
    check_frozen(read_suite(path), path, read_suite(path).tracks)


def test_the_small_suite_is_of_this_version_where_that_is_quick():
    path = suite_file("small")
    check_frozen(read_suite(path), path, ["navigation", "prediction"])


def test_a_changed_file_is_refused(tmp_path):
    path = write_suite(tmp_path)
    assert read_suite(path).frozen.keys() == {
        "mapping: rules",
        "car: rules",
        "scene rooms",
        "mapping: tasks of rooms",
        "scene arena",
        "car: tasks of arena",
    }
    path.write_text(path.read_text().replace("noise: low", "noise: mid"))
    with pytest.raises(
        InputError, match=r"hash: expected [0-9a-f]{16}, the hash of the suite as it is; found .* another name"
    ):
        read_suite(path)


def test_a_changed_scene_is_refused(tmp_path):
    path = write_suite(tmp_path)
    check_frozen(read_suite(path), path, ["mapping"])
    save_scene(two_rooms(pieces=(furniture("box", (1.0, 1.0, 0.5), (0.4, 0.4, 1.0)),)), tmp_path / "rooms.json")
    shared.load.cache_clear()  # a process reads a scene once
    with pytest.raises(
        InputError, match=r"frozen\.scene rooms: expected .*as it was frozen in rooms; this version .* has"
    ):
        check_frozen(read_suite(path), path, ["mapping"])
    check_frozen(read_suite(path), path, ["car"])  # whose scene is as before


def test_changed_tasks_are_refused(tmp_path):
    path = write_suite(tmp_path)
    stated = yaml.safe_load(path.read_text())["frozen"]["mapping: tasks of rooms"]
    suite = read_suite(path)
    other = suite.model_copy(update={"frozen": suite.frozen | {"mapping: tasks of rooms": stated[::-1]}})
    with pytest.raises(InputError, match=r"frozen\.mapping: tasks of rooms: expected"):
        check_frozen(other, path, ["mapping"])


def test_a_frozen_suite_is_not_frozen_again(tmp_path):
    with pytest.raises(InputError, match=r"hash: expected a suite that is not frozen yet"):
        freeze(write_suite(tmp_path))


def test_other_rules_are_refused(tmp_path, monkeypatch):
    path = write_suite(tmp_path)
    monkeypatch.setitem(HOLONOMIC_NOISES, "low", HOLONOMIC_NOISES["mid"])
    with pytest.raises(InputError, match=r"frozen\.mapping: rules: expected .*as it was frozen in rooms"):
        check_frozen(read_suite(path), path, ["mapping"])


def test_scenes_of_all_tracks_are_relative_to_the_suite(tmp_path, monkeypatch):
    save_scene(two_rooms(), tmp_path / "rooms.json")
    path = tmp_path / "suite.yaml"
    path.write_text(OTHERS)
    monkeypatch.chdir(tmp_path.parent)
    suite = freeze(path)
    assert read_suite(path).hash == suite.hash
    assert suite.tracks["slam"].located(tmp_path)[0].scene == str(tmp_path / "rooms.json")
    assert suite.tracks["prediction"].located(tmp_path) == ("oak", str(tmp_path / "rooms.json"))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("length: 4", "length: 3", r"recordings with names that differ; two are called 'rooms-handheld-3-kinect-0'"),
        ("[oak, rooms.json]", "[oak, oak]", r"scenes with names that differ; two are called 'oak'"),
    ],
)
def test_runs_that_could_not_be_told_apart_are_refused(tmp_path, old, new, message):
    save_scene(two_rooms(), tmp_path / "rooms.json")
    path = tmp_path / "suite.yaml"
    path.write_text(OTHERS.replace(old, new))
    with pytest.raises(InputError, match=message):
        read_suite(path)


def test_names_of_recordings_tell_all_fields():
    shared = {"scene": "oak", "motion": "wander", "length": 5.0}
    changes = [{}, {"length": 6.0}, {"noise": "high"}, {"sensor_noise": "stereo"}, {"seed": 1}, {"motion": "handheld"}]
    assert len({Recording(**(shared | change)).name for change in changes}) == len(changes)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("score: spl", "score: ssl", r"score: expected .*'spl', 'timely' or 'explored'"),
        ("kind: driving", "kind: racing", r"'driving', 'slam', 'prediction'"),
        ("noise: low", "nois: low", r"sweep\.nois: expected no such field"),
        ("  mapping:", "  ../up:", r"tracks: expected names that are words, for folders; found '\.\./up'"),
        ("CarNav-v1", "CarNav-v9", r"env: expected one of .*CarNav-v0"),
    ],
)
def test_a_file_that_is_no_suite_is_refused(tmp_path, old, new, message):
    path = tmp_path / "suite.yaml"
    path.write_text(ROOMS.replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        read_suite(path)


def test_names_of_suites():
    assert suite_file("small") == SUITES / f"{NEWEST['small']}.yaml"
    with pytest.raises(InputError, match=re.escape("suite: expected the file of a suite, or one of small, full")):
        suite_file("smal")


def test_a_track_keeps_its_hash_where_another_one_of_its_suite_changes(tmp_path):
    suite = read_suite(write_suite(tmp_path))
    car = suite.tracks["car"].model_copy(update={"seconds": 7.0})
    other = suite.model_copy(update={"tracks": suite.tracks | {"car": car}, "name": "rooms-v2"})
    assert other.track_hash("mapping") == suite.track_hash("mapping")
    assert other.track_hash("car") != suite.track_hash("car")
    scene = suite.model_copy(update={"frozen": suite.frozen | {"scene rooms": "0" * 16}})
    assert scene.track_hash("mapping") != suite.track_hash("mapping")
