"""Hold what a data set says of its episodes, whichever format it is written in.

An episode of T steps has T + 1 observations: ``o_0, a_0, r_1, o_1, ..., a_T-1, r_T, o_T``. Long ones come in blocks, so
that no more than one block is in memory.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np

from vssm_gym.errors import InputError

OTHER_INFO = "json"  # the column of what is no number in every step, as JSON text


@dataclass(frozen=True)
class Block:
    """Hold n consecutive steps of an episode.

    Attributes:
        observations: arrays by name, ``(n, ...)``; ``(n + 1, ...)`` in an episode's last block.
        actions: ``(n, ...)``, as they were given to the environment.
        rewards: ``(n,)`` float64.
        terminations: ``(n,)`` bool.
        truncations: ``(n,)`` bool.
        infos: of each observation, as plain JSON values; the first of an episode is that of the reset. Those of an
            episode in several blocks are empty.
    """

    observations: Mapping[str, np.ndarray]
    actions: np.ndarray
    rewards: np.ndarray
    terminations: np.ndarray
    truncations: np.ndarray
    infos: Sequence[Mapping[str, Any]]

    @property
    def steps(self) -> int:
        """Return n."""
        return len(self.rewards)

    @property
    def is_last(self) -> bool:
        """Return whether the block holds the observation after its last step."""
        return len(self.infos) > self.steps


@dataclass(frozen=True)
class Episode:
    """Describe one episode.

    Attributes:
        task: in words, for policies that read it.
        seed: of the environment's reset; None for a recording.
        metadata: what the episode can be made again from, as plain JSON values.
        blocks: its steps, in order; read once.
    """

    task: str
    seed: int | None
    metadata: Mapping[str, Any]
    blocks: Iterable[Block]


@dataclass(frozen=True)
class Description:
    """Describe a data set.

    Attributes:
        source: what it was made of, in words.
        observations: the space of one observation.
        actions: the space of one action.
        rate: steps a second.
        robot: that acted, in a word; None where none is known.
        agents: names of the agents that chose the actions.
        version: of this package.
        env: id of the environment; None for a recording.
        keywords: of ``gym.make`` that all episodes share, as plain JSON values.
        max_episode_steps: after which an episode was truncated; None where the environment ends it.
    """

    source: str
    observations: gym.spaces.Dict
    actions: gym.Space[Any]
    rate: float
    version: str
    robot: str | None = None
    agents: tuple[str, ...] = ()
    env: str | None = None
    keywords: Mapping[str, Any] = field(default_factory=dict)
    max_episode_steps: int | None = None


def plain(value: Any) -> Any:
    """Return a value of ``info`` as plain JSON values: arrays as lists, tasks and the like as objects.

    Numbers that JSON does not have become the texts "nan", "inf" and "-inf"; anything else that has no JSON its text.
    """
    if hasattr(value, "model_dump"):  # a task
        return plain(value.model_dump(mode="json"))
    if isinstance(value, Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    if isinstance(value, float) and not np.isfinite(value):
        return str(value)
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def info_columns(infos: Sequence[Mapping[str, Any]]) -> tuple[dict[str, np.ndarray], list[dict[str, Any]]]:
    """Split infos into columns of numbers and the rest.

    Returns:
        Arrays ``(len(infos), ...)`` of the entries that are numbers of one shape and kind throughout, by name; and what
        else each info holds.
    """
    columns = {name: column for name in infos[0] if (column := _column(infos, name)) is not None}
    rest = [{name: value for name, value in info.items() if name not in columns} for info in infos]
    return columns, rest


def _column(infos: Sequence[Mapping[str, Any]], name: str) -> np.ndarray | None:
    values = [info.get(name) for info in infos]
    try:
        column = np.array(values)
    except ValueError:  # of several shapes
        return None
    kinds = {type(value) for value in values}
    return column if column.dtype.kind in "bif" and column.size and len(kinds) == 1 else None


def checked(description: Description, episode: Episode) -> Iterator[Block]:
    """Yield an episode's blocks; raise :class:`InputError` where their observations are not the data set's."""
    spaces = description.observations.spaces
    steps = 0
    for block in episode.blocks:
        found = {name: (values.shape[1:], values.dtype) for name, values in block.observations.items()}
        wanted = {name: (space.shape, space.dtype) for name, space in spaces.items()}
        if found != wanted:
            expected = f"observations of one kind, {_words(wanted)}; {episode.task} has {_words(found)}"
            raise InputError(description.source, "episodes", expected)
        steps += block.steps
        yield block
    if not steps:
        raise InputError(description.source, "episodes", f"a step in each of them; {episode.task} has none")


def _words(kinds: Mapping[str, tuple[Any, Any]]) -> str:
    """Return names, shapes and types of observations in words."""
    return ", ".join(f"{name} {'x'.join(map(str, shape))} {dtype}" for name, (shape, dtype) in kinds.items())
