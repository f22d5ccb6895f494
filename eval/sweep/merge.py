"""Merge the folders of all shards of a sweep into the folder of the whole sweep: ``merge SHARD ... --out DIR``."""

import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.log import FILE, episode_key, line_of, read_rows
from vssm_gym.eval.episodes.manifest import MANIFEST, read_manifest
from vssm_gym.files.atomic import TEMPORARY
from vssm_gym.files.numbers import whole
from vssm_gym.files.output_folders import check_new_folder, whole_folder

TASKS, MAPS = "tasks", "maps"
MOST_SHARDS = 100_000  # of a sweep, whose manifest may state any number
FOLDERS = (TASKS, MAPS, "recordings", "explored")  # of a sweep, besides its log and manifest


@dataclass(frozen=True)
class Merged:
    """Hold the result of a merge.

    Attributes:
        log: the merged episodes.
        notices: differences between the shards (versions, maps of one scene), one line each.
    """

    log: Path
    notices: tuple[str, ...]


def merge_sweeps(folders: Sequence[Path], out: Path) -> Merged:
    """Merge the finished shards of one sweep into ``out``, which appears whole or not at all.

    Where two shards hold the map or recording of one scene, that of the earlier shard is kept: rows name by
    ``map_hash`` the map that their agents had.

    Args:
        folders: of ``vssm-gym sweep --shard I/N``, one for each I, in any order.
        out: new or empty folder.

    Raises:
        InputError: a folder that holds no shard, or a shard of another sweep, given twice, or unfinished; missing
            shards; different tasks of one scene; a folder that cannot be written.
    """
    check_new_folder(out)
    shards = _ordered(folders)
    rows = list(_rows(shards))
    with whole_folder(out) as unfinished:
        for folder in FOLDERS:
            _copy([shard / folder for shard, _ in shards], unfinished / folder)
        (unfinished / FILE).write_bytes(b"".join(map(line_of, rows)))
        merged = {name: value for name, value in shards[0][1].items() if name != "shard"} | {"episodes": len(rows)}
        (unfinished / MANIFEST).write_text(json.dumps(merged, indent=1) + "\n", encoding="utf-8")
    return Merged(out / FILE, tuple(_notices(shards)))


def _ordered(folders: Sequence[Path]) -> list[tuple[Path, dict[str, Any]]]:
    """Return every shard of one sweep with its manifest, in the order of their numbers."""
    if not folders:
        raise InputError("merge", "folders", "the folders of a sweep's shards")
    found: dict[int, tuple[Path, dict[str, Any]]] = {}
    first: dict[str, Any] = {}
    for folder in folders:
        manifest = read_manifest(folder / MANIFEST)
        shard = manifest.get("shard")
        if not isinstance(shard, dict) or not {"index", "of"} <= shard.keys():
            raise InputError(folder / MANIFEST, "shard", "a shard's folder; `vssm-gym sweep --shard I/N` makes one")
        of = whole(shard["of"], folder / MANIFEST, "shard.of", least=1, most=MOST_SHARDS)
        whole(shard["index"], folder / MANIFEST, "shard.index", least=1, most=of)
        first = first or manifest
        if (manifest["config_hash"], shard["of"]) != (first["config_hash"], first["shard"]["of"]):
            expected = f"{first['config_hash']} in {first['shard']['of']} shards, as {folders[0]}"
            raise InputError(
                folder / MANIFEST, "config_hash", f"{expected}; found {manifest['config_hash']} in {shard['of']}"
            )
        if shard["index"] in found:
            both = f"each shard once; {found[shard['index']][0]} is shard {shard['index']}, too"
            raise InputError(folder, "folder", both)
        found[shard["index"]] = folder, manifest
    of = first["shard"]["of"]
    if missing := [str(i) for i in range(1, of + 1) if i not in found]:
        raise InputError("merge", "folders", f"all {of} shards; {', '.join(missing)} of {of} missing")
    return [found[i] for i in sorted(found)]


def _rows(shards: Sequence[tuple[Path, dict[str, Any]]]) -> Iterator[dict[str, Any]]:
    """Yield the rows of all shards; raise :class:`InputError` for a row that is missing or doubled."""
    seen: dict[tuple, Path] = {}
    for folder, manifest in shards:
        rows = read_rows(folder / FILE)
        if len(rows) != manifest["episodes"]:
            expected = f"{manifest['episodes']} episodes; it holds {len(rows)} (sweep --resume continues it)"
            raise InputError(folder / FILE, "episodes", expected)
        for row in rows:
            if (key := episode_key(row)) in seen:
                raise InputError(folder / FILE, "episodes", f"each episode in one shard; {seen[key]} holds {key}, too")
            seen[key] = folder
            yield row


def _copy(sources: Sequence[Path], target: Path) -> None:
    """Copy the contents of the folders; the first file of a name is kept, and tasks of one name have to be the same."""
    for source in filter(Path.is_dir, sources):
        target.mkdir(parents=True, exist_ok=True)
        for path in sorted(path for path in source.iterdir() if not TEMPORARY.fullmatch(path.name)):
            copy = target / path.name
            if not copy.exists():
                shutil.copytree(path, copy) if path.is_dir() else shutil.copy2(path, copy)
            elif source.name == TASKS and path.read_bytes() != copy.read_bytes():
                raise InputError(path, "file", "the same tasks in every shard")


def _notices(shards: Sequence[tuple[Path, dict[str, Any]]]) -> Iterator[str]:
    versions = list(dict.fromkeys(manifest["version"] for _, manifest in shards))
    if len(versions) > 1:
        yield f"shards were run by different versions: {', '.join(versions)}"
    kept: dict[str, Path] = {}
    for folder, _ in shards:
        for path in sorted((folder / MAPS).glob("*.npz")):
            first = kept.setdefault(path.name, path)
            if first.read_bytes() != path.read_bytes():
                yield f"the map {path} differs from {first}, which is kept; rows say by map_hash which one was used"
