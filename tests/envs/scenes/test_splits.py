"""Test scene splits: frozen, hashed, and disjoint."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.envs.scenes.scene import built_in_scenes, load_scene
from vssm_gym.envs.scenes.specs import scene_name, spec_of_name
from vssm_gym.envs.tasks import splits
from vssm_gym.envs.tasks.navigation import FROZEN as FROZEN_TASKS
from vssm_gym.envs.tasks.navigation import load
from vssm_gym.envs.tasks.splits import FROZEN, freeze, frozen_splits, scenes, split_of
from vssm_gym.errors import InputError


def test_every_built_in_scene_has_one_split_and_its_frozen_hash():
    """Every scene has its frozen hash; after a scene is added or changed, list its name and run `splits.freeze()`."""
    frozen = frozen_splits()
    assert set(built_in_scenes()) <= set(scenes("train")) | set(scenes("test"))
    assert frozen.changed() == []
    for name in built_in_scenes():
        assert (frozen.train | frozen.test)[name] == load_scene(name).content_hash()


def test_frozen_tasks_are_of_the_frozen_scenes():
    frozen = frozen_splits()
    files = sorted(FROZEN_TASKS.glob("*.json"))
    assert files
    for path in files:
        tasks = load(path)
        assert tasks.scene_hash == (frozen.train | frozen.test)[tasks.scene]


@given(st.integers(0, 100_000), st.sampled_from(["", ":small", ":medium", ":large", ":parking", ":parking-moved"]))
def test_a_seed_has_one_split_in_every_form(seed, size):
    assert split_of(f"procedural:{seed}{size}") == ("train" if seed < 10_000 else "test")


@given(st.integers(0, 100_000), st.sampled_from(["", ":small", ":large", ":parking", ":parking-moved"]))
def test_the_name_of_a_seed_in_rows_tells_the_scene(seed, form):
    """Rows write ``procedural-7-parking-moved``; whoever runs them again asks for the scene with that name."""
    assert spec_of_name(scene_name(f"procedural:{seed}{form}")) == f"procedural:{seed}{form}"


def test_the_splits_never_mix():
    train, test = scenes("train", 10_000), scenes("test", 10_000)
    assert not set(train) & set(test)
    assert {split_of(scene) for scene in train} == {"train"}
    assert {split_of(scene) for scene in test} == {"test"}
    assert scenes("test", 2)[-2:] == ("procedural:10000", "procedural:10001")
    assert "oak" in test
    assert train[:4] == ("fern", "ivy", "moss", "reed")


@pytest.mark.parametrize("scene", ["house_1.json", "procedural:", "procedural:-1", "procedural:1:", "oak.json", ""])
def test_other_scenes_belong_to_none(scene):
    assert split_of(scene) is None


@pytest.mark.parametrize("call", [lambda: scenes("both"), lambda: scenes("train", 10_001), lambda: scenes("test", -1)])
def test_a_scene_outside_of_the_split_is_refused(call):
    with pytest.raises(InputError, match=r"splits: (split|procedural): expected"):
        call()


def test_freezing_again_changes_no_byte(tmp_path):
    copy = tmp_path / "scenes.json"
    copy.write_text(FROZEN.read_text())
    freeze(copy)
    assert copy.read_text() == FROZEN.read_text()


def test_a_changed_scene_is_noticed(monkeypatch):
    name = built_in_scenes()[0]
    apartment = load_scene(name)
    changed = apartment.model_copy(update={"ceiling_height": apartment.ceiling_height + 0.1})
    monkeypatch.setattr(splits, "load_scene", lambda scene: changed if scene == name else load_scene(scene))
    (line,) = frozen_splits().changed()
    assert line.startswith(f"{name}: frozen as {apartment.content_hash()}, found {changed.content_hash()}")


def edited(tmp_path: Path, **changes) -> Path:
    path = tmp_path / "scenes.json"
    path.write_text(json.dumps(json.loads(FROZEN.read_text()) | changes))
    return path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"train": {"fern": None}}, "hash: expected"),  # a name taken out, the hash left as it was
        ({"train": {"oak": None}}, "no scene of train; found oak"),
        ({"seeds": {"train": {"first": 0, "last": 10_000}, "test": {"first": 10_000, "last": None}}}, "found 10000"),
        ({"seeds": {"train": {"first": 0, "last": None}, "test": {"first": 10_000, "last": None}}}, "found 10000"),
        ({"seeds": {"train": {"first": 0, "last": 9}}}, "those of train and test"),
        ({"format": 2}, "format: expected 1"),
        ({"extra": 1}, "extra: expected no such field"),
    ],
)
def test_a_damaged_file_is_refused(tmp_path, changes, message):
    with pytest.raises(InputError) as refused:
        frozen_splits(edited(tmp_path, **changes))
    assert message in str(refused.value)


@pytest.mark.parametrize(("content", "field"), [(None, "file"), ("{", "line 1"), ("[" * 100_000, "content")])
def test_a_file_that_cannot_be_read_is_refused(tmp_path, content, field):
    path = tmp_path / "scenes.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(InputError, match=f"{field}: expected"):
        frozen_splits(path)
