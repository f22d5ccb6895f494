"""Split a sweep into shards for several machines; every episode is in exactly one.

    units = (scene, task) in the order of the configuration,   shard i of N = units [(i - 1) U / N, i U / N)

All agents, conditions and seeds of a task stay together, so that every pair that is compared ran on one machine. Shards
are contiguous: each has few scenes, and learns few maps.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Protocol, runtime_checkable

from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.identity import Episode


@runtime_checkable
class Part(Protocol):
    """Select episodes of a sweep."""

    def part(self, episodes: Sequence[Episode]) -> list[Episode]:
        """Return the selected episodes in order."""

    def stated(self) -> dict[str, Any]:
        """Return what the sweep's manifest says of it."""


@dataclass(frozen=True)
class Shard:
    """Hold part ``index``, counted from 1, of ``of``."""

    index: int
    of: int

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """Parse ``I/N``; raise :class:`InputError` unless 1 <= I <= N."""
        first, slash, last = text.partition("/")
        if not (slash and first.isdigit() and last.isdigit() and 1 <= int(first) <= int(last)):
            raise InputError("sweep", "shard", f"I/N with 1 <= I <= N, as in 2/5; found {text!r}")
        return cls(int(first), int(last))

    def part(self, episodes: Sequence[Episode]) -> list[Episode]:
        """Return the shard's episodes in order; raise :class:`InputError` where there are fewer tasks than shards."""
        units = list(dict.fromkeys((e.condition.scene, e.task) for e in episodes))
        if self.of > len(units):
            raise InputError("sweep", "shard", f"at most {len(units)} shards, one a task and scene; found {self.of}")
        mine = set(units[(self.index - 1) * len(units) // self.of : self.index * len(units) // self.of])
        return [e for e in episodes if (e.condition.scene, e.task) in mine]

    def stated(self) -> dict[str, Any]:
        """Return ``index`` and ``of``."""
        return asdict(self)
