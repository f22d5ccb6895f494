"""Explain why an episode failed, in one line ``kind: detail``, from the truth and from the agent's statuses."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

STUCK_STEPS = 15  # the last steps that are examined
STUCK_CONTACTS = 0.5  # proportion of them in collision
FAULT = "fault"  # the kind of a failure of the agent's own code, in runs that go on without it
GAVE_UP_LOST = "gave up: lost"  # how the status of an agent begins that ended its task without an estimate
CONTACT_MEMORY = 10  # steps before the track was lost in which a contact may explain it


def failure_reason(
    *,
    stopped: bool,
    statuses: Sequence[str],
    positions: Float[np.ndarray, "time 2"],
    estimates: Float[np.ndarray, "time 2"] | None,
    goal: Float[np.ndarray, "2"],
    contacts: Bool[np.ndarray, "steps"],
    body_length: float,
) -> str:
    """Return the first of these reasons that holds for a failed episode; failures are counted by the kind.

    - ``lost track``: at the end the estimate is more than a body length from the truth;
    - ``lost``: the agent gave up because it did not believe its estimate, though it was good;
    - ``planner``: the agent gave up, or was still looking around, because its planner found no path or not in time;
    - ``collision``: stuck, within one body length and mostly in contact over the last steps;
    - ``stopped outside``: the agent stopped, knowing where it was, and the goal was not there;
    - ``time out``: none of these before the last step.

    Args:
        stopped: whether the agent ended the episode itself.
        statuses: the agent's status at each decision.
        positions: true positions at reset and after every step, m.
        estimates: the agent's position estimates at the same times, NaN where it gave none; None if it keeps none.
        goal: the goal's xy, m.
        contacts: whether the robot was in collision, for each step.
        body_length: diameter of the robot's footprint, or length of the car's, m.
    """
    if lost := lost_track(statuses, positions, estimates, contacts, body_length):
        return lost
    last = statuses[-1]
    if last.startswith(GAVE_UP_LOST):
        return f"lost: {last}"
    if last.startswith(("gave up", "looking around")):
        return f"planner: {last}"
    away = float(np.linalg.norm(positions[-1] - goal))
    if not stopped and (stuck := stuck_at(positions, contacts, body_length)):
        return f"{stuck}, {away:.2f} m from the goal"
    if stopped:
        return f"stopped outside: {away:.3f} m from the goal"
    return f"time out: {away:.2f} m from the goal after {len(positions) - 1} steps"


def stuck_at(
    positions: Float[np.ndarray, "time 2"], contacts: Bool[np.ndarray, "steps"], body_length: float
) -> str | None:
    """Return ``collision: ...`` where the robot barely moved and was mostly in collision over the last steps."""
    tail = positions[-STUCK_STEPS:]
    spread = float(np.linalg.norm(tail - tail[-1], axis=1).max())
    if spread < body_length and len(contacts) and np.mean(contacts[-STUCK_STEPS:]) >= STUCK_CONTACTS:
        return f"collision: stuck, {spread:.2f} m in the last {len(tail)} steps"
    return None


def lost_track(
    statuses: Sequence[str],
    positions: Float[np.ndarray, "time 2"],
    estimates: Float[np.ndarray, "time 2"] | None,
    contacts: Bool[np.ndarray, "steps"],
    body_length: float,
) -> str | None:
    """Return ``lost track: ...`` with the error at the end and its first step; None for a good estimate, or none."""
    if estimates is None:
        return None
    error = np.linalg.norm(estimates - positions, axis=1)
    known = np.flatnonzero(np.isfinite(error))
    if not len(known) or error[known[-1]] <= body_length:
        return None
    good = known[error[known] <= body_length]
    since = int(good[-1]) + 1 if len(good) else 0
    collided = bool(np.any(contacts[max(0, since - CONTACT_MEMORY) : since]))
    noticed = "which the agent noticed" if any("lost" in status for status in statuses) else "unnoticed by the agent"
    return (
        f"lost track: {error[known[-1]]:.2f} m off at the end, more than {body_length:g} m since step {since}"
        f"{', after a contact' if collided else ''}, {noticed}"
    )
