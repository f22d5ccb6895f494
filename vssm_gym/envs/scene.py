"""Scenes by name or by file: `load_scene` gives the `Apartment` for a built-in name or a JSON path, `save_scene` writes
one back. The data types are defined in `vssm_gym.envs.apartment` and offered here as well.
"""

import json
from pathlib import Path
from typing import Any

from vssm_gym.envs.apartment import (
    Apartment,
    Box,
    Door,
    Furniture,
    Material,
    Room,
    Wall,
    Window,
    parse_apartment,
)
from vssm_gym.envs.generator import PREFIX, generate, parse_spec
from vssm_gym.envs.importers.procthor import asset_database_of, import_procthor, is_procthor, read_assets
from vssm_gym.envs.solids import SolidBox
from vssm_gym.errors import InputError
from vssm_gym.files import atomic_write

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

ASSETS = Path(__file__).parent / "assets"


def built_in_scenes() -> list[str]:
    """Names that `load_scene` knows without a file, sorted."""
    return sorted(path.stem for path in ASSETS.glob("*.json"))


def load_scene(spec: str | Path | Apartment) -> Apartment:
    """The apartment of a built-in name ("oak"), of a seed, of our own JSON file or of a ProcTHOR house.

    "procedural:7" and "procedural:7:large" are made by `generator.generate`; files are told apart by their content.

    An `Apartment` is returned as it is. Raises InputError naming the file and the field that is wrong.
    """
    if isinstance(spec, Apartment):
        return spec
    if not isinstance(spec, str | Path):
        raise InputError(f"{spec!r:.80}", "scene", "a built-in name, the path of a JSON file or an Apartment")
    if str(spec).startswith(PREFIX):
        return generate(*parse_spec(str(spec)))
    path = Path(spec)
    if str(spec) in built_in_scenes():
        path = ASSETS / f"{spec}.json"
    elif not path.is_file():
        names = ", ".join(built_in_scenes())
        raise InputError(spec, "scene", f"a built-in name ({names}), {PREFIX}SEED or the path of an existing JSON file")
    data = _read_json(path)
    if not isinstance(data, dict):
        raise InputError(path, "scene", f"a JSON object; found {type(data).__name__}")
    if not is_procthor(data):
        return parse_apartment(data, path)
    database = asset_database_of(path)
    return import_procthor(data, read_assets(_read_json(database), database), path.stem, path)


def save_scene(apartment: Apartment, path: str | Path) -> None:
    """Write the apartment's canonical JSON, atomically: the file is either the old one or the whole new one."""
    text = _pretty({"format": apartment.format} | apartment.model_dump(mode="json", exclude_defaults=True))
    with atomic_write(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def _pretty(value: Any, indent: int = 0) -> str:
    """JSON in which whatever fits into 120 columns shares a line, so that a box or a wall reads as one."""
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


def _read_json(path: Path) -> Any:
    def refuse(constant: str) -> None:
        raise InputError(path, "scene", f"finite numbers; found {constant}")

    try:
        return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)
    except UnicodeDecodeError as error:
        raise InputError(path, "scene", "UTF-8 text") from error
    except RecursionError as error:
        raise InputError(path, "scene", "JSON nested less deeply") from error
    except json.JSONDecodeError as error:
        raise InputError(path, f"line {error.lineno}", f"valid JSON ({error.msg})") from error
