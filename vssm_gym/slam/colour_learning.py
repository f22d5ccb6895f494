"""Learn the calibration of a colour camera apart from the depth camera, with the trajectory.

The filter runs with the stated calibration. The smoother then finds the poses and the calibration that make all images
agree, and the filter runs again on colours that are registered by it, until nothing changes.
"""

import time
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from vssm_gym.data.intrinsics import ColourCalibration
from vssm_gym.data.sequences import Sequence
from vssm_gym.errors import InputError
from vssm_gym.inference.smoothing.gauss_newton import ColourPrior
from vssm_gym.inference.smoothing.views import stack_apart
from vssm_gym.progress import OnProgress
from vssm_gym.slam.options import SlamOptions
from vssm_gym.slam.refinement import FEWEST_NODES, nodes_of, smooth_nodes
from vssm_gym.slam.run import SlamRun, run_slam

MOST_ROUNDS = 6  # runs of the filter after the first one
SETTLED = 0.5  # standard deviations: a smaller change of all parameters ends the rounds
UNTOLD = 0.5  # of the prior's standard deviation: what stays above it, the recording does not tell


class Parameter(NamedTuple):
    """Hold one number of the calibration as people read it."""

    name: str
    unit: str
    stated: float
    learned: float
    std: float
    told: bool  # whether the recording says more about it than the prior


@dataclass(frozen=True)
class LearnedColour:
    """Hold the outcome.

    Attributes:
        stated: calibration of the recording, the prior.
        learned: mean and standard deviations of the posterior, at the recorded size.
        rounds: times that the calibration was learned.
        settled: whether the last time changed nothing.
        seconds: that it took, the filter's runs included.
    """

    stated: ColourCalibration
    learned: ColourCalibration
    rounds: int
    settled: bool
    seconds: float

    @property
    def parameters(self) -> list[Parameter]:
        """Return the numbers in millimetres, degrees and pixels, poses being ``T_depth_colour``."""
        before, after = _readable(self.stated), _readable(self.learned)
        K = self.learned.view.camera.K
        scale = np.array([1e3] * 3 + [np.degrees(1.0)] * 3 + [K[0, 0], K[1, 1]] * 2)
        told = self.learned.std < UNTOLD * self.stated.std
        names = [f"{kind} {axis}" for kind in ("translation", "rotation") for axis in "xyz"] + ["fx", "fy", "cx", "cy"]
        units = ["mm"] * 3 + ["deg"] * 3 + ["px"] * 4
        rows = zip(names, units, before, after, scale * self.learned.std, told, strict=True)
        return [Parameter(n, u, float(a), float(b), float(s), bool(t)) for n, u, a, b, s, t in rows]


def learn_colour(
    run: SlamRun, sequence: Sequence, options: SlamOptions, on_progress: OnProgress | None = None
) -> tuple[SlamRun, Sequence, LearnedColour]:
    """Learn the calibration, and run the filter again with it.

    Args:
        run: of PRISM, with the stated calibration.
        sequence: the recording.
        options: of the run.
        on_progress: called as those of the filter and the smoother.

    Returns:
        The last run, the sequence with the calibration that it used, and what was learned.

    Raises:
        InputError: colour that is registered to depth, or too few accepted frames.
    """
    began, stated = time.perf_counter(), sequence.colour
    if stated is None:
        raise registered(sequence)
    learned, rounds, settled = stated, 0, False
    for rounds in range(1, MOST_ROUNDS + 1):
        found = _learned(run, stated, options, on_progress)
        change = np.abs(learned.view.difference(found.view)) / found.std
        settled = bool(rounds > 1 and change.max() < SETTLED)
        if settled:
            break
        learned = found
        sequence = replace(sequence, colour=found)
        run = run_slam(sequence, options, None, on_progress)
    return run, sequence, LearnedColour(stated, learned, rounds, settled, time.perf_counter() - began)


def registered(sequence: Sequence) -> InputError:
    """Return the error for a recording that has no colour camera of its own."""
    expected = "a recording with the field colour in camera.json: here colour is registered to depth already"
    return InputError(sequence.root, "learn-camera", expected)


def _learned(
    run: SlamRun, stated: ColourCalibration, options: SlamOptions, on_progress: OnProgress | None
) -> ColourCalibration:
    """Return the posterior, from a run with any calibration."""
    reader, nodes = run.reader, nodes_of(run)
    if len(nodes) < FEWEST_NODES or reader.colour is None:
        raise InputError(reader.sequence.root, "learn-camera", f"{FEWEST_NODES} frames or more that are not lost")
    progress = on_progress or (lambda stage, done, total: None)
    images = []
    for done, i in enumerate(nodes, 1):
        images.append(reader.unregistered(run.frames[i].index))
        progress("reading", done, len(nodes))
    align, small = options.tracking.align, reader.colour.camera
    views = stack_apart(images, reader.camera, reader.colour, (align.geo_sigma, align.geo_sigma_quadratic))
    prior = ColourPrior(stated.view.resized(small.width, small.height), stated.std)
    found = smooth_nodes(run, options, nodes, views, progress, prior)
    assert found.colour is not None and found.colour_covariance is not None
    recorded = stated.view.camera
    view = found.colour.resized(recorded.width, recorded.height)
    return ColourCalibration(view, stated.distortion, np.sqrt(np.diag(found.colour_covariance)))


def _readable(calibration: ColourCalibration) -> Float[np.ndarray, "10"]:
    """Return translation (mm), rotation vector (deg), focal lengths and principal point (pixels)."""
    T, K = np.asarray(calibration.view.T_depth_colour), calibration.view.camera.K
    turn = np.degrees(Rotation.from_matrix(T[:3, :3]).as_rotvec())
    return np.array([*1e3 * T[:3, 3], *turn, K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
