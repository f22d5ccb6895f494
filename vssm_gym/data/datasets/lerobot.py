"""Write a data set in the layout of LeRobot's format v3.0: tables in Parquet, descriptions in JSON.

    meta/info.json                                  features, rate, counts
    meta/stats.json                                 minimum, maximum, mean and standard deviation of each feature
    meta/tasks.parquet                              texts of the tasks
    meta/episodes/chunk-000/file-000.parquet        length, task, statistics and metadata of each episode
    data/chunk-000/file-000.parquet, ...            one row a step, one file an episode
    last/episode-000000.npz, ...                    the observation after an episode's last step, and the reset's info

A row holds the observation, the action chosen on it, and what followed (``next.reward``, ``next.done``,
``next.truncated``, ``next.info`` as JSON text). The format has no row for an observation without an action: ``last/``
is ours, and other readers pass over it. Images are PNG and arrays are stored as they are, so nothing is rounded; there
are no videos, whose codecs lose. LeRobot itself is not needed to write, Apache Arrow is.
"""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from vssm_gym.data.datasets.arrow_tables import Table, image_column, load_arrow, write_table, write_texts
from vssm_gym.data.datasets.episode import Block, Description, Episode, checked
from vssm_gym.data.datasets.statistics import Moments, finite, merged

LEROBOT_VERSION = "v3.0"
FILES_OF_CHUNK = 1000  # files of a folder
DATA_MEGABYTES, VIDEO_MEGABYTES = 100, 200  # of a file, for programs that append
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA_PATH = f"data/{FILE}.parquet"
EPISODES_PATH = f"meta/episodes/{FILE}.parquet"
LAST_PATH = "last/episode-{number:06d}.npz"
INDICES = ("frame_index", "episode_index", "index", "task_index")  # columns that every table has, with the timestamp
METADATA = "vssm_gym"  # the column of an episode's metadata that it can be made again from, as JSON text

Features = dict[str, dict[str, Any]]


def write_lerobot(description: Description, episodes: Iterable[Episode], folder: Path, name: str) -> tuple[int, int]:
    """Write a data set into an empty folder.

    Args:
        description: of all episodes.
        episodes: read once, one after the other.
        folder: that the data set is written to.
        name: of the folder when it is complete; the format does not state it.

    Returns:
        The number of episodes and of frames, one a step.

    Raises:
        InputError: Apache Arrow is not installed, or an episode is of another kind than the first.
    """
    load_arrow(description.source)
    (folder / "last").mkdir(parents=True, exist_ok=True)
    features: Features = {}
    tasks: dict[str, int] = {}
    rows: list[dict[str, Any]] = []
    total: dict[str, Moments] = {}
    frames = 0
    for number, episode in enumerate(episodes):
        task = tasks.setdefault(episode.task, len(tasks))
        writer = _Writer(description, folder, number, frames, task)
        with writer:
            for block in checked(description, episode):
                writer.write(block)
        features = writer.features
        total = merged(total, writer.statistics)
        rows.append(_row(number, episode, frames, writer))
        frames += writer.steps
    path = folder / EPISODES_PATH.format(chunk_index=0, file_index=0)
    write_table(path, {column: [row.get(column) for row in rows] for column in _columns(rows)})
    write_texts(folder / "meta" / "tasks.parquet", list(tasks), "task_index")
    _write_json(folder / "meta" / "stats.json", finite(total))
    _write_json(folder / "meta" / "info.json", _info(description, features, len(rows), frames, len(tasks)))
    return len(rows), frames


class _Writer:
    """Write the rows of one episode, a block at a time."""

    def __init__(self, description: Description, folder: Path, number: int, first: int, task: int) -> None:
        self.features: Features = {}
        self.statistics: dict[str, Moments] = {}
        self.steps = 0
        self._rate, self._folder = _whole_rate(description), folder
        self._first = first
        self._number, self._task = number, task
        self._table = Table(
            folder / DATA_PATH.format(chunk_index=number // FILES_OF_CHUNK, file_index=number % FILES_OF_CHUNK)
        )
        self._last: dict[str, np.ndarray] = {}
        self._reset_info: dict[str, Any] = {}

    def __enter__(self) -> "_Writer":
        return self

    def __exit__(self, *error: object) -> None:
        self._table.close()
        if error[0] is None:
            text = np.frombuffer(json.dumps(self._reset_info).encode(), np.uint8)
            path = self._folder / LAST_PATH.format(number=self._number)
            np.savez_compressed(path, **self._last, **{"json.reset_info": text})  # type: ignore[arg-type]

    def write(self, block: Block) -> None:
        """Add the rows of a block."""
        n = block.steps
        if not self.steps:
            self._reset_info = dict(block.infos[0])
        if block.is_last:
            self._last = {name: values[n] for name, values in block.observations.items()}
        numbers = np.arange(self.steps, self.steps + n)
        columns = dict(_named(block))
        columns["timestamp"] = (numbers / self._rate).astype(np.float32)
        indices = (numbers, np.full(n, self._number), self._first + numbers, np.full(n, self._task))
        columns |= dict(zip(INDICES, indices, strict=True))
        self.features = {name: _feature(name, values) for name, values in columns.items()}
        texts = [json.dumps(info) for info in (*block.infos[: n + 1], {})[1 : n + 1]]
        self.features["next.info"] = {"dtype": "string", "shape": [1], "names": None}
        found = {name: self._moments(name, values) for name, values in columns.items()}
        self.statistics = merged(self.statistics, found)
        self._table.write({**{name: self._stored(name, one) for name, one in columns.items()}, "next.info": texts})
        self.steps += n

    def _moments(self, name: str, values: np.ndarray) -> Moments:
        return Moments.of_images(values) if self.features[name]["dtype"] == "image" else Moments.of(values)

    def _stored(self, name: str, values: np.ndarray) -> Any:
        return image_column(values) if self.features[name]["dtype"] == "image" else values


def _named(block: Block) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the columns of a block by LeRobot's names: observations before each step, actions, and what followed."""
    for name, values in block.observations.items():
        place = "observation.images" if _is_image(values) else "observation"
        yield f"{place}.{name}", values[: block.steps]
    yield "action", block.actions
    yield "next.reward", block.rewards
    yield "next.done", block.terminations | block.truncations
    yield "next.truncated", block.truncations


def _is_image(values: np.ndarray) -> bool:
    return values.dtype == np.uint8 and values.ndim == 4 and values.shape[-1] == 3


def _feature(name: str, values: np.ndarray) -> dict[str, Any]:
    """Return LeRobot's description of a column: its type, the shape of an entry, and the names of an image's axes."""
    shape = list(values.shape[1:]) or [1]
    if name.startswith("observation.images."):
        return {"dtype": "image", "shape": shape, "names": ["height", "width", "channels"]}
    return {"dtype": str(values.dtype), "shape": shape, "names": None}


def _row(number: int, episode: Episode, first: int, writer: _Writer) -> dict[str, Any]:
    """Return the row of an episode in the table of episodes."""
    statistics = finite(writer.statistics)
    return {
        "episode_index": number,
        "tasks": [episode.task],
        "length": writer.steps,
        "data/chunk_index": number // FILES_OF_CHUNK,
        "data/file_index": number % FILES_OF_CHUNK,
        "dataset_from_index": first,
        "dataset_to_index": first + writer.steps,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
        METADATA: json.dumps({"seed": episode.seed, **episode.metadata}),
        **{f"stats/{name}/{key}": value for name, one in statistics.items() for key, value in one.items()},
    }


def _columns(rows: list[dict[str, Any]]) -> list[str]:
    return list(dict.fromkeys(column for row in rows for column in row))


def _info(description: Description, features: Features, episodes: int, frames: int, tasks: int) -> dict[str, Any]:
    return {
        "codebase_version": LEROBOT_VERSION,
        "robot_type": description.robot,
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": tasks,
        "chunks_size": FILES_OF_CHUNK,
        "data_files_size_in_mb": DATA_MEGABYTES,
        "video_files_size_in_mb": VIDEO_MEGABYTES,
        "fps": _whole_rate(description),
        "splits": {"train": f"0:{episodes}"},
        "data_path": DATA_PATH,
        "video_path": None,
        "features": features,
        METADATA: {
            "version": description.version,
            "source": description.source,
            "env": description.env,
            "keywords": dict(description.keywords),
            "max_episode_steps": description.max_episode_steps,
            "agents": list(description.agents),
            "rate": description.rate,
        },
    }


def _whole_rate(description: Description) -> int:
    """Return the steps a second as the format has them, a whole number."""
    return max(1, round(description.rate))


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=4) + "\n", encoding="utf-8")
