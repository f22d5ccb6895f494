"""Test data sets in LeRobot's layout: the layout, arrays that come back equal, and LeRobot's own reader where it is."""

import json

import numpy as np
import pytest

from tests.helpers.datasets.drawn_episodes import DESCRIPTION, drawn_block, drawn_episodes
from vssm_gym.data.datasets import arrow_tables
from vssm_gym.data.datasets.episode import Episode
from vssm_gym.data.datasets.formats import write_dataset
from vssm_gym.errors import InputError

pytest.importorskip("pyarrow")
pytest.importorskip("pandas")
from tests.helpers.datasets.lerobot_layout import checked_info, read_columns

PLACES = {"rgb": "observation.images.rgb"}


def write(out, episodes):
    return write_dataset("lerobot", lambda _: (DESCRIPTION, episodes), out)


def of(blocks, name):
    return np.concatenate([block.observations[name][: block.steps] for block in blocks])


def test_arrays_come_back_equal_in_the_layout(tmp_path):
    episodes = drawn_episodes()
    assert write(tmp_path / "d", episodes) == (3, 13)
    columns, rows = read_columns(tmp_path / "d")
    blocks = [episode.blocks[0] for episode in episodes]
    for name, space in DESCRIPTION.observations.spaces.items():
        found = columns[PLACES.get(name, f"observation.{name}")]
        np.testing.assert_array_equal(found.reshape(13, *space.shape), of(blocks, name))
        assert found.dtype == space.dtype
    np.testing.assert_array_equal(columns["action"], np.concatenate([block.actions for block in blocks]))
    np.testing.assert_array_equal(columns["next.reward"], np.concatenate([block.rewards for block in blocks]))
    np.testing.assert_array_equal(columns["next.done"], np.concatenate([block.terminations for block in blocks]))
    infos = [info for block in blocks for info in block.infos[1:]]
    assert [json.loads(text) for text in columns["next.info"]] == infos
    assert [row["tasks"] for row in rows] == [["drive 0"], ["drive 1"], ["drive 0"]]
    assert [json.loads(row["vssm_gym"]) for row in rows] == [
        {"seed": episode.seed, **episode.metadata} for episode in episodes
    ]


def test_the_last_observation_and_the_info_of_the_reset_are_kept(tmp_path):
    [episode] = drawn_episodes((4,))
    write(tmp_path / "d", [episode])
    with np.load(tmp_path / "d/last/episode-000000.npz", allow_pickle=False) as stored:
        for name, values in episode.blocks[0].observations.items():
            np.testing.assert_array_equal(stored[name], values[-1])
        assert json.loads(stored["json.reset_info"].tobytes()) == episode.blocks[0].infos[0]


def test_blocks_of_an_episode_are_joined(tmp_path):
    blocks = [drawn_block(4, 0, last=False), drawn_block(3, 1, last=False), drawn_block(2, 2)]
    write(tmp_path / "d", [Episode("one", None, {}, iter(blocks))])
    columns, [row] = read_columns(tmp_path / "d")
    np.testing.assert_array_equal(columns["observation.depth"], of(blocks, "depth"))
    assert row["length"] == 9


def test_statistics_are_those_of_all_frames(tmp_path):
    episodes = drawn_episodes()
    write(tmp_path / "d", episodes)
    blocks = [episode.blocks[0] for episode in episodes]
    found = json.loads((tmp_path / "d/meta/stats.json").read_text())
    for name, axes, scale in (("depth", (0,), 1.0), ("goal", (0,), 1.0), ("rgb", (0, 1, 2), 255.0)):
        values = of(blocks, name).astype(float) / scale
        one = found[PLACES.get(name, f"observation.{name}")]
        for key, function in (("min", np.min), ("max", np.max), ("mean", np.mean), ("std", np.std)):
            np.testing.assert_allclose(np.squeeze(one[key]), function(values, axis=axes), rtol=1e-9, atol=1e-9)


def test_a_feature_that_is_not_finite_has_no_statistics(tmp_path):
    block = drawn_block(3, 0)
    block.observations["time"][1] = np.nan
    write(tmp_path / "d", [Episode("one", 0, {}, [block])])
    assert "observation.time" in checked_info(tmp_path / "d")["features"]
    assert "observation.time" not in json.loads((tmp_path / "d/meta/stats.json").read_text())


def test_a_missing_library_is_one_sentence(monkeypatch, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    advice = r"x: pyarrow: expected this library: pip install -c constraints.txt '\.\[datasets\]'"
    with pytest.raises(InputError, match=advice):
        arrow_tables.load_arrow("x")
    with pytest.raises(InputError, match="dataset: pyarrow: expected this library"):
        write(tmp_path / "d", drawn_episodes())
    assert list(tmp_path.iterdir()) == []


def test_lerobot_reads_it(tmp_path, monkeypatch):
    """LeRobot pins other versions of torch and more than this package does: the test runs where both are installed."""
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_DATASETS_CACHE", str(tmp_path / "cache"))
    module = pytest.importorskip("lerobot.datasets.lerobot_dataset")
    episodes = drawn_episodes()
    write(tmp_path / "d", episodes)
    dataset = module.LeRobotDataset("vssm/drawn", root=tmp_path / "d", video_backend="pyav", vcodec="h264")
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (3, 13, 5)
    blocks = [episode.blocks[0] for episode in episodes]
    frames = [dataset[k] for k in range(13)]
    for name in ("depth", "units", "goal", "contact"):
        np.testing.assert_array_equal(np.stack([one[f"observation.{name}"] for one in frames]), of(blocks, name))
    images = np.stack([one["observation.images.rgb"] for one in frames]).transpose(0, 2, 3, 1)
    np.testing.assert_array_equal(np.rint(255.0 * images).astype(np.uint8), of(blocks, "rgb"))
    assert [one["task"] for one in frames[:6]] == ["drive 0"] * 5 + ["drive 1"]
