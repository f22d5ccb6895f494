"""Run some episodes of a finished sweep again, by its manifest, and compare each row."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vssm_gym.agents.policy.policy_file import PREFIX, label
from vssm_gym.agents.registry import AGENTS, WITH
from vssm_gym.envs.scenes.specs import scene_name, spec_of_name
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.identity import Episode
from vssm_gym.eval.episodes.log import FILE, episode_key, read_rows
from vssm_gym.eval.episodes.manifest import MANIFEST, read_manifest
from vssm_gym.eval.protocols.given_tasks import task_file_hash
from vssm_gym.eval.protocols.registry import protocol_of
from vssm_gym.eval.reproduction.comparison import Reproduced, first_difference, spread_evenly
from vssm_gym.eval.sweep.config import SweepConfig, check_environments, check_names
from vssm_gym.eval.sweep.runner import run_sweep
from vssm_gym.files.shipped import MAPS, POLICIES, names, shipped
from vssm_gym.maps.map_file import map_hash
from vssm_gym.progress import OnProgress

POLICY_FOLDER = "policies"  # of a sweep's folder: the files of the policies that its rows call NAME@HASH


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


def reproduce_sweep(
    folder: Path,
    out: Path,
    episodes: int,
    tolerance: float,
    scenes: Mapping[str, str],
    task_file: Path | None = None,
    workers: int = 2,
    resume: bool = False,
    on_progress: OnProgress | None = None,
) -> list[Reproduced]:
    """Run rows of a finished sweep again, spread evenly over it, and compare their outcomes.

    Args:
        folder: of the sweep: ``sweep.json`` and ``episodes.jsonl``, and where policies drove, their files in
            ``policies/``, found by the labels in the rows.
        out: new or empty folder of the sweep that runs them, or with ``resume`` that of an interrupted one.
        episodes: rows at most.
        tolerance: see :func:`first_difference`.
        scenes: files of scenes that are not built in, by name.
        task_file: that of the sweep, where it was given one.
        workers: processes.
        resume: continue.
        on_progress: as of :func:`run_sweep`.

    Raises:
        InputError: no finished sweep; an agent, a policy, a map or a scene that is not there, or has changed.
    """
    manifest, rows = read_manifest(folder / MANIFEST), read_rows(folder / FILE)
    if not rows:
        raise InputError(folder / FILE, "file", "at least one episode")
    chosen = spread_evenly(rows, episodes)
    config = _config(folder, manifest, chosen, scenes, task_file)
    hashes = _hashes(folder, manifest, config)
    part = ChosenEpisodes(tuple(episode_key(row) for row in chosen), tuple(hashes.items()))
    given = _given_map(folder, manifest)
    log = run_sweep(
        config,
        out,
        resume=resume,
        workers=workers,
        seed=manifest["seed"],
        shard=part,
        map_file=given,
        on_progress=on_progress,
    )
    found = {episode_key(row): row for row in read_rows(log)}
    outcome = []
    for row in chosen:
        again = found.get(episode_key(row))
        difference = "the row: not an episode of the sweep's configuration" if again is None else None
        name = f"{row['scene']}, {row['agent']}, noise {row['noise']}, task {row['task']}"
        compared = difference or first_difference(row, again or {}, tolerance)
        outcome.append(Reproduced(name, compared, row.get("version"), row.get("processor")))
    return outcome


def _config(
    folder: Path,
    manifest: Mapping[str, Any],
    rows: Sequence[Mapping[str, Any]],
    scenes: Mapping[str, str],
    task_file: Path | None,
) -> SweepConfig:
    """Return the configuration of the sweep, with the scenes and agents of the chosen rows alone."""
    package = {label(path): f"{PREFIX}{path}" for path in (shipped(name, POLICIES) for name in names(POLICIES))}
    policies = package | policies_of(folder)
    agents = [policies.get(agent, agent) for agent in dict.fromkeys(row["agent"] for row in rows)]
    for agent in agents:
        if not agent.startswith(PREFIX) and agent.partition(WITH)[0] not in AGENTS:
            expected = f"agents of the registry, or policies of the package or of {POLICY_FOLDER}/; {agent} is none"
            raise InputError(folder / MANIFEST, "config.agents", expected)
    of_rows = list(dict.fromkeys(row["scene"] for row in rows))
    given = dict(manifest["config"]) | {
        "agents": agents,
        "scenes": [scenes.get(name, spec_of_name(name)) for name in of_rows],
        "task_file": _tasks(folder, manifest["config"].get("task_file"), task_file),
    }
    config = SweepConfig.model_validate({name: value for name, value in given.items() if value is not None})
    check_environments(config, folder / MANIFEST)
    check_names(config, folder / MANIFEST, {"scenes": "scenes, whose files --scenes names"})
    return config


def policies_of(folder: Path) -> dict[str, str]:
    """Return ``policy:PATH`` of each policy file of a sweep's folder, by the label that rows have for it."""
    return {label(path): f"{PREFIX}{path.resolve()}" for path in sorted((folder / POLICY_FOLDER).glob("*.npz"))}


def _tasks(folder: Path, wanted: str | None, given: Path | None) -> str | None:
    """Return the path of the task file, whose hash the sweep wrote down; None where it drew its own tasks."""
    found = None if given is None else task_file_hash(given)
    if found == wanted:
        return None if given is None else str(given.resolve())
    expected = "none: the sweep drew its tasks" if wanted is None else f"the sweep's, of hash {wanted}, as --task-file"
    raise InputError(given or folder / MANIFEST, "task_file", f"{expected}{f'; this is {found}' if found else ''}")


def _given_map(folder: Path, manifest: Mapping[str, Any]) -> Path | None:
    """Return the map that the sweep was given, found by its hash; None where the sweep learned its own."""
    wanted = manifest.get("map_hash")
    if wanted is None:
        return None
    known = [shipped(name, MAPS) for name in names(MAPS)] + sorted((folder / MAPS).glob("*.npz"))
    for path in known:
        if map_hash(path) == wanted:
            return path
    raise InputError(
        folder / MANIFEST, "map_hash", f"that of a map of the package, or of {MAPS}/; found {wanted!r:.80}"
    )


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
