"""Give plain integration the noise that it needs to state a distribution: the transition ``euler``.

    z' = perturb(f(z, u), A e),    e ~ N(0, (g s)^2)

``f`` integrates the readings of an IMU, or the commands, as they are; ``s`` is the root mean square of its errors of
one step in body axes. Errors of integration are no white noise: a bias adds up. So ``g`` is chosen as for learned
transitions, as the factor with which the envelopes of whole windows hold 95 % of what is fitted to.
"""

from typing import NamedTuple

import jax

from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.calibrated import CalibratedDrive, CalibratedImu
from vssm_gym.model.transition.learned import LearnedTransition, untrained
from vssm_gym.training.dynamics.calibration import GAINS, calibrate
from vssm_gym.training.dynamics.windows import Windows, measure_scales

# Coordinates of the noise in body axes: m, rad, m/s, rad/s
COORDINATES = {3: ("x", "y", "turn"), 12: ("x", "y", "z", "rx", "ry", "rz", "vx", "vy", "vz", "wx", "wy", "wz")}


class Euler(NamedTuple):
    """Hold plain integration with its noise.

    Attributes:
        transition: that corrects nothing, and whose noise is the same in every state.
        stds: ``s`` by coordinate: of the pose (m, rad) and of velocities (m/s, rad/s), body axes.
        gain: ``g``.
        at_bound: whether no larger factor was tried, so that envelopes may hold less than they should.
    """

    transition: LearnedTransition
    stds: dict[str, float]
    gain: float
    at_bound: bool


def plain(transition: LearnedTransition) -> Transition:
    """Return the nominal step of a learned transition without its fitted constants."""
    nominal = transition.nominal
    if isinstance(nominal, CalibratedImu):
        return nominal.imu
    return nominal.drive if isinstance(nominal, CalibratedDrive) else nominal


def fit_euler(learned: LearnedTransition, data: Windows, dt: float, noise: tuple[float, float]) -> Euler:
    """Fit the noise of plain integration to windows that are not judged.

    Args:
        learned: whose nominal step is integrated, without its constants.
        data: windows.
        dt: length of a step, s.
        noise: standard deviations of measured positions (m) and rotations (rad).
    """
    nominal = plain(learned)
    scales = measure_scales(nominal, data, dt)
    # A network that corrects nothing has the spread of its units; it need not be large.
    fixed = untrained(jax.random.key(0), nominal, scales, 1, learned.further, width=2, depth=1)
    [calibrated], gain = calibrate([fixed], [data], dt, noise)
    stds = {name: float(std) for name, std in zip(COORDINATES[len(scales.errors)], scales.errors, strict=True)}
    return Euler(calibrated, stds, gain, gain >= float(GAINS[-1]))
