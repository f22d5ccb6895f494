"""Summarise the scores of each model and horizon as one row of the table."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vssm_gym.eval.bench.prediction.scores import Scores, band_share, histogram
from vssm_gym.eval.metrics.aggregate import bootstrap_mean

PIT_BINS = {"depth": 20, "rgb": 20, "pose": 5}  # a drive has few poses and many pixels
PIT_RANGE = (0.5, 1.5)  # of every bin over the uniform share, where a prediction counts as calibrated


def row_of(model: str, seconds: float, drives: Sequence[Sequence[Scores]]) -> dict[str, Any]:
    """Summarise the predictions of one model, some seconds ahead, as JSON values.

    Args:
        model: its name.
        seconds: ahead.
        drives: the scores of each drive.

    Returns:
        ``nats`` a pixel with its interval over drives and the ``values`` of the drives, and its parts ``depth_nats``
        and ``rgb_nats``; ``depth_crps`` (m), ``rgb_crps``, ``location_crps`` (m), ``heading_crps`` (rad),
        ``pose_nats``; ``depth_in_band`` and ``rgb_in_band``, shares inside the 95 % band; ``pit``, the histograms over
        the uniform share; ``calibrated``, whether every bin of each lies within ``PIT_RANGE``.
    """
    every = [scores for drive in drives for scores in drive]
    pixels = lambda name: np.concatenate([getattr(scores, name) for scores in every])
    mean = lambda name: float(np.mean([getattr(scores, name) for scores in every]))
    of_drive = [float(np.mean([(s.depth_nats + s.rgb_nats).mean() for s in drive])) for drive in drives]
    interval = bootstrap_mean(of_drive, range(len(of_drive)))
    bound = lambda value: float(value) if np.isfinite(value) else None
    pit = {name: histogram(pixels(f"{name}_pit"), bins) for name, bins in PIT_BINS.items()}
    return {
        "model": model,
        "seconds": seconds,
        "predictions": len(every),
        "readings": len(pixels("depth_pit")),
        "nats": {"mean": interval.mean, "low": bound(interval.low), "high": bound(interval.high), "values": of_drive},
        "depth_nats": float(pixels("depth_nats").mean()),
        "rgb_nats": float(pixels("rgb_nats").mean()),
        "depth_crps": float(pixels("depth_crps").mean()),
        "rgb_crps": float(pixels("rgb_crps").mean()),
        "depth_in_band": band_share(pixels("depth_pit")),
        "rgb_in_band": band_share(pixels("rgb_pit")),
        "pose_nats": mean("pose_nats"),
        "location_crps": mean("location_crps"),
        "heading_crps": mean("heading_crps"),
        "pit": {name: [float(share) for share in shares] for name, shares in pit.items()},
        "calibrated": {
            name: bool(PIT_RANGE[0] <= shares.min() and shares.max() <= PIT_RANGE[1]) for name, shares in pit.items()
        },
    }
