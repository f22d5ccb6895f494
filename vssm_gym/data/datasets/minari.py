"""Write a data set in Minari's format: ``FOLDER/data`` with ``main_data.hdf5`` and ``metadata.json``.

Images are stored as arrays, without Minari's default JPEG, and depth as the numbers that were measured: what Minari
reads back is equal to what was observed, bit by bit. ``minari.MinariDataset(FOLDER/data)`` reads it; in Minari's own
folder of data sets ``minari.load_dataset(ID)`` does. It looks for a folder that has the id as its name, and its list of
data sets ends with an error at a name without a version: so the folder is named as an id is.
"""

import copy
import importlib.util
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import gymnasium as gym

from vssm_gym.data.datasets.episode import OTHER_INFO, Block, Description, Episode, checked, info_columns
from vssm_gym.errors import InputError

EPISODE = "vssm_gym"  # the entry of an episode's metadata that it can be made again from, as JSON text
VERSIONED = re.compile(r"[-_A-Za-z0-9]+-v[0-9]+")  # the ids that Minari takes
REMEDY = "this library: pip install -c constraints.txt '.[datasets]'"
LARGEST_ATTRIBUTE = 60_000  # bytes of an episode's metadata: HDF5 keeps less than 64 kB of it


def load_minari(source: object) -> Any:
    """Import Minari; raise :class:`InputError` where it is not installed."""
    try:
        import minari
    except ImportError as error:
        raise InputError(source, "minari", REMEDY) from error
    if importlib.util.find_spec("h5py") is None:  # without which Minari has no storage that this writes
        raise InputError(source, "h5py", REMEDY)
    return minari


def check_id(out: Path) -> None:
    """Raise :class:`InputError` unless a folder's name can be the id of a data set; the message says which name can."""
    name = out.resolve().name
    if not VERSIONED.fullmatch(name):
        better = f"{re.sub('[^-_A-Za-z0-9]', '-', name) or 'data'}-v0"
        expected = f"the id of a data set of Minari, of letters, digits, - and _, with a version at its end: {better}"
        raise InputError(out, "name", expected)


def write_minari(description: Description, episodes: Iterable[Episode], folder: Path, name: str) -> tuple[int, int]:
    """Write a data set into an empty folder.

    Args:
        description: of all episodes.
        episodes: read once, one after the other.
        folder: that the data set is written to.
        name: of the folder when it is complete: the data set's id, as :func:`check_id` demands it.

    Returns:
        The number of episodes and of steps.

    Raises:
        InputError: Minari is not installed, or an episode is of another kind than the first.
    """
    minari = load_minari(description.source)
    from minari.dataset.minari_storage import MinariStorage

    storage = MinariStorage.new(
        folder / "data",
        observation_space=description.observations,
        action_space=description.actions,
        env_spec=_spec(description),
        data_format="hdf5",
        jpeg_encoding=False,  # JPEG would change every pixel
    )
    total = 0
    number = -1
    for number, episode in enumerate(episodes):
        steps = 0
        for block in checked(description, episode):
            storage.update_episodes([_buffer(number, block, None if steps else episode.seed)])
            steps += block.steps
        stored = json.dumps(episode.metadata)
        if len(stored.encode()) > LARGEST_ATTRIBUTE:
            raise InputError(description.source, "episodes", f"metadata of at most {LARGEST_ATTRIBUTE:,} bytes each")
        storage.update_episode_metadata([{"total_steps": steps, EPISODE: stored}], [number])
        total += steps
    storage.update_metadata(
        {
            "dataset_id": name,
            "minari_version": minari.__version__,
            "description": f"{description.source}, by vssm-gym {description.version}",
            "algorithm_name": ", ".join(description.agents) or "recording",
            "requirements": [f"vssm-gym=={description.version.partition('+')[0]}"],
            "vssm_gym": _header(description),
        }
    )
    return number + 1, total


def _header(description: Description) -> dict[str, Any]:
    return {
        "version": description.version,
        "env": description.env,
        "keywords": dict(description.keywords),
        "max_episode_steps": description.max_episode_steps,
        "agents": list(description.agents),
        "rate": description.rate,
    }


def _spec(description: Description) -> Any:
    """Return Gymnasium's specification of the environment, from which Minari recovers it; None for a recording."""
    if description.env is None:
        return None
    spec = copy.deepcopy(gym.spec(description.env))  # that of the registry stays as it is
    spec.kwargs = {**spec.kwargs, **description.keywords}
    spec.max_episode_steps = description.max_episode_steps
    return spec


def _buffer(number: int, block: Block, seed: int | None) -> Any:
    """Return Minari's buffer of a block, which it appends to the episode of that number."""
    from minari.data_collector import EpisodeBuffer

    columns, rest = info_columns(block.infos) if block.infos else ({}, [])
    return EpisodeBuffer(
        id=number,
        seed=seed,
        observations=dict(block.observations),
        actions=block.actions,
        rewards=block.rewards,
        terminations=block.terminations,
        truncations=block.truncations,
        infos=columns | {OTHER_INFO: [json.dumps(one) for one in rest]},
    )
