"""The schema of an episode's row: typed, versioned, the same for every environment; what does not apply is absent.

A row of an earlier state lacks fields that came later, and the earliest lack ``format``. They are read as they are:
absent is not null. Metres, seconds, radians.
"""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

FORMAT: Literal[1] = 1
KEY = ("env", "scene_hash", "robot", "noise", "sensor_noise", "renderer", "physics", "task", "seed", "agent")
"""The fields that identify an episode; each combination appears once in a sweep."""

Count = Annotated[int, Field(ge=0)]
Length = Annotated[float, Field(ge=0.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Points = list[list[float]]


class _Strict(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class Latency(_Strict):
    """50 % and 95 % points of a stage over the steps of an episode, s."""

    p50: float
    p95: float


class Trace(_Strict):
    """Thinned paths, xy in m: enough for a picture."""

    true: Points
    estimate: Points | None = None  # at the same times; None for an agent that keeps none
    contacts: Points | None = None
    poses: Points | None = None  # with headings
    reached: dict[str, list[float]] | None = None  # share in % -> where an explorer had covered it


class Curve(_Strict):
    """What an explorer knew along its run; None in a series for an agent without a map."""

    metres: list[float]
    seconds: list[float]
    coverage: list[float | None]
    entropy: list[float | None]
    completeness: list[float | None]


class Navigation(_Strict):
    """PointNav tasks that ``astar`` drove on the map that an explorer left: means, and why it failed."""

    tasks: Count
    success: Share
    spl: Share
    failures: list[str]


class EpisodeRow(_Strict):
    """One episode; which environments have which fields, and what they mean, is in ``docs/evaluation.md``."""

    format: Literal[1] = FORMAT
    # What ran
    env: str
    scene: str
    scene_hash: str
    robot: str
    noise: str
    sensor_noise: str
    renderer: str
    physics: str
    task: Count
    seed: Count
    agent: str
    # What made it
    version: str | None = None
    config_hash: str | None = None
    map_hash: str | None = None
    tracer: str | None = None
    end_on: Literal["stop", "reach"] | None = None
    # What was measured
    success: bool
    failure: str | None = None
    status: str | None = None
    spl: Share | None = None
    soft_spl: Share | None = None
    path_length: Length | None = None
    geodesic: Length | None = None
    steps: Count | None = None
    seconds: Length | None = None
    collisions: Count | None = None
    touched: bool | None = None
    distance_to_goal: Length | None = None
    location_error_mean: Length | None = None
    location_error_rmse: Length | None = None
    location_error_max: Length | None = None
    location_error_final: Length | None = None
    latency: dict[str, Latency] | None = None
    decision_p95: Length | None = None  # of rows that are kept without their latencies
    goal: list[float] | None = None
    success_radius: Length | None = None
    trace: Trace | None = None
    # Of a car
    touches: Count | None = None
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
    coverage: Share | None = None
    entropy: float | None = None
    completeness: Share | None = None
    accuracy: Length | None = None
    accurate_5cm: Share | None = None
    completion: Length | None = None
    complete_5cm: Share | None = None
    stopped: bool | None = None
    budget: dict[str, float] | None = None
    navigation: Navigation | None = None
    explored: str | None = None


def checked(row: dict[str, Any]) -> dict[str, Any]:
    """The fields that a row has, as plain values of the schema's types; raises pydantic's ValidationError."""
    return EpisodeRow.model_validate(row).model_dump(exclude_unset=True)


def written(row: dict[str, Any]) -> dict[str, Any]:
    """A row as it is written now: :func:`checked`, with the format's number first."""
    return checked({"format": FORMAT, **row})
