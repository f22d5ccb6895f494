"""Freeze which scenes agents may be trained in and which they are tested in, with hashes, never both.

``envs/assets/splits/scenes.json`` names the split of every built-in scene and of the procedural seeds, with the content
hash of each scene, so that a changed scene is noticed before results are compared with older ones. Tasks within a scene
have splits of their own (:mod:`vssm_gym.envs.tasks.navigation`): the same rooms, other starts and goals.
"""

import json
import re
from functools import cache
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from vssm_gym.envs.scenes.content_hash import content_hash
from vssm_gym.envs.scenes.scene import ASSETS, built_in_scenes, load_scene
from vssm_gym.envs.tasks.navigation import SPLITS, Split
from vssm_gym.envs.validation import StrictModel, validated
from vssm_gym.errors import InputError, one_of
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.json_file import read_json

FROZEN = ASSETS / "splits" / "scenes.json"
_PROCEDURAL = re.compile(r"procedural:(\d{1,18})(?::[a-z-]+)?")


class Seeds(StrictModel):
    """Hold the procedural seeds from ``first`` to ``last``, both included; unbounded where ``last`` is None."""

    first: Annotated[int, Field(ge=0)]
    last: int | None

    def __contains__(self, seed: int) -> bool:
        return self.first <= seed and (self.last is None or seed <= self.last)


class SceneSplits(StrictModel):
    """Hold the content of the frozen file. A hash is None for a scene that this version of the package cannot make.

    ``train`` and ``test`` map built-in scenes to their hashes; ``seeds`` are the procedural ones of each split, in all
    sizes; ``probes`` hash a few of them, which tell whether the generator still makes the same scenes. ``hash`` is
    :meth:`content_hash`, verified on loading.
    """

    format: Literal[1] = 1
    train: dict[str, str | None]
    test: dict[str, str | None]
    seeds: dict[Split, Seeds]
    probes: dict[str, str | None]
    hash: str = ""

    @model_validator(mode="after")
    def _never_mix(self) -> Self:
        if both := sorted(self.train.keys() & self.test.keys()):
            raise InputError("splits", "test", f"no scene of train; found {', '.join(both)}")
        if self.seeds.keys() != set(SPLITS):
            raise InputError("splits", "seeds", f"those of {' and '.join(SPLITS)}")
        early, late = sorted(self.seeds.values(), key=lambda seeds: seeds.first)
        if late.first in early:
            raise InputError("splits", "seeds", f"no seed in both splits; found {late.first}")
        return self

    def content_hash(self) -> str:
        """Return the first 16 hex digits of the SHA-256 of the canonical JSON without ``hash``."""
        return content_hash(self, without="hash")

    def changed(self) -> list[str]:
        """Return one line for each scene that differs from the frozen one, is gone, or is not frozen yet."""
        lines = []
        for scene, frozen in (self.train | self.test | self.probes).items():
            found = _hash_of(scene)
            if found != frozen:
                lines.append(f"{scene}: frozen as {frozen}, found {found}")
        return lines


@cache
def frozen_splits(path: Path = FROZEN) -> SceneSplits:
    """Return the splits in a file.

    Raises:
        InputError: no such file, no JSON, a scene or seed in both splits, or content that does not match its hash.
    """
    splits = validated(SceneSplits, read_json(path, expected="a readable file of splits"), path)
    if splits.hash != splits.content_hash():
        expected = f"{splits.content_hash()}, the hash of the splits as they are; found {splits.hash!r}"
        raise InputError(path, "hash", expected)
    return splits


def scenes(split: Split, procedural: int = 0) -> tuple[str, ...]:
    """Return the built-in scenes of a split, sorted, and its first ``procedural`` seeds as ``procedural:SEED``.

    Raises :class:`InputError` for an unknown split, or more seeds than it has.
    """
    if split not in SPLITS:
        raise InputError("splits", "split", one_of(SPLITS, split))
    frozen = frozen_splits()
    seeds = range(frozen.seeds[split].first, frozen.seeds[split].first + procedural)
    if procedural < 0 or (procedural and seeds[-1] not in frozen.seeds[split]):
        raise InputError("splits", "procedural", f"a number of seeds that {split} has; found {procedural}")
    built_in = sorted(frozen.train if split == "train" else frozen.test)
    return (*built_in, *(f"procedural:{seed}" for seed in seeds))


def split_of(scene: str) -> Split | None:
    """Return the split of a built-in or procedural scene of any size; None for other scenes, such as a user's file."""
    frozen = frozen_splits()
    if match := _PROCEDURAL.fullmatch(scene):
        return next((split for split in SPLITS if int(match[1]) in frozen.seeds[split]), None)
    return "train" if scene in frozen.train else "test" if scene in frozen.test else None


def freeze(path: Path = FROZEN) -> None:
    """Write the hashes of the scenes as they are now; after scenes were added to the file, or changed on purpose."""
    data = read_json(path)
    for part in ("train", "test", "probes"):
        data[part] = {scene: _hash_of(scene) for scene in sorted(data[part])}
    splits = validated(SceneSplits, data | {"hash": ""}, path)
    splits = splits.model_copy(update={"hash": splits.content_hash()})
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(splits.model_dump(mode="json"), indent=1) + "\n", encoding="utf-8")
    frozen_splits.cache_clear()


def _hash_of(scene: str) -> str | None:
    """Return the content hash of a scene; None where there is none of this name."""
    if scene not in built_in_scenes() and not _PROCEDURAL.fullmatch(scene):
        return None
    try:
        return load_scene(scene).content_hash()
    except InputError:  # a generator that does not know this seed's form
        return None
