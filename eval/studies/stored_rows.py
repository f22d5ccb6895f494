"""Read the rows of a study that is continued; a file that another program wrote or damaged is refused."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vssm_gym.envs.validation import StrictModel, validated
from vssm_gym.errors import InputError
from vssm_gym.files.json_file import read_json
from vssm_gym.version import package_version


def stored_rows(
    path: Path, setting: Mapping[str, Any], model: type[StrictModel], expected: str
) -> dict[str, dict[str, Any]]:
    """Return the rows of a study by their labels; none where there is no file.

    Args:
        path: of the study's JSON file.
        setting: of the study that continues it.
        model: of a row.
        expected: what the file has to be, for errors.

    Raises:
        InputError: no outcome of this study, another setting, or another version of the package, whose rows do not
            belong into one table.
    """
    if not path.is_file():
        return {}
    stored = read_json(path, expected=expected)
    parts = [stored.get(name) if isinstance(stored, dict) else None for name in ("setting", "figures")]
    rows = parts[1].get("rows") if isinstance(parts[1], dict) else None
    if not isinstance(parts[0], dict) or not isinstance(rows, dict) or not rows:
        raise InputError(path, "content", expected)
    found = parts[0] | {"version": stored.get("version")}
    for name, value in {**setting, "version": package_version()}.items():
        if found.get(name) != value:
            raise InputError(path, name, f"{value}, as in this study; found {found.get(name)!r:.80}")
    models = {name: validated(model, row, path, f"figures.rows.{name:.80}") for name, row in rows.items()}
    return {name: one.model_dump(mode="json", exclude_unset=True) for name, one in models.items()}
