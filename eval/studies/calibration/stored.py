"""Read the rows of a study that is continued; a file that another program wrote or damaged is refused."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from vssm_gym.envs.validation import StrictModel, validated
from vssm_gym.errors import InputError
from vssm_gym.files.json_file import read_json
from vssm_gym.version import package_version

Count = Annotated[int, Field(ge=0, lt=10**9)]
Size = Annotated[float, Field(ge=0.0, lt=1e30)]  # of a NEES or a length
Share = Annotated[float, Field(ge=0.0, le=1.0)]


class Nees(StrictModel):
    """Hold NEES / d of runs: its mean, the interval, and the value of each run."""

    mean: Size | None
    low: Size | None
    high: Size | None
    values: tuple[Size, ...]


class Segments(StrictModel):
    """Hold the share of segments inside the region, its interval, and NEES / d at their ends."""

    count: Count
    ended_lost: Count
    share: Share | None
    low: Share | None
    high: Share | None
    mean: Size | None
    values: tuple[Size, ...]


class Velocity(StrictModel):
    """Hold shares of components inside their band."""

    linear: Share
    angular: Share


class Nuisances(StrictModel):
    """Hold estimated errors of the ground truth."""

    delay_s: float
    first_pose: Annotated[tuple[float, ...], Field(min_length=6, max_length=6)]


class StoredRow(StrictModel):
    """Hold a row as :func:`errors.summarise` returns it, and what it is in words."""

    runs: Count
    frames: Count
    lost: Count
    dimension: Count
    nees: Nees
    segments: Segments
    error_m: Size | None
    std_m: Size | None
    velocity: Velocity | None
    about: str
    nuisances: Nuisances | None = None


def finished(path: Path, setting: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the rows of a study by their labels; none where there is no file.

    Args:
        path: ``calibration.json``.
        setting: of the study that continues it.

    Raises:
        InputError: no outcome of this study, another setting, or another version of the package, whose rows do not
            belong into one table.
    """
    if not path.is_file():
        return {}
    expected = "the outcome of a calibration study"
    stored = read_json(path, expected=expected)
    parts = [stored.get(name) if isinstance(stored, dict) else None for name in ("setting", "figures")]
    rows = parts[1].get("rows") if isinstance(parts[1], dict) else None
    if not isinstance(parts[0], dict) or not isinstance(rows, dict) or not rows:
        raise InputError(path, "content", expected)
    found = parts[0] | {"version": stored.get("version")}
    for name, value in {**setting, "version": package_version()}.items():
        if found.get(name) != value:
            raise InputError(path, name, f"{value}, as in this study; found {found.get(name)!r:.80}")
    models = {name: validated(StoredRow, row, path, f"figures.rows.{name:.80}") for name, row in rows.items()}
    return {name: model.model_dump(mode="json", exclude_unset=True) for name, model in models.items()}
