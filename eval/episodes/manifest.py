"""Read a sweep's manifest, ``sweep.json``, and complete rows with the fields that it states for all of them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vssm_gym.agents.renamed import current_name
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.row import DEFAULTS, without_defaults
from vssm_gym.files.json_file import LARGEST_WHOLE, read_json
from vssm_gym.files.numbers import whole

MANIFEST = "sweep.json"
FIELDS = ("config", "config_hash", "version", "seed", "episodes")
# Fields of a row, and the lists of the configuration that their values come from.
LISTS = {name: name for name in ("env", "robot", "noise", "sensor_noise", "renderer", "physics")}
LISTS |= {name: name for name in DEFAULTS}  # which a configuration may leave out
LISTS |= {"scene": "scenes", "agent": "agents", "task": "tasks", "seed": "seeds"}


def read_manifest(path: Path) -> dict[str, Any]:
    """Read a manifest: ``config``, ``config_hash``, ``version``, ``seed``, ``episodes``.

    Agents that were renamed since have their present names.

    Raises:
        InputError: no such file, no JSON, or a field that is missing.
    """
    if not path.is_file():
        found = sorted(child.parent.name for child in path.parent.glob(f"*/{path.name}"))
        those = f"; those of {path.parent} are {', '.join(found)}" if found else ""
        raise InputError(path, "file", f"a sweep's folder{those or '; `vssm-gym sweep CONFIG --out DIR` makes one'}")
    manifest = read_json(path, expected="the JSON that a sweep wrote")
    if not isinstance(manifest, dict):
        raise InputError(path, "file", f"the JSON that a sweep wrote; found {manifest!r:.80}")
    if missing := set(FIELDS) - manifest.keys():
        raise InputError(path, min(missing), "this field")
    for field in ("config_hash", "version"):
        if not isinstance(manifest[field], str):
            raise InputError(path, field, f"a text, as a sweep wrote it; found {manifest[field]!r:.80}")
    whole(manifest["episodes"], path, "episodes", least=0, most=LARGEST_WHOLE - 1)
    for field in ("config", "common", "scene_hashes", "notices"):
        if not isinstance(manifest.get(field, {}), dict):
            raise InputError(path, field, f"an object, as a sweep wrote it; found {manifest[field]!r:.80}")
    for field in ("scene_hashes", "notices"):
        for name, value in manifest.get(field, {}).items():
            if not isinstance(value, str):
                raise InputError(path, f"{field}.{name}", f"a text, as a sweep wrote it; found {value!r:.80}")
    agents = manifest["config"].get("agents", [])
    if not isinstance(agents, list) or not all(isinstance(agent, str) for agent in agents):
        raise InputError(path, "config.agents", "a list of agents' names")
    if agents:
        manifest["config"]["agents"] = [current_name(agent) for agent in agents]
    return manifest


def completed(row: Mapping[str, Any], manifest: Mapping[str, Any]) -> dict[str, Any]:
    """Complete a row with ``common`` and with the configuration's lists that hold one value.

    Fields of the row itself take precedence. The hash of its scene is found by the scene's name.
    """
    config = manifest["config"]
    lists = {field: config.get(name) for field, name in LISTS.items()}
    only = {field: values[0] for field, values in lists.items() if isinstance(values, list) and len(values) == 1}
    complete = {**without_defaults(only), **manifest.get("common", {}), **row}
    hashes = manifest.get("scene_hashes", {})
    if "scene_hash" not in complete and isinstance(complete.get("scene"), str) and complete["scene"] in hashes:
        complete["scene_hash"] = hashes[complete["scene"]]
    return complete
