"""Hold a log of measured poses and controls, and cut it into steps of equal length.

A log has stamps of its own for poses and for controls. A step lasts from one pose to the next: its control is the mean
of the readings within it (an IMU), or the one command that was executed in it (a robot).
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from vssm_gym.data.trajectories import interpolate
from vssm_gym.errors import InputError

Kind = Literal["imu", "holonomic", "car"]
VELOCITY_SPAN = 0.1  # s on either side of a pose over which its velocity is measured
CUBIC = 3  # degree of the polynomial that is fitted to positions there
POSE_GAP = 0.5  # s between two poses; a longer one is no motion that was measured
FEWEST_STEPS = 20  # of a log: less is too little to learn from


@dataclass(frozen=True)
class DynamicsLog:
    """Hold what was measured; stamps ascend strictly.

    Attributes:
        source: the file, for messages.
        kind: ``imu`` (specific force m/s^2 and rate rad/s in the body frame, then others), ``holonomic`` (turn, o, s),
            or ``car`` (speed, steering).
        times: s, of the poses.
        T_world_body: measured poses, z up.
        control_times: s. A reading of an IMU is that of its stamp; a command has ended at its stamp.
        controls: one row a stamp.
        velocity: linear (m/s) and angular (rad/s) in the world frame, where the log has them; None: they are measured
            by differences of poses.
    """

    source: str
    kind: Kind
    times: Float[np.ndarray, "n"]
    T_world_body: Float[np.ndarray, "n 4 4"]
    control_times: Float[np.ndarray, "m"]
    controls: Float[np.ndarray, "m c"]
    velocity: Float[np.ndarray, "n 6"] | None = None

    def __post_init__(self) -> None:
        for name, stamps in (("times", self.times), ("control_times", self.control_times)):
            if len(stamps) < FEWEST_STEPS:
                raise InputError(self.source, name, f"at least {FEWEST_STEPS} stamps; found {len(stamps)}")
            if not (np.diff(stamps) > 0.0).all():
                raise InputError(self.source, name, "stamps that ascend strictly")
        for name in ("T_world_body", "controls", "velocity"):
            values = getattr(self, name)
            if values is not None and not np.isfinite(values).all():
                raise InputError(self.source, name, "finite numbers")


@dataclass(frozen=True)
class Steps:
    """Hold poses at equal intervals, and the control from each to the next.

    Attributes:
        dt: s, of a step.
        T_world_body: measured poses.
        velocity: linear (m/s) and angular (rad/s), world frame.
        controls: ``controls[k]`` leads from pose ``k`` to ``k + 1``.
        begin: s, stamp of the first pose.
    """

    dt: float
    T_world_body: Float[np.ndarray, "time 4 4"]
    velocity: Float[np.ndarray, "time 6"]
    controls: Float[np.ndarray, "steps c"] = field(default_factory=lambda: np.zeros((0, 0)))
    begin: float = 0.0

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.controls)

    def part(self, first: int, last: int) -> "Steps":
        """Return steps ``first`` to ``last``, exclusive."""
        poses, begin = slice(first, last + 1), self.begin + first * self.dt
        return Steps(self.dt, self.T_world_body[poses], self.velocity[poses], self.controls[first:last], begin)


def measured_velocity(times: np.ndarray, T_world_body: np.ndarray) -> Float[np.ndarray, "n 6"]:
    """Measure velocities of poses by a cubic fit of positions and differences of rotations over ``VELOCITY_SPAN``.

    Args:
        times: ``(n,)`` s, at nearly equal intervals.
        T_world_body: ``(n, 4, 4)`` poses.

    Returns:
        Linear (m/s) and angular (rad/s) velocity in the world frame.
    """
    dt = float(np.median(np.diff(times)))
    half = max(1, round(VELOCITY_SPAN / dt))
    window = 2 * half + 1
    linear = savgol_filter(
        T_world_body[:, :3, 3], window, min(CUBIC, window - 1), deriv=1, delta=dt, axis=0, mode="interp"
    )
    n, R = len(times), Rotation.from_matrix(T_world_body[:, :3, :3])
    few = max(1, half // 3)  # rotations are measured better than positions, and turn faster
    before, after = np.maximum(np.arange(n) - few, 0), np.minimum(np.arange(n) + few, n - 1)
    angular = (R[after] * R[before].inv()).as_rotvec() / (times[after] - times[before])[:, None]
    return np.concatenate([linear, angular], axis=1)


def cut(log: DynamicsLog, step: float | None = None, offset: float = 0.0) -> Steps:
    """Cut a log into steps of equal length.

    Args:
        log: what was measured.
        step: s; None: the interval of its poses. Commands are not cut: their steps are those of the log.
        offset: s after the first pose at which the first step begins.

    Raises:
        InputError: a log with a gap, with too few steps, or with fewer controls than steps.
    """
    if log.kind != "imu":
        return _commanded(log)
    dt = float(np.median(np.diff(log.times))) if step is None else step
    begin = max(log.times[0], log.control_times[0]) + offset
    count = int((min(log.times[-1], log.control_times[-1]) - begin) / dt + 1e-6)
    if count < FEWEST_STEPS:
        raise InputError(log.source, "times", f"at least {FEWEST_STEPS} steps of {dt:g} s with poses and controls")
    if (gap := float(np.diff(log.times).max())) > max(POSE_GAP, 2.0 * dt):
        raise InputError(log.source, "times", f"no gap of more than {POSE_GAP} s between poses; found {gap:.2f} s")
    at = begin + dt * np.arange(count + 1)
    edges = np.searchsorted(log.control_times, at - 1e-6)
    edges[1:] = np.maximum(edges[1:], edges[:-1] + 1)  # a step shorter than an interval holds the last reading
    if edges[-1] > len(log.controls):
        raise InputError(log.source, "control_times", f"a reading in every step of {dt:g} s")
    controls = np.add.reduceat(log.controls, edges[:-1], axis=0)
    last = slice(edges[-2], edges[-1])
    controls[-1] = log.controls[last].sum(axis=0)
    controls /= np.diff(edges)[:, None]
    velocity = log.velocity if log.velocity is not None else measured_velocity(log.times, log.T_world_body)
    return Steps(
        dt,
        interpolate(log.times, log.T_world_body, at),
        np.stack([np.interp(at, log.times, velocity[:, k]) for k in range(6)], axis=1),
        controls,
        float(begin),
    )


def _commanded(log: DynamicsLog) -> Steps:
    """Return the steps of a robot: a command has ended where the pose was measured."""
    dt = float(np.median(np.diff(log.times)))
    if np.abs(np.diff(log.times) - dt).max() > 0.1 * dt:
        raise InputError(log.source, "times", f"poses every {dt:g} s, without a gap")
    found = np.searchsorted(log.control_times, log.times[1:] - 0.5 * dt)
    if found[-1] >= len(log.controls) or np.abs(log.control_times[found] - log.times[1:]).max() > 0.5 * dt:
        raise InputError(log.source, "control_times", "a command for each step between two poses")
    velocity = measured_velocity(log.times, log.T_world_body)
    return Steps(dt, log.T_world_body, velocity, log.controls[found], float(log.times[0]))
