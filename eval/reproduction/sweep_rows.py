"""Run some episodes of a finished sweep again, by its manifest, and compare each row."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vssm_gym.agents.registry import AGENTS, WITH
from vssm_gym.envs.scenes.specs import scene_name, spec_of_name
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.identity import Episode
from vssm_gym.eval.episodes.log import FILE, episode_key, read_rows
from vssm_gym.eval.episodes.manifest import MANIFEST, read_manifest
from vssm_gym.eval.protocols.registry import protocol_of
from vssm_gym.eval.reproduction.comparison import first_difference
from vssm_gym.eval.sweep.config import SweepConfig, check_environments, check_names
from vssm_gym.eval.sweep.runner import run_sweep
from vssm_gym.progress import OnProgress


@dataclass(frozen=True)
class Reproduced:
    """Hold one row that was run again.

    Attributes:
        row: as it was written.
        difference: the first field that differs; None if the outcomes agree.
    """

    row: dict[str, Any]
    difference: str | None


@dataclass(frozen=True)
class ChosenEpisodes:
    """Select episodes of a sweep by the rows that they wrote: a part of it, as a shard is."""

    keys: tuple[tuple[Any, ...], ...]
    hashes: tuple[tuple[str, str], ...]  # scene of the configuration, and its content hash

    def part(self, episodes: Sequence[Episode]) -> list[Episode]:
        """Return the selected episodes in order."""
        wanted, hashes = set(self.keys), dict(self.hashes)
        return [e for e in episodes if episode_key(e.identity(hashes[e.condition.scene])) in wanted]

    def stated(self) -> dict[str, Any]:
        """Return the number of the episodes."""
        return {"chosen": len(self.keys)}


def reproduce(
    folder: Path,
    out: Path,
    episodes: int,
    tolerance: float,
    scenes: Mapping[str, str],
    workers: int = 2,
    on_progress: OnProgress | None = None,
) -> list[Reproduced]:
    """Run rows of a finished sweep again, spread evenly over it, and compare their outcomes.

    Args:
        folder: of the sweep: ``sweep.json`` and ``episodes.jsonl``.
        out: new or empty folder of the sweep that runs them.
        episodes: rows at most.
        tolerance: see :func:`first_difference`.
        scenes: files of scenes that are not built in, by name.
        workers: processes.
        on_progress: as of :func:`run_sweep`.

    Raises:
        InputError: no finished sweep; an agent or a scene that is not there, or whose content has changed.
    """
    manifest, rows = read_manifest(folder / MANIFEST), read_rows(folder / FILE)
    if not rows:
        raise InputError(folder / FILE, "file", "at least one episode")
    chosen = [rows[k] for k in np.unique(np.linspace(0, len(rows) - 1, min(episodes, len(rows))).round().astype(int))]
    config = _config(folder, manifest, chosen, scenes)
    hashes = _hashes(folder, manifest, config)
    part = ChosenEpisodes(tuple(episode_key(row) for row in chosen), tuple(hashes.items()))
    log = run_sweep(config, out, seed=manifest["seed"], shard=part, workers=workers, on_progress=on_progress)
    found = {episode_key(row): row for row in read_rows(log)}
    outcome = []
    for row in chosen:
        again = found.get(episode_key(row))
        difference = "the row: not an episode of the sweep's configuration" if again is None else None
        outcome.append(Reproduced(row, difference or first_difference(row, again or {}, tolerance)))
    return outcome


def _config(
    folder: Path, manifest: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], scenes: Mapping[str, str]
) -> SweepConfig:
    """Return the configuration of the sweep, with the scenes and agents of the chosen rows alone."""
    agents = list(dict.fromkeys(row["agent"] for row in rows))
    for agent in agents:
        if agent.partition(WITH)[0] not in AGENTS:
            raise InputError(
                folder / MANIFEST, "config.agents", f"agents of the registry; {agent} is a file or unknown"
            )
    names = list(dict.fromkeys(row["scene"] for row in rows))
    given = dict(manifest["config"]) | {
        "agents": agents,
        "scenes": [scenes.get(name, spec_of_name(name)) for name in names],
    }
    config = SweepConfig.model_validate({name: value for name, value in given.items() if value is not None})
    check_environments(config, folder / MANIFEST)
    check_names(config, folder / MANIFEST)
    return config


def _hashes(folder: Path, manifest: Mapping[str, Any], config: SweepConfig) -> dict[str, str]:
    """Return the content hash of each scene of the configuration; raise where it is not that of the sweep."""
    hashes = {}
    for scene in config.scenes:
        name, content = scene_name(scene), protocol_of(config.env[0]).load(scene).content_hash()
        before = manifest.get("scene_hashes", {}).get(name)
        if before not in (None, content):
            raise InputError(folder / MANIFEST, f"scene_hashes.{name}", f"{content}, as the scene has; found {before}")
        hashes[scene] = content
    return hashes
