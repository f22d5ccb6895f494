"""Execute commands as a robot does that drifts: its errors have a mean, and grow with the motion that is commanded.

``noise="locobot"`` is the execution noise of Habitat's LoCoBot. Its parameters are those that habitat-sim samples for
PyRobot's proportional controller (``habitat_sim/agent/controls/pyrobot_noisy_controls.py``; Murali et al., "PyRobot: An
Open-source Robotics Framework for Research and Benchmarking", 2019).

What the published numbers mean. ``_TruncatedMultivariateGaussian(mean, cov)`` samples with ``stdev = sqrt(cov)``, so
that habitat-sim uses the second row as *variances*: (0.007, 0.023) m^2 of a forward step are 8.4 and 15.2 cm. PyRobot's
benchmark seems to report *standard deviations* of these values: the first version of habitat-sim's file calls the pair
``_MeanStdev`` and holds 0.43 and 0.25 degrees where later ones hold 0.008 and 0.004 rad; a variance would not convert
in proportion. This preset is what the simulator does, because results on Habitat rest on it, with the factor 0.5 on
every draw (``NOISE_MULTIPLIER``) with which the Habitat Challenges of 2020 and 2021 evaluate.

Signs. Means do not average out: a forward step slides to the right and turns to the left; a turn overshoots, in
either direction, and slides forward and to the right.

Step. habitat-sim adds the same noise whatever the amount of an action. The challenges' actions are 0.25 m and 30
degrees; here the published moments belong to these, and those of a shorter command are in proportion to it.
"""

import math
from dataclasses import dataclass, fields

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.geometry.axes import PlanarPose
from vssm_gym.geometry.transforms import wrap_angle

Errors = tuple[float, float, float]
"""Of a motion: along the direction of travel (m), to its left (m), and of the heading (rad)."""


@dataclass(frozen=True)
class BiasedExecutionNoise:
    """Hold mean and standard deviation of the errors of a reference drive and of a reference turn.

    Errors of a command add up: two commands of half the length have together the mean and the variance of one.
    """

    drive_mean: Errors  # of ``drive_length``; the heading's is positive to the left
    drive_std: Errors
    turn_mean: Errors  # of ``turn_angle``, along and left of the heading; the heading's is positive where it overshoots
    turn_std: Errors
    drive_length: float = 0.25  # m
    turn_angle: float = math.radians(30.0)  # rad

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(field.default, float):
                if not (math.isfinite(value) and value > 0.0):
                    raise InputError("BiasedExecutionNoise", field.name, f"a finite number > 0, not {value!r}")
                continue
            least = 0.0 if field.name.endswith("std") else -math.inf
            if len(value) != 3 or not all(math.isfinite(one) and one >= least for one in value):
                expected = f"three finite numbers{' >= 0' if least == 0.0 else ''}; found {value!r:.80}"
                raise InputError("BiasedExecutionNoise", field.name, expected)

    def execute(self, planar: PlanarPose, command: np.ndarray, rng: np.random.Generator) -> PlanarPose:
        """Execute one noisy step in free space, with ``o`` in the body frame.

            heading' = heading + sign(turn) max(0, |turn| + e_t) + e_r
            xy'      = xy + R(phi) [max(0, s + e_a), e_c],    phi = heading + o     where s > 0
            xy'      = xy + R(heading) [e_a, e_c]                                   where s = 0

        With ``d = s / drive_length`` and ``r = |turn| / turn_angle``, independent,

            e_a, e_c ~ N(d mean_drive + r mean_turn, d std_drive^2 + r std_turn^2)      along, to the left
            e_r ~ N(d mean_drive, d std_drive^2),   e_t ~ N(r mean_turn, r std_turn^2)  of the heading

        A robot that is commanded to rest rests, and no error reverses the commanded motion: habitat-sim cuts its errors
        where 5 % of the action remain, and at three standard deviations; here the motion stops at 0. The law is the
        NumPy twin of :meth:`vssm_gym.model.transition.biased_noise.BiasedNoise.executed` in JAX; a test holds them
        together.

        Args:
            planar: ``(x, y, heading)`` before the step, m and rad.
            command: ``(turn, o, s)``, rad, rad, m.
            rng: the dynamics stream; every call draws four normals, for every command.

        Returns:
            ``(x, y, heading)`` after the step, heading in [-pi, pi).
        """
        x, y, heading = (float(v) for v in planar)
        turn, offset, step = (float(v) for v in command)
        mean, std = self._errors(step / self.drive_length, abs(turn) / self.turn_angle)
        e_a, e_c, e_r, e_t = (float(v) for v in mean + std * rng.standard_normal(4))
        turned = math.copysign(max(0.0, abs(turn) + e_t), turn) if turn != 0.0 else 0.0
        along, phi = (max(0.0, step + e_a), heading + offset) if step > 0.0 else (e_a, heading)
        c, s = math.cos(phi), math.sin(phi)
        result = np.array([x + c * along - s * e_c, y + s * along + c * e_c, heading + turned + e_r])
        result[2] = wrap_angle(result[2])
        return result

    def _errors(self, d: float, r: float) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard deviation of ``(e_a, e_c, e_r, e_t)``, ``d`` drives and ``r`` turns long."""
        (a, c, h), (a_turn, c_turn, h_turn) = self.drive_mean, self.turn_mean
        mean = np.array([d * a + r * a_turn, d * c + r * c_turn, d * h, r * h_turn])
        (a, c, h), (a_turn, c_turn, h_turn) = np.square(self.drive_std), np.square(self.turn_std)
        return mean, np.sqrt([d * a + r * a_turn, d * c + r * c_turn, d * h, r * h_turn])

    def deviations(self, longest: float) -> tuple[float, float]:
        """Return root mean squares of (direction rad, distance m) of a step of ``longest`` m about its command.

        Planners keep clear of them.
        """
        mean, std = self._errors(longest / self.drive_length, 0.0)
        along, across = (math.hypot(mean[i], std[i]) for i in range(2))
        return math.atan2(across, longest), along


def _sampled(drive: tuple[Errors, Errors], turn: tuple[Errors, Errors], multiplier: float) -> BiasedExecutionNoise:
    """Return the noise of means and variances of (forward, right, counter-clockwise), as habitat-sim holds them."""

    def errors(mean: Errors, variance: Errors) -> tuple[Errors, Errors]:
        ahead, right, turned = (multiplier * v for v in mean)
        std_a, std_c, std_h = (multiplier * math.sqrt(v) for v in variance)
        return (ahead, -right, turned), (std_a, std_c, std_h)

    return BiasedExecutionNoise(*errors(*drive), *errors(*turn))


BIASED_LEVELS: dict[str, BiasedExecutionNoise] = {
    "locobot": _sampled(
        drive=((0.017, 0.042, 0.031), (0.007, 0.023, 0.026)),
        turn=((0.001, 0.005, 0.043), (0.001, 0.004, 0.017)),
        multiplier=0.5,
    )
}
