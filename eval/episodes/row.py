"""Define the schema of an episode's row: typed, versioned, the same for every environment.

Fields that do not apply to an environment are absent. A row of an earlier state lacks fields that came later, and the
earliest lack ``format``; they are read as they are, because absent is not null. Fields that have been renamed since are
read under both names (:data:`RENAMED_FIELDS`). Units are metres, seconds and radians.

Formats: 1, the first; 2, ``touched`` and ``touches`` are called ``collided`` and ``collision_events``.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

FORMAT: Literal[2] = 2  # of a row; 1 has other names for some fields
KEY = ("env", "scene_hash", "robot", "noise", "sensor_noise", "renderer", "physics", "task", "seed", "agent")
"""The fields that identify an episode, with those of :data:`DEFAULTS`; each combination appears once in a sweep."""
DEFAULTS: dict[str, str] = {"direction_frame": "body"}
"""Fields that identify an episode, too, and are written where they differ from these values: they came later."""
RENAMED_FIELDS = {"touched": "collided", "touches": "collision_events"}
"""Fields of format 1 and their present names."""

Count = Annotated[int, Field(ge=0)]
Length = Annotated[float, Field(ge=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]
Proportion = Annotated[float, Field(ge=0.0, le=1.0)]
Points = list[list[float]]


class _Strict(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class Latency(_Strict):
    """Hold the 50 % and 95 % points of a stage's latency over the steps of an episode, s."""

    p50: float
    p95: float


class Trace(_Strict):
    """Hold thinned paths for a picture, xy in m."""

    true: Points
    estimate: Points | None = None  # at the same times; None for an agent that keeps none
    contacts: Points | None = None
    poses: Points | None = None  # with headings
    reached: dict[str, list[float]] | None = None  # % of coverage -> where an explorer had reached it


class Curve(_Strict):
    """Hold what an explorer knew along its run; None in a series for an agent without a map."""

    metres: list[float]
    seconds: list[float]
    coverage: list[float | None]
    entropy: list[float | None]
    completeness: list[float | None]


class Navigation(_Strict):
    """Hold the results of PointNav tasks that ``astar`` drove on an explorer's map: means, and reasons of failures."""

    tasks: Count
    success: Proportion
    spl: Proportion
    failures: list[str]


class EpisodeRow(_Strict):
    """Hold one episode; ``docs/evaluation.md`` lists the fields of each environment and their meaning."""

    format: Literal[2] = FORMAT
    # What ran
    env: str
    scene: str
    scene_hash: str
    robot: str
    noise: str
    sensor_noise: str
    renderer: str
    physics: str
    direction_frame: Literal["body", "world"] = "body"
    task: Count
    seed: Count
    agent: str
    # What made it
    version: str | None = None
    processor: str | None = None
    config_hash: str | None = None
    map_hash: str | None = None
    tracer: str | None = None
    end_on: Literal["stop", "reach"] | None = None
    # What was measured
    success: bool
    failure: str | None
    path_length: Length
    status: str | None = None
    spl: Proportion | None = None
    soft_spl: Proportion | None = None
    geodesic: Length | None = None
    steps: Count | None = None
    seconds: Length | None = None
    collisions: Count | None = None
    collided: bool | None = None
    distance_to_goal: Length | None = None
    location_error_mean: Length | None = None
    location_error_rmse: Length | None = None
    location_error_max: Length | None = None
    location_error_final: Length | None = None
    nees: NonNegative | None = None  # over the dimension, mean over the steps; None of an agent without a covariance
    in_95: Proportion | None = None  # of the steps
    responses: dict[str, Count] | None = None  # to failures on the way, by name
    expansions: Count | None = None  # nodes that searches have closed
    latency: dict[str, Latency] | None = None
    decision_p95: Length | None = None  # of rows that are kept without their latencies
    goal: list[float] | None = None
    success_radius: Length | None = None
    trace: Trace | None = None
    # Of a car
    collision_events: Count | None = None
    direction_changes: Count | None = None
    heading_error: float | None = None
    # Of an explorer
    metres_50: Length | None = None
    metres_90: Length | None = None
    metres_95: Length | None = None
    metres_99: Length | None = None
    seconds_50: Length | None = None
    seconds_90: Length | None = None
    seconds_95: Length | None = None
    seconds_99: Length | None = None
    curve: Curve | None = None
    coverage: Proportion | None = None
    entropy: float | None = None
    completeness: Proportion | None = None
    accuracy: Length | None = None
    accurate_5cm: Proportion | None = None
    completion: Length | None = None
    complete_5cm: Proportion | None = None
    stopped: bool | None = None
    budget: dict[str, float] | None = None
    navigation: Navigation | None = None
    explored: str | None = None


def identified(row: Mapping[str, Any], name: str) -> Any:
    """Return a field that identifies a row's episode; a row may leave out one that has its default."""
    return row.get(name, DEFAULTS[name]) if name in DEFAULTS else row[name]


def without_defaults(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return fields without those that have the value, or the list of it alone, that :data:`DEFAULTS` states."""
    stated = lambda name: name in DEFAULTS and fields[name] in (DEFAULTS[name], [DEFAULTS[name]])
    return {name: value for name, value in fields.items() if not stated(name)}


def upgraded(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row of any format under the present names; a row without ``format`` stays without it."""
    row = {
        RENAMED_FIELDS.get(name, name) if RENAMED_FIELDS.get(name) not in row else name: value
        for name, value in row.items()
    }
    return row | {"format": FORMAT} if row.get("format") == 1 else row


def checked(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a row as plain values of the schema's types; raise pydantic's ValidationError."""
    return EpisodeRow.model_validate(upgraded(row)).model_dump(exclude_unset=True)


def written(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row as it is written now: :func:`checked`, with the format's number first."""
    return checked({"format": FORMAT, **row})
