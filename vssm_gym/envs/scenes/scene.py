"""Load scenes by name or from files, and save them.

`load_scene` returns the `Apartment` of a built-in name or a path, `save_scene` writes one. The data types are defined
in `vssm_gym.envs.scenes.apartment` and exported here as well.
"""

import json
from pathlib import Path
from typing import Any

from vssm_gym.envs.scenes.apartment import Apartment, parse_apartment
from vssm_gym.envs.scenes.apartment_parts import Box, Door, Furniture, Material, Room, Wall, Window
from vssm_gym.envs.scenes.faults import floating, misplaced, open_edges, with_notes
from vssm_gym.envs.scenes.generator import PREFIX, generate, parse_spec
from vssm_gym.envs.scenes.importers.houseexpo import import_houseexpo, is_houseexpo
from vssm_gym.envs.scenes.importers.procthor import asset_database_of, import_procthor, is_procthor, read_assets
from vssm_gym.envs.scenes.importers.ros_map import import_ros_map
from vssm_gym.envs.scenes.solids import SolidBox
from vssm_gym.envs.scenes.specs import LINES, house_line
from vssm_gym.errors import InputError, did_you_mean
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.bounded import is_file
from vssm_gym.files.json_file import read_json, read_json_line

__all__ = [
    "Apartment",
    "Box",
    "Door",
    "Furniture",
    "Material",
    "Room",
    "SolidBox",
    "Wall",
    "Window",
    "built_in_scenes",
    "load_scene",
    "parse_apartment",
    "save_scene",
]

ASSETS = Path(__file__).parents[1] / "assets"


def built_in_scenes() -> list[str]:
    """Return the names that `load_scene` knows without a file, sorted."""
    return sorted(path.stem for path in ASSETS.glob("*.json"))


def load_scene(spec: str | Path | Apartment) -> Apartment:
    """Load the apartment of a built-in name, of a seed or of a file.

    Args:
        spec: a built-in name (``"oak"``); a seed of the generator (``"procedural:7"``, ``"procedural:7:large"``); or a
            file: JSON (our own, a ProcTHOR house or a HouseExpo plan, recognised by the content), a line of a file of
            ProcTHOR houses (``houses.jsonl.gz#7``, counted from 0), a ROS map's YAML, or MJCF (XML) with a floor. An
            :class:`Apartment` is returned as it is.

    Returns:
        The apartment, checked.

    Raises:
        InputError: an unknown name, or a file that is missing or malformed; it names the file and the field.
    """
    if isinstance(spec, Apartment):
        return spec
    if not isinstance(spec, str | Path):
        raise InputError(
            f"{spec!r:.80}", "scene", f"a built-in name, {PREFIX}SEED, the path of a scene file or an Apartment"
        )
    if str(spec).startswith(PREFIX):
        return generate(*parse_spec(str(spec)))
    if str(spec) in built_in_scenes():
        return _from_json(ASSETS / f"{spec}.json")
    return _from_file(str(spec))


def _from_file(spec: str) -> Apartment:
    """Read the apartment in a file, whose format is recognised by its name, or by its content if it is JSON."""
    if (found := house_line(spec)) is not None:
        return _from_lines(*found)
    path = Path(spec)
    if not is_file(path):
        names = ", ".join(built_in_scenes())
        expected = f"a built-in name ({names}), {PREFIX}SEED or the path of an existing file"
        raise InputError(spec, "scene", f"{expected}{did_you_mean(built_in_scenes(), spec)}")
    if spec.endswith(LINES):
        raise InputError(spec, "scene", f"the line of the house, counted from 0, as in {path.name}#0")
    if path.suffix in (".yaml", ".yml"):
        return import_ros_map(path)
    if path.suffix.lower() in (".pgm", ".png"):
        raise InputError(spec, "scene", f"the YAML of the ROS map that names {path.name} as its image")
    if path.suffix == ".xml":
        from vssm_gym.envs.scenes.importers.mjcf import import_mjcf  # only here: it loads MuJoCo

        return import_mjcf(path)
    return _from_json(path)


def _from_json(path: Path) -> Apartment:
    data = read_json(path)
    if not isinstance(data, dict):
        raise InputError(path, "scene", f"a JSON object; found {type(data).__name__}")
    if is_procthor(data):
        return _procthor(data, path, path.stem, path)
    if is_houseexpo(data):
        return import_houseexpo(data, path.stem, path)
    apartment = parse_apartment(data, path)
    # Tests check the built-in scenes; those of others are checked here.
    return apartment if ASSETS in path.parents else with_notes(apartment, open_edges, misplaced, floating)


def _from_lines(path: Path, line: int) -> Apartment:
    """Read the ProcTHOR house on a line, counted from 0, of a file of houses."""
    source = f"{path}#{line}"
    name = f"{path.name.removesuffix('.gz').removesuffix('.jsonl')}#{line}"
    return _procthor(read_json_line(path, line), path, name, source)


def _procthor(data: Any, path: Path, name: str, source: object) -> Apartment:
    database = asset_database_of(path)
    return import_procthor(data, read_assets(read_json(database), database), name, source)


def save_scene(apartment: Apartment, path: str | Path) -> None:
    """Write the apartment's canonical JSON, atomically: the file is either the old one or the whole new one."""
    text = _pretty({"format": apartment.format} | apartment.model_dump(mode="json", exclude_defaults=True))
    with atomic_write(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def _pretty(value: Any, indent: int = 0) -> str:
    """Format JSON so that values that fit into 120 columns, such as a box or a wall, are on one line."""
    line = json.dumps(value, allow_nan=False)
    if len(line) + indent <= 120 or not isinstance(value, dict | list):
        return line
    pad = " " * (indent + 1)
    if isinstance(value, dict):
        items = [f"{json.dumps(key)}: {_pretty(item, indent + 1)}" for key, item in value.items()]
    else:
        items = [_pretty(item, indent + 1) for item in value]
    opening, closing = "{}" if isinstance(value, dict) else "[]"
    return f"{opening}\n{pad}" + f",\n{pad}".join(items) + f"\n{' ' * indent}{closing}"
