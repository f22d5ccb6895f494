"""Check a map that agents are given instead of a learned one, and copy it into the folder of a sweep."""

from pathlib import Path

from vssm_gym.errors import InputError
from vssm_gym.eval.sweep.config import SweepConfig
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.output_folders import ADVICE
from vssm_gym.maps.map_file import map_hash
from vssm_gym.maps.voxel_map import read_metadata


def given_map_hash(config: SweepConfig, map_file: Path) -> str:
    """Return the hash of a map that agents are given; raise :class:`InputError` where it cannot be theirs."""
    if len(config.scenes) != 1:
        raise InputError(map_file, "map", f"a configuration of one scene; found {len(config.scenes)}")
    return scene_map_hash(map_file)


def scene_map_hash(map_file: Path) -> str:
    """Return the hash of a map in a scene's frame; raise :class:`InputError` for one in a camera's frame."""
    if "sequence" in read_metadata(map_file):
        expected = "a map in the scene's frame, of `vssm-gym map build`; this one is in its first camera's frame"
        raise InputError(map_file, "frame", expected)
    return map_hash(map_file)


def copy_map(source: Path, target: Path) -> None:
    """Copy a map into the folder, so that reports and resumed runs find it; the same one may be there."""
    if target.is_file() and map_hash(target) == map_hash(source):
        return
    if target.exists():
        raise InputError(target, "file", f"a copy of {source}; it differs ({ADVICE})")
    target.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(target) as temporary:
        temporary.write_bytes(source.read_bytes())
