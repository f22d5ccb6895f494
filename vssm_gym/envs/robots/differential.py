"""Define a robot with differential drive: a command is the travel of each wheel in one step.

    s = (l + r) / 2,   turn = (r - l) / track        T' = T exp(s, 0, turn): an arc, integrated exactly
    l' = sign(l) max(0, |l| + e_l),   e_l ~ N(0, (slip l)^2 + play^2)        where l != 0, and r alike

The errors of the wheels are independent. Noise acts only on a wheel that is driven and never reverses it; a wheel at
rest stays. The law is the NumPy twin of
:meth:`vssm_gym.model.transition.differential.DifferentialDrive.executed`; a test holds them together.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from vssm_gym.envs.presets import Presets
from vssm_gym.envs.robots.base import camera_ahead
from vssm_gym.errors import InputError
from vssm_gym.geometry.axes import Matrix4, PlanarPose
from vssm_gym.geometry.transforms import wrap_angle


@dataclass(frozen=True)
class DifferentialExecutionNoise:
    """``e ~ N(0, (slip l)^2 + play^2)``: error of a wheel's travel in a step of commanded travel ``l``."""

    slip: float  # fraction of the travel, standard deviation
    play: float  # m, standard deviation of a step however short

    def __post_init__(self) -> None:
        for field in ("slip", "play"):
            value = getattr(self, field)
            if not (math.isfinite(value) and value >= 0.0):
                raise InputError(
                    "DifferentialExecutionNoise", field, f"a finite standard deviation >= 0, not {value!r}"
                )


# At full speed the heading strays by 2.6, 5.3 and 8.7 degrees a step: about as the holonomic robot's 3, 6 and 9.
NOISE_LEVELS: dict[str, DifferentialExecutionNoise] = {
    "none": DifferentialExecutionNoise(0.0, 0.0),
    "low": DifferentialExecutionNoise(slip=0.03, play=0.002),
    "mid": DifferentialExecutionNoise(slip=0.06, play=0.004),
    "high": DifferentialExecutionNoise(slip=0.10, play=0.006),
}

execution_noise = Presets("environment", "noise", DifferentialExecutionNoise, NOISE_LEVELS)


@dataclass(frozen=True)
class DifferentialRobot:
    """Define the holonomic robot's cylinder and camera on two wheels, one on each side of the cylinder's axis.

    One command ``(left, right)`` lasts ``dt``: the travel of each wheel, m, negative backwards.
    """

    body_length: float = 0.2  # m, the cylinder's diameter
    height: float = 0.5  # m, top of the cylinder
    camera_height: float = 0.4  # m above the floor
    track: float = 0.16  # m between the wheels
    max_travel: float = 0.16  # m a step, |left|, |right| <= max_travel
    spot_turn: float = math.radians(11.5)  # rad, of a discrete action: the holonomic robot's largest turn
    dt: float = 0.2  # s

    commands: ClassVar[tuple[str, ...]] = ("left", "right")

    @property
    def radius(self) -> float:
        """Return the radius of the footprint, m."""
        return 0.5 * self.body_length

    @property
    def limits(self) -> np.ndarray:
        """Return the largest ``(left, right)``, m; float64 ``(2,)``."""
        return np.full(2, self.max_travel)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and the highest ``(left, right)``, m; float64 ``(2,)``."""
        return -self.limits, self.limits

    @property
    def moves(self) -> tuple[np.ndarray, ...]:
        """Return the commands ``(left, right)`` of the discrete actions: forward, and turns on the spot."""
        wheel = 0.5 * self.track * self.spot_turn
        turn = np.array([-wheel, wheel])
        return self.limits, turn, -turn

    @property
    def T_body_cam(self) -> Matrix4:
        """Return the constant transform from camera to body (origin on the floor below the axis).

        Float64 ``(4, 4)``.
        """
        return camera_ahead(self.camera_height)

    def parse_noise(self, level: str | DifferentialExecutionNoise | Mapping[str, Any]) -> DifferentialExecutionNoise:
        """Return the noise of a named level, of a mapping of its fields, or the noise itself."""
        return execution_noise(level)

    def respond(self, reached: np.ndarray, command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the command twice: the wheels follow it at once."""
        return command, command

    def execute(
        self, planar: PlanarPose, command: np.ndarray, noise: DifferentialExecutionNoise, rng: np.random.Generator
    ) -> PlanarPose:
        """Execute one noisy step in free space; see the module for the law.

        Args:
            planar: ``(x, y, heading)`` before the step, m and rad.
            command: ``(left, right)``, m.
            noise: standard deviations of a step.
            rng: the dynamics stream; every call draws two normals, for every command.

        Returns:
            ``(x, y, heading)`` after the step, heading in [-pi, pi).
        """
        normals = rng.standard_normal(2)
        left, right = (_rolled(float(v), float(n), noise) for v, n in zip(command, normals, strict=True))
        s, turn = 0.5 * (left + right), (right - left) / self.track
        x, y, heading = (float(v) for v in planar)
        # The chord of the arc: s sin(turn/2) / (turn/2), halfway through the turn
        chord, halfway = s * float(np.sinc(0.5 * turn / math.pi)), heading + 0.5 * turn
        return np.array([x + chord * math.cos(halfway), y + chord * math.sin(halfway), wrap_angle(heading + turn)])


def _rolled(travel: float, normal: float, noise: DifferentialExecutionNoise) -> float:
    """Return the executed travel of a wheel, m, of a commanded ``travel`` m; ``normal`` is a draw of N(0, 1)."""
    if travel == 0.0:
        return 0.0
    error = math.hypot(noise.slip * travel, noise.play) * normal
    return math.copysign(max(0.0, abs(travel) + error), travel)
