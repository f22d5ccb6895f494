"""Test recordings as episodes: depth as recorded, commands of the steps, IMU readings, damaged images refused."""

import numpy as np
import pytest
from PIL import Image

from tests.helpers.datasets.random_walk import FRAMES, record
from vssm_gym.data.datasets import recordings
from vssm_gym.data.datasets.formats import write_dataset
from vssm_gym.data.datasets.recordings import read_recording
from vssm_gym.errors import InputError


def joined(episode):
    blocks = list(episode.blocks)
    observations = {name: np.concatenate([b.observations[name] for b in blocks]) for name in blocks[0].observations}
    return blocks, observations


@pytest.mark.parametrize("size", [2, 3, 6, 100])
def test_frames_commands_and_poses_are_those_of_the_recording(tmp_path, monkeypatch, size):
    monkeypatch.setattr(recordings, "BLOCK_FRAMES", size)
    colours, depths = record(tmp_path / "walk")
    description, episode = read_recording(tmp_path / "walk", "0.1.0")
    blocks, found = joined(episode)
    np.testing.assert_array_equal(found["rgb"], colours)
    stored = np.stack([np.array(Image.open(path)) for path in sorted((tmp_path / "walk/depth").iterdir())])
    np.testing.assert_array_equal(found["depth"], stored)
    assert found["depth"].dtype == np.uint16
    metres = found["depth"] / episode.metadata["camera"]["depth_scale"]
    assert np.abs(metres - depths).max() <= 1e-4 + 1e-9  # half of TUM's unit of 0.2 mm
    np.testing.assert_allclose(found["T_world_cam"][:, 0, 3], 0.1 * np.arange(FRAMES), atol=1e-7)
    np.testing.assert_allclose(found["time"][:, 0], 0.1 * np.arange(FRAMES))
    actions = np.concatenate([block.actions for block in blocks])
    np.testing.assert_allclose(actions[:, 0], 0.1 * np.arange(1, FRAMES), rtol=1e-6)
    assert np.concatenate([block.truncations for block in blocks]).tolist() == [False] * (FRAMES - 2) + [True]
    assert description.rate == pytest.approx(10.0)
    assert [block.is_last for block in blocks] == [False] * (len(blocks) - 1) + [True]
    assert all(description.observations.spaces[name].shape == values.shape[1:] for name, values in found.items())


def test_imu_readings_are_those_since_the_frame_before(tmp_path):
    record(tmp_path / "walk", controls=False)
    stamps = [0.02, 0.05, 0.1, 0.15, 0.55, 0.7]
    lines = (f"{stamp} {k} 0 0 0 0 9.81\n" for k, stamp in enumerate(stamps))
    (tmp_path / "walk/imu.txt").write_text("".join(lines))
    description, episode = read_recording(tmp_path / "walk", "0.1.0")
    _, found = joined(episode)
    assert found["imu"].shape == (FRAMES, 3, 7)
    read = found["imu"][..., 0]
    assert np.isnan(read[0]).all()  # of the frame at 0 s
    np.testing.assert_allclose(read[1], stamps[:3])
    np.testing.assert_allclose(read[2][:1], stamps[3:4])
    np.testing.assert_allclose(read[6][:1], stamps[4:5])
    assert np.isfinite(read).sum() == 5  # the reading after the last frame is of no step
    assert description.actions.n == 1


def test_a_frame_without_a_pose_has_none(tmp_path):
    record(tmp_path / "walk")
    path = tmp_path / "walk/groundtruth.txt"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:4]))  # up to 0.2 s
    _, episode = read_recording(tmp_path / "walk", "0.1.0")
    _, found = joined(episode)
    assert np.isfinite(found["T_world_cam"]).all(axis=(1, 2)).tolist() == [True] * 3 + [False] * 4


@pytest.mark.parametrize("form", ["minari", "lerobot"])
def test_a_recording_comes_back_equal(tmp_path, form):
    pytest.importorskip("minari" if form == "minari" else "pyarrow")
    colours, _ = record(tmp_path / "walk")
    description, episode = read_recording(tmp_path / "walk", "0.1.0")
    stored = np.stack([np.array(Image.open(path)) for path in sorted((tmp_path / "walk/depth").iterdir())])
    assert write_dataset(form, lambda _: (description, [episode]), tmp_path / "out-v0") == (1, FRAMES - 1)
    if form == "minari":
        import minari

        [found] = minari.MinariDataset(tmp_path / "out-v0" / "data")
        np.testing.assert_array_equal(found.observations["rgb"], colours)
        np.testing.assert_array_equal(found.observations["depth"], stored)
    else:
        from tests.helpers.datasets.lerobot_layout import read_columns

        columns, _ = read_columns(tmp_path / "out-v0")
        with np.load(tmp_path / "out-v0/last/episode-000000.npz") as last:
            depth = np.concatenate([columns["observation.depth"], last["depth"][None]])
            rgb = np.concatenate([columns["observation.images.rgb"], last["rgb"][None]])
        np.testing.assert_array_equal(depth, stored)
        np.testing.assert_array_equal(rgb, colours)


@pytest.mark.parametrize("form", ["minari", "lerobot"])
def test_a_damaged_image_is_named_and_nothing_is_left(tmp_path, form):
    pytest.importorskip("minari" if form == "minari" else "pyarrow")
    record(tmp_path / "walk")
    damaged = sorted((tmp_path / "walk/depth").iterdir())[4]
    damaged.write_bytes(damaged.read_bytes()[:60])
    description, episode = read_recording(tmp_path / "walk", "0.1.0")
    with pytest.raises(InputError, match=rf"{damaged.name}: pixels: expected a readable image"):
        write_dataset(form, lambda _: (description, [episode]), tmp_path / "out-v0")
    assert [path.name for path in tmp_path.iterdir()] == ["walk"]


def test_a_single_frame_is_no_episode(tmp_path):
    record(tmp_path / "walk")
    path = tmp_path / "walk/associations.txt"
    path.write_text(path.read_text().splitlines(keepends=True)[0])
    with pytest.raises(InputError, match="walk: frames: expected at least 2; found 1"):
        read_recording(tmp_path / "walk", "0.1.0")
