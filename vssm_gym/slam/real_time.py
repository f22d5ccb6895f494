"""Measure whether SLAM keeps up with the camera.

    factor = n T / sum_t (wait_t + step_t),   within_period = |{t: step_t <= T}| / n

over the ``n`` frames whose step compiled nothing; ``T`` is the median time between two processed frames. With a factor
of 1 or more the filter is as fast as the camera on average; the share says how often a single frame would be late.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vssm_gym.slam.run import TrackedFrame


def real_time(frames: Sequence[TrackedFrame]) -> dict[str, Any] | None:
    """Return the real-time factor of a run and the share of frames processed within the camera's period.

    Returns:
        ``period_s``, ``factor``, ``within_period``, ``frames`` (their number), and ``factor_with_compiling``, which is
        over all frames after the first; None where fewer than two frames were processed, or all of them compiled.
    """
    warm = [frame for frame in frames if frame.warm]
    if len(frames) < 2 or not warm:
        return None
    period = float(np.median(np.diff([frame.time for frame in frames])))
    spent = [frame.wait_s + frame.step_s for frame in warm]
    everything = sum(frame.wait_s + frame.step_s for frame in frames[1:])
    return {
        "period_s": period,
        "factor": len(warm) * period / sum(spent),
        "within_period": float(np.mean([frame.step_s <= period for frame in warm])),
        "frames": len(warm),
        "factor_with_compiling": (frames[-1].time - frames[0].time) / everything,
    }
