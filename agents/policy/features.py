"""Turn an observation into the vector that a policy's network reads: numbers of the order of one.

    scan   64: n(d) = h / (h + d), h = 0.5 m: 1 at a wall, 0 where nothing was measured
    goal    4: cos, sin of the bearing; d / 10 m; n(d)
    pose   44: cos, sin of the heading; cos, sin of the goal's direction in the map frame; waves of (x, y), of the goal
               waves(p) = [sin, cos](2 pi p / L) for L = 32, 16, 8, 4, 2 m, along x and along y
    pose_std 3: of the estimate's error, forward and to the left in decimetres, turn in tenths of a radian
    commands 12: the last four, newest first: turn / 0.2 rad, direction / 0.1 rad, step / 0.2 m; zeros before the first
    observed_goal 3, observed_pose 3, observed_pose_std 3, observed_scan 64: the observation itself, as it comes

Without the commands a policy cannot tell what a drive that lags has yet to do. The vector is the same in training, in
imagination and on the robot. The pose is the estimated one. Waves let a small network distinguish places finely
("random Fourier features", Tancik et al., 2020; here with fixed lengths), which it learns far more slowly from x and y
alone.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from vssm_gym.geometry.scan import BEAMS

# These numbers are part of the policies on disk.
HALF_DISTANCE = 0.5  # m, at which the nearness of a distance is one half
APARTMENT_SIZE = 10.0  # m, of the order of an apartment
WAVES = np.array([32.0, 16.0, 8.0, 4.0, 2.0])  # m, from the size of a house to that of a passage
LAST_COMMANDS = 4  # steps of 0.2 s: a drive with a lag of 0.4 s has carried out 0.92 of the command before them
COMMAND_UNITS = np.array([0.2, 0.1, 0.2])  # rad, rad, m: of the order of the holonomic robot's limits
OBSERVED = "observed_"  # of names of parts that are numbers of the observation, neither scaled nor converted
SIZES = {"scan": BEAMS, "goal": 4, "pose": 4 + 2 * 4 * len(WAVES), "pose_std": 3, "commands": 3 * LAST_COMMANDS} | {
    f"{OBSERVED}{name}": size for name, size in (("goal", 3), ("pose", 3), ("pose_std", 3), ("scan", BEAMS))
}
"""Length of each part of the vector, in the order of the vector."""


def size_of(parts: Sequence[str]) -> int:
    """Return the length of the vector."""
    return sum(SIZES[part] for part in parts)


def features(observation: Mapping[str, Any], parts: Sequence[str], xp: Any = np) -> Float[Any, "*batch features"]:
    """Return the vector of an observation, float32.

    Args:
        observation: ``scan (*batch, 64)`` z-depths in m, 0 = no measurement; ``goal (*batch, 3)`` distance in m, cos
            and sin of the bearing; ``pose (*batch, 3)`` x, y (m), heading (rad), map frame; ``pose_std (*batch, 3)``
            forward, left (m), turn (rad); ``commands (*batch, 4, 3)`` turn, direction (rad), step (m). The entries of
            ``parts`` are read, and with the pose also the goal.
        parts: some of SIZES, in any order.
        xp: the module of the arrays, ``numpy`` or ``jax.numpy``.
    """
    makers = {"scan": _scan, "goal": _goal, "pose": _pose, "pose_std": _pose_std, "commands": _commands}
    made = [
        makers[part](observation, xp) if part in makers else observation[part.removeprefix(OBSERVED)]
        for part in SIZES
        if part in parts
    ]
    return xp.concatenate(made, axis=-1).astype(np.float32)


def relative(pose: Float[np.ndarray, "3"], goal: Float[np.ndarray, "2"], farther: float = 0.0) -> np.ndarray:
    """Return ``(distance + farther, cos, sin of the bearing)`` of a point from a pose, both in the map frame."""
    away = np.asarray(goal, np.float64) - pose[:2]
    bearing = np.arctan2(away[1], away[0]) - pose[2]
    return np.array([np.hypot(away[0], away[1]) + farther, np.cos(bearing), np.sin(bearing)])


def _nearness(distance: Any) -> Any:
    return HALF_DISTANCE / (HALF_DISTANCE + distance)


def _scan(observation: Mapping[str, Any], xp: Any) -> Any:
    scan = observation["scan"]
    return xp.where(scan > 0.0, _nearness(scan), 0.0)


def _goal(observation: Mapping[str, Any], xp: Any) -> Any:
    goal = observation["goal"]
    distance = goal[..., :1]
    return xp.concatenate([goal[..., 1:], distance / APARTMENT_SIZE, _nearness(distance)], axis=-1)


def _pose(observation: Mapping[str, Any], xp: Any) -> Any:
    goal, pose = observation["goal"], observation["pose"]
    c, s = xp.cos(pose[..., 2]), xp.sin(pose[..., 2])
    direction = xp.stack([c * goal[..., 1] - s * goal[..., 2], s * goal[..., 1] + c * goal[..., 2]], axis=-1)
    there = pose[..., :2] + goal[..., :1] * direction
    return xp.concatenate([xp.stack([c, s], axis=-1), direction, _waves(pose[..., :2], xp), _waves(there, xp)], axis=-1)


def _pose_std(observation: Mapping[str, Any], xp: Any) -> Any:
    return 10.0 * observation["pose_std"]


def _commands(observation: Mapping[str, Any], xp: Any) -> Any:
    scaled = observation["commands"] / COMMAND_UNITS
    return scaled.reshape(*scaled.shape[:-2], -1)


def _waves(xy: Any, xp: Any) -> Any:
    phase = (2.0 * np.pi * xy[..., None] / WAVES).reshape(*xy.shape[:-1], -1)
    return xp.concatenate([xp.sin(phase), xp.cos(phase)], axis=-1)
