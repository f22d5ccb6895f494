"""Define the rows of the calibration study as they are stored, and read those of one that is continued."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from vssm_gym.envs.validation import StrictModel
from vssm_gym.eval.studies.stored_rows import stored_rows

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
    """Return the rows of an outcome that is continued; see :func:`~vssm_gym.eval.studies.stored_rows.stored_rows`."""
    return stored_rows(path, setting, StoredRow, "the outcome of a calibration study")
