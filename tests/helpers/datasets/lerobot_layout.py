"""Check a folder against the layout of LeRobot's format v3.0, and read its columns, without LeRobot.

The checks are those that its reader makes and the shapes that its writer gives (lerobot/datasets/utils.py and
lerobot_dataset.py of version 0.4).
"""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pyarrow.parquet
from PIL import Image

INFO = {
    "codebase_version": str,
    "total_episodes": int,
    "total_frames": int,
    "total_tasks": int,
    "chunks_size": int,
    "data_files_size_in_mb": int,
    "video_files_size_in_mb": int,
    "fps": int,
    "splits": dict,
    "data_path": str,
    "features": dict,
}
DEFAULT = {"timestamp": "float32", "frame_index": "int64", "episode_index": "int64", "index": "int64"}
DEFAULT |= {"task_index": "int64"}
NUMBERS = {"min", "max", "mean", "std"}


def checked_info(root: Path) -> dict[str, Any]:
    """Check ``info.json``: fields and their types, names and kinds of features, and those that all data sets have."""
    info = json.loads((root / "meta/info.json").read_text())
    for name, kind in INFO.items():
        assert isinstance(info[name], kind), name
    assert info["codebase_version"] == "v3.0" and info["fps"] > 0
    assert {name: info["features"][name]["dtype"] for name in DEFAULT} == DEFAULT
    for name, feature in info["features"].items():
        assert "/" not in name and feature.keys() >= {"dtype", "shape", "names"}
        assert all(isinstance(side, int) and side > 0 for side in feature["shape"]) and 1 <= len(feature["shape"]) <= 5
        if feature["dtype"] == "image":
            assert len(feature["shape"]) == 3 and feature["names"][2] == "channels"
        elif feature["dtype"] != "string":
            assert np.dtype(feature["dtype"]).name == feature["dtype"]
    return info


def read_columns(root: Path) -> tuple[dict[str, np.ndarray | list], list[dict[str, Any]]]:
    """Check all files, and return the columns of the frames, images decoded, and the rows of the episodes."""
    info = checked_info(root)
    episodes = [row for path in sorted((root / "meta/episodes").glob("*/*.parquet")) for row in _rows(path)]
    tasks = pandas.read_parquet(root / "meta/tasks.parquet")
    assert list(tasks.columns) == ["task_index"] and list(tasks.task_index) == list(range(info["total_tasks"]))
    frames: list[dict[str, Any]] = []
    for number, episode in enumerate(episodes):
        path = info["data_path"].format(chunk_index=episode["data/chunk_index"], file_index=episode["data/file_index"])
        rows = _rows(root / path)
        assert (episode["episode_index"], episode["length"]) == (number, len(rows))
        assert (episode["dataset_from_index"], episode["dataset_to_index"]) == (len(frames), len(frames) + len(rows))
        assert [row["frame_index"] for row in rows] == list(range(len(rows)))
        assert {tasks.index[row["task_index"]] for row in rows} == set(episode["tasks"])
        np.testing.assert_allclose([row["timestamp"] for row in rows], np.arange(len(rows)) / info["fps"], rtol=1e-6)
        frames += rows
    assert [frame["index"] for frame in frames] == list(range(info["total_frames"]))
    assert len(episodes) == info["total_episodes"] and info["splits"] == {"train": f"0:{len(episodes)}"}
    columns = {name: _decoded([frame[name] for frame in frames], one) for name, one in info["features"].items()}
    assert frames[0].keys() == info["features"].keys()
    _check_statistics(json.loads((root / "meta/stats.json").read_text()), info["features"], len(frames))
    return columns, episodes


def _rows(path: Path) -> list[dict[str, Any]]:
    return pyarrow.parquet.read_table(path).to_pylist()


def _decoded(values: list[Any], feature: dict[str, Any]) -> np.ndarray | list:
    if feature["dtype"] == "string":
        return values
    if feature["dtype"] == "image":
        return np.stack([np.array(Image.open(io.BytesIO(value["bytes"]))) for value in values])
    column = np.array(values, feature["dtype"])
    shape = () if feature["shape"] == [1] else tuple(feature["shape"])
    assert column.shape[1:] == shape
    return column


def _check_statistics(statistics: dict[str, Any], features: dict[str, Any], frames: int) -> None:
    for name, one in statistics.items():
        assert one.keys() == NUMBERS | {"count"} and one["count"] == [frames]
        shape = [3, 1, 1] if features[name]["dtype"] == "image" else features[name]["shape"]
        assert all(np.shape(one[key]) == tuple(shape) for key in NUMBERS), name
