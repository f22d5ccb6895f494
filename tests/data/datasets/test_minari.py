"""Test that Minari reads back what was written: all arrays equal, bit by bit."""

import json

import numpy as np
import pytest

from tests.helpers.datasets.drawn_episodes import DESCRIPTION, drawn_block, drawn_episodes
from vssm_gym.data.datasets import minari as minari_format
from vssm_gym.data.datasets.episode import Episode, info_columns
from vssm_gym.data.datasets.formats import write_dataset
from vssm_gym.errors import InputError

minari = pytest.importorskip("minari")


def write(out, episodes):
    return write_dataset("minari", lambda _: (DESCRIPTION, episodes), out)


def assert_equal(found, blocks):
    """Compare an episode that Minari has read with the blocks it was written in."""
    for name in blocks[0].observations:
        wanted = np.concatenate([block.observations[name] for block in blocks])
        np.testing.assert_array_equal(found.observations[name], wanted)
        assert found.observations[name].dtype == wanted.dtype
    for name in ("actions", "rewards", "terminations", "truncations"):
        wanted = np.concatenate([getattr(block, name) for block in blocks])
        np.testing.assert_array_equal(getattr(found, name), wanted)
        assert getattr(found, name).dtype == wanted.dtype


def test_arrays_come_back_equal(tmp_path):
    episodes = drawn_episodes()
    assert write(tmp_path / "drive-v3", episodes) == (3, 13)
    dataset = minari.MinariDataset(tmp_path / "drive-v3" / "data")
    assert (dataset.id, dataset.total_episodes, dataset.total_steps) == ("drive-v3", 3, 13)
    for found, episode in zip(dataset, episodes, strict=True):
        assert_equal(found, episode.blocks)
        infos = episode.blocks[0].infos
        np.testing.assert_array_equal(found.infos["T"], [info["T"] for info in infos])
        np.testing.assert_array_equal(found.infos["success"], [info["success"] for info in infos])
        rest = [json.loads(text) for text in found.infos["json"]]
        assert [one["reason"] for one in rest] == [info["reason"] for info in infos]
        assert rest[0]["task"] == infos[0]["task"]


def test_metadata_states_what_an_episode_is_made_again_from(tmp_path):
    write(tmp_path / "of-drive-v12", drawn_episodes())
    dataset = minari.MinariDataset(tmp_path / "of-drive-v12" / "data")
    assert dataset.id == "of-drive-v12"
    assert dataset.env_spec.id == "vssm_gym/PointNav-v0"
    assert dataset.env_spec.kwargs == {"scene": "oak", "noise": "low"} and dataset.env_spec.max_episode_steps == 77
    assert dataset.storage.metadata["vssm_gym"]["version"] == DESCRIPTION.version
    stored = list(dataset.storage.get_episode_metadata(range(3)))
    assert [one["seed"] for one in stored] == [2**32 - 1, 2**32 - 2, 2**32 - 3]
    assert [json.loads(one["vssm_gym"]) for one in stored] == [{"number": k, "name": "ü"} for k in range(3)]


def test_minari_finds_and_lists_a_folder_by_its_name(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    write(tmp_path / "drive-v0", drawn_episodes((2,)))
    assert minari.load_dataset("drive-v0").total_steps == 2
    assert list(minari.list_local_datasets()) == ["drive-v0"]


@pytest.mark.parametrize(
    ("name", "better"),
    [("few", "few-v0"), ("of drive", "of-drive-v0"), ("d-v0.1", "d-v0-1-v0"), ("d-v", "d-v-v0"), ("-v1", "-v1-v0")],
)
def test_a_name_that_minari_would_not_find_is_refused_with_one_that_it_does(tmp_path, name, better):
    with pytest.raises(InputError, match=rf"{name}: name: expected the id of a .* a version at its end: {better}$"):
        write(tmp_path / name, drawn_episodes((1,)))
    assert list(tmp_path.iterdir()) == []
    write(tmp_path / better, drawn_episodes((1,)))
    assert minari.MinariDataset(tmp_path / better / "data").id == better


def test_the_environment_of_the_registry_keeps_its_keywords(tmp_path):
    import gymnasium as gym

    before = dict(gym.spec("vssm_gym/PointNav-v0").kwargs)
    write(tmp_path / "d-v0", drawn_episodes((1,)))
    assert gym.spec("vssm_gym/PointNav-v0").kwargs == before


def test_blocks_of_an_episode_are_joined(tmp_path):
    blocks = [drawn_block(4, 0, last=False), drawn_block(3, 1, last=False), drawn_block(2, 2)]
    for block in blocks:
        for info in block.infos:
            info.clear()
    assert write(tmp_path / "d-v0", [Episode("one", None, {}, iter(blocks)), *drawn_episodes((2,))]) == (2, 11)
    dataset = minari.MinariDataset(tmp_path / "d-v0" / "data")
    assert_equal(dataset[0], blocks)
    stored = list(dataset.storage.get_episode_metadata([0, 1]))
    assert [int(one["total_steps"]) for one in stored] == [9, 2] and "seed" not in stored[0]


def test_an_episode_of_another_kind_is_refused_and_nothing_is_left(tmp_path):
    other = drawn_block(2, 0)
    del other.observations["goal"]  # type: ignore[attr-defined]
    with pytest.raises(InputError, match=r"drawn episodes: episodes: expected observations of one kind, .*; other has"):
        write(tmp_path / "d-v0", [*drawn_episodes((1,)), Episode("other", 0, {}, [other])])
    assert list(tmp_path.iterdir()) == []


def test_an_episode_without_a_step_is_refused(tmp_path):
    with pytest.raises(InputError, match="a step in each of them; none has none"):
        write(tmp_path / "d-v0", [Episode("none", 0, {}, [])])


def test_a_missing_library_is_one_sentence(monkeypatch):
    monkeypatch.setattr(minari_format.importlib.util, "find_spec", lambda name: None)
    advice = r"x: h5py: expected this library: pip install -c constraints.txt '\.\[datasets\]'"
    with pytest.raises(InputError, match=advice):
        minari_format.load_minari("x")


def test_columns_of_infos_are_numbers_of_one_kind():
    columns, rest = info_columns([{"a": 1, "b": True, "c": [1.0, 2.0], "d": 1}, {"a": 2, "b": False, "c": [0.0, 1.0]}])
    assert {name: values.tolist() for name, values in columns.items()} == {
        "a": [1, 2],
        "b": [True, False],
        "c": [[1.0, 2.0], [0.0, 1.0]],
    }
    assert rest == [{"d": 1}, {}]
    mixed, rest = info_columns([{"a": 1, "b": [1]}, {"a": 0.5, "b": [1, 2]}])
    assert mixed == {} and rest == [{"a": 1, "b": [1]}, {"a": 0.5, "b": [1, 2]}]
