"""Define a robot that turns and slides on the floor: its dimensions, commands and execution noise (TNP-SM)."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np

from vssm_gym.envs.presets import Presets
from vssm_gym.envs.robots.base import camera_ahead
from vssm_gym.envs.robots.biased_noise import BIASED_LEVELS, BiasedExecutionNoise
from vssm_gym.envs.robots.drive_response import DriveResponse
from vssm_gym.envs.validation import choose
from vssm_gym.errors import InputError
from vssm_gym.geometry.axes import DirectionFrame, Matrix4, PlanarPose
from vssm_gym.geometry.transforms import wrap_angle

DIRECTION_FRAMES: tuple[DirectionFrame, ...] = ("body", "world")


@dataclass(frozen=True)
class HolonomicRobot:
    """Define a vertical cylinder that turns and slides on the floor.

    Its camera looks along body x from the cylinder's axis.

    One command ``(turn, o, s)`` lasts ``dt``: turn by ``turn`` rad, and move ``s`` m in the direction ``heading + o``;
    with ``direction_frame="world"`` in the direction ``o``, which may be any (TNP-SM as published: a free compass).
    """

    body_length: float = 0.2  # m, the cylinder's diameter
    height: float = 0.5  # m, top of the cylinder
    camera_height: float = 0.4  # m above the floor
    max_turn: float = math.radians(11.5)  # rad a step, |turn| <= max_turn
    max_offset: float = math.radians(5.0)  # rad, |o| <= max_offset
    max_step: float = 0.16  # m a step, 0 <= s <= max_step: 0.8 body lengths
    dt: float = 0.2  # s
    direction_frame: DirectionFrame = "body"  # of o; in the world frame |o| <= pi
    response: DriveResponse | None = None  # of the drive to commands, in the body frame; None: it carries them out

    commands: ClassVar[tuple[str, ...]] = ("turn", "o", "s")

    def __post_init__(self) -> None:
        choose("HolonomicRobot", "direction_frame", self.direction_frame, DIRECTION_FRAMES)
        if self.direction_frame == "world" and self.response is not None:
            raise InputError("HolonomicRobot", "direction_frame", "'body': a drive follows commands in its own frame")

    @property
    def radius(self) -> float:
        """Return the radius of the footprint, m."""
        return 0.5 * self.body_length

    @property
    def limits(self) -> np.ndarray:
        """Return the largest ``(turn, o, s)``, rad, rad, m; float64 ``(3,)``."""
        return np.array([self.max_turn, self._max_direction, self.max_step])

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and the highest ``(turn, o, s)``, rad, rad, m; float64 ``(3,)``."""
        return np.array([-self.max_turn, -self._max_direction, 0.0]), self.limits

    @property
    def _max_direction(self) -> float:
        return self.max_offset if self.direction_frame == "body" else math.pi

    @property
    def moves(self) -> tuple[np.ndarray, ...]:
        """Return the commands ``(turn, o, s)`` of the discrete actions at their limits: forward, left, right.

        They are in the body frame: no command of the world frame is always forward.
        """
        turn = np.array([self.max_turn, 0.0, 0.0])
        return np.array([0.0, 0.0, self.max_step]), turn, -turn

    @property
    def T_body_cam(self) -> Matrix4:
        """Return the constant transform from camera to body (origin on the floor below the axis).

        Float64 ``(4, 4)``.
        """
        return camera_ahead(self.camera_height)

    def clip(self, command: np.ndarray) -> np.ndarray:
        """Return the nearest command within the limits, component by component: ``(turn, o, s)`` float64 ``(3,)``."""
        return np.clip(np.asarray(command, dtype=np.float64), *self.bounds)

    def parse_noise(self, level: "str | HolonomicNoise | Mapping[str, Any]") -> "HolonomicNoise":
        """Return the noise of a level of :data:`HOLONOMIC_NOISES`, of a mapping of fields, or the noise itself.

        A mapping has the fields of :class:`ExecutionNoise`.
        """
        return level if isinstance(level, BiasedExecutionNoise) else holonomic_noise(level)

    def respond(self, reached: np.ndarray, command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what the drive has reached after a command, and what it carries out; see :class:`DriveResponse`."""
        if self.response is None:
            return command, command
        reached = self.response.follow(reached, command, self.limits, self.dt)
        return reached, self.response.carried_out(reached)

    def execute(
        self, planar: PlanarPose, command: np.ndarray, noise: "HolonomicNoise", rng: np.random.Generator
    ) -> PlanarPose:
        """Execute one noisy step in free space; see :func:`execute` and :meth:`BiasedExecutionNoise.execute`.

        A direction in the world frame is that of the body frame with the heading taken off: the noise is the same.
        """
        if self.direction_frame == "world":
            command = np.array([command[0], command[1] - planar[2], command[2]])
        law = noise.execute if isinstance(noise, BiasedExecutionNoise) else partial(execute, noise=noise)
        after = law(planar, command, rng=rng)
        if self.response is not None:
            driven = math.hypot(*(after[:2] - planar[:2]))
            after[2] = wrap_angle(after[2] + self.response.pull * driven)
        return after


@dataclass(frozen=True)
class ExecutionNoise:
    """``e_a ~ N(0, turn^2)`` in rad and ``e_s ~ N(0, step^2)`` in m: the errors of an executed command."""

    turn: float  # rad, standard deviation of a step's heading error
    step: float  # m, standard deviation of a step's length error

    def __post_init__(self) -> None:
        for field in ("turn", "step"):
            value = getattr(self, field)
            if not (math.isfinite(value) and value >= 0.0):
                raise InputError("ExecutionNoise", field, f"a finite standard deviation >= 0, not {value!r}")


# TNP-SM: 3, 6, 9 degrees a step and 10, 15, 30 % of a body length.
NOISE_LEVELS: dict[str, ExecutionNoise] = {
    "none": ExecutionNoise(0.0, 0.0),
    "low": ExecutionNoise(math.radians(3.0), 0.10 * HolonomicRobot.body_length),
    "mid": ExecutionNoise(math.radians(6.0), 0.15 * HolonomicRobot.body_length),
    "high": ExecutionNoise(math.radians(9.0), 0.30 * HolonomicRobot.body_length),
}


execution_noise = Presets("environment", "noise", ExecutionNoise, NOISE_LEVELS)

HolonomicNoise = ExecutionNoise | BiasedExecutionNoise
HOLONOMIC_NOISES: dict[str, HolonomicNoise] = {**NOISE_LEVELS, **BIASED_LEVELS}
"""The named levels of the robot's execution noise: those of TNP-SM, and Habitat's LoCoBot."""

holonomic_noise: Presets[Any] = Presets("environment", "noise", ExecutionNoise, HOLONOMIC_NOISES)


def execute(planar: PlanarPose, command: np.ndarray, noise: ExecutionNoise, rng: np.random.Generator) -> PlanarPose:
    """Execute one noisy step in free space (TNP-SM, with ``o`` in the body frame).

        heading' = heading + sign(turn) max(0, |turn| + e_a)                      where turn != 0
        xy'      = xy + [cos(phi), sin(phi)] max(0, s + e_s),  phi = heading + o + e_a    where s > 0

    ``e_a ~ N(0, noise.turn^2)``, ``e_s ~ N(0, noise.step^2)``; the same ``e_a`` serves both lines. Noise acts only
    where the robot is commanded to move, and never reverses a motion. The law is the NumPy twin of
    :meth:`vssm_gym.model.transition.planar.Planar.executed` in JAX; a test holds them together.

    Args:
        planar: ``(x, y, heading)`` before the step, m and rad.
        command: ``(turn, o, s)``, rad, rad, m, within the robot's limits.
        noise: standard deviations of a step.
        rng: the dynamics stream; every call draws two normals, so that runs which share a seed share the noise of
            step ``t`` for all commands before it.

    Returns:
        ``(x, y, heading)`` after the step, heading in [-pi, pi).
    """
    e_a, e_s = rng.standard_normal(2) * (noise.turn, noise.step)
    x, y, heading = (float(v) for v in planar)
    turn, offset, step = (float(v) for v in command)
    turned = math.copysign(max(0.0, abs(turn) + e_a), turn) if turn != 0.0 else 0.0
    moved = max(0.0, step + e_s) if step > 0.0 else 0.0
    phi = heading + offset + e_a
    result = np.array([x + moved * math.cos(phi), y + moved * math.sin(phi), heading + turned])
    result[2] = wrap_angle(result[2])
    return result
