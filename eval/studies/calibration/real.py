"""Measure the rows of one recording with ground truth: as it is, and with errors of the truth estimated.

The first row has the first pose aligned, as the rows of simulated recordings. The others estimate the delay of the
truth's clock, the error of the first true pose, or both, from the same run of the filter, and state which share of the
summed NEES they explain: ``1 - sum NEES / sum NEES of the first row``.
"""

from typing import Any

import numpy as np

from vssm_gym.data.sequences import Sequence
from vssm_gym.errors import InputError
from vssm_gym.eval.studies.calibration import nuisances
from vssm_gym.eval.studies.calibration.errors import RunErrors, summarise
from vssm_gym.eval.studies.calibration.recordings import Estimates, errors_of, estimate, last_nees, parts
from vssm_gym.progress import OnProgress
from vssm_gym.slam.options import SlamOptions

SEGMENT = 4.0  # s
# Label of a row -> estimated: delay of the clock, first pose
ESTIMATED = {"clock": (True, False), "first pose": (False, True), "clock and first pose": (True, True)}


def rows_of(name: str, recording: Sequence, on_progress: OnProgress | None = None) -> dict[str, dict[str, Any]]:
    """Return label -> summary of the rows of a recording, tracked with the defaults of ``vssm-gym slam``.

    Segments have no first pose to estimate: their share is stated where the clock alone is estimated, too.

    Raises:
        InputError: no ground truth, or no two frames in a row that are tracked and have a true pose.
    """
    options = SlamOptions()
    whole = estimate(recording, options, on_progress)
    segments = [_segment(part, options, on_progress) for part in parts(recording, SEGMENT)]
    as_it_is = errors_of(whole)
    rows = {name: summarise([RunErrors(as_it_is, _ends(segments, 0.0))]) | {"about": "the first pose aligned"}}
    for label, (delay, first_pose) in ESTIMATED.items():
        fitted = nuisances.fit(whole, delay=delay, first_pose=first_pose)
        errors = errors_of(whole, fitted.delay, fitted.first_pose)
        ends = () if first_pose else _ends(segments, fitted.delay)
        rows[f"{name}, {label}"] = summarise([RunErrors(errors, ends)]) | {
            "about": _about(fitted, 1.0 - float(errors.nees.sum() / as_it_is.nees.sum()), delay, first_pose),
            "nuisances": {"delay_s": fitted.delay, "first_pose": fitted.delta.tolist()},
        }
    return rows


def _segment(part: Sequence, options: SlamOptions, on_progress: OnProgress | None) -> Estimates | None:
    """Run the filter over a segment; None where none of its images can be read."""
    try:
        return estimate(part, options, on_progress)
    except InputError:
        return None


def _ends(segments: list[Estimates | None], delay: float) -> tuple[float | None, ...]:
    return tuple(None if segment is None else last_nees(segment, delay) for segment in segments)


def _about(fitted: nuisances.Nuisances, explained: float, delay: bool, first_pose: bool) -> str:
    """Say what was estimated, and how much it explains."""
    said = [f"the truth's clock {1e3 * fitted.delay:+.1f} ms against the images'"] if delay else []
    if first_pose:
        shift, turn = (float(np.linalg.norm(part)) for part in (fitted.delta[:3], fitted.delta[3:]))
        said.append(f"the first true pose off by {1e3 * shift:.1f} mm and {np.degrees(turn):.2f} degrees")
    return f"estimated: {', '.join(said)}; explains {explained:.0%} of the summed NEES"
