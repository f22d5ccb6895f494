"""Summarise what each model predicted as rows of a table, and the differences between the models."""

from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np

from vssm_gym.eval.bench.prediction.ahead.judged import STEPS_AHEAD, Judged
from vssm_gym.eval.bench.prediction.ahead.states import Foreseen
from vssm_gym.eval.bench.prediction.scores import ImageScores, band_share
from vssm_gym.eval.metrics.aggregate import bootstrap_mean

Seen = list[list[ImageScores | None]]  # scores of images by window and step; None where there is none


def interval(values: Sequence[float], clusters: Sequence[Hashable]) -> dict[str, float | None]:
    """Return ``mean``, ``low`` and ``high`` of the 95 % interval over clusters; None where there are fewer than two."""
    found = bootstrap_mean(values, clusters)
    bound = lambda value: float(value) if np.isfinite(value) else None
    return {name: bound(getattr(found, name)) for name in ("mean", "low", "high")}


def rows_of(model: str, judged: Judged, foreseen: Foreseen, seen: Seen | None) -> list[dict[str, Any]]:
    """Summarise one model, a row for each of ``STEPS_AHEAD``, as JSON values.

    Args:
        model: its name.
        judged: the windows.
        foreseen: their states.
        seen: scores of their images; None where there are none.

    Returns:
        ``position`` (m) and ``rotation`` (rad), RMSE; ``pose_nats``, the log density of the pose with its interval;
        ``position_held`` and ``pose_held``, shares inside envelopes of 95 %; ``image``, None or the scores of images.
    """
    rows = []
    for place, steps in enumerate(STEPS_AHEAD):
        at, held = steps - 1, foreseen.held[:, :, steps - 1].mean(axis=0)
        rows.append(
            {
                "model": model,
                "steps": steps,
                "seconds": round(steps * judged.dt, 6),
                "windows": len(judged.data),
                "position": float(foreseen.position[at]),
                "rotation": float(foreseen.rotation[at]),
                "pose_nats": interval(foreseen.log_prob[:, at].tolist(), judged.stretches),
                "position_held": float(held[0]),
                "pose_held": float(held[1]),
                "image": None if seen is None else _of_images(judged, [of_one[place] for of_one in seen]),
            }
        )
    return rows


def _of_images(judged: Judged, every: Sequence[ImageScores | None]) -> dict[str, Any] | None:
    """Return the scores of one model's images after some steps: those of all pixels together."""
    some = [(scores, part) for scores, part in zip(every, judged.stretches, strict=True) if scores is not None]
    if not some:
        return None
    pixels = lambda name: np.concatenate([getattr(scores, name) for scores, _ in some])
    nats = [float((scores.depth_nats + scores.rgb_nats).mean()) for scores, _ in some]
    readings = len(pixels("depth_crps"))
    return {
        "images": len(some),
        "readings": readings,
        "nats": interval(nats, [part for _, part in some]) | {"values": nats},
        "depth_nats": float(pixels("depth_nats").mean()),
        "rgb_nats": float(pixels("rgb_nats").mean()),
        "depth_crps": float(pixels("depth_crps").mean()) if readings else None,
        "rgb_crps": float(pixels("rgb_crps").mean()) if readings else None,
        "depth_in_band": band_share(pixels("depth_pit")) if readings else None,
    }


def gains_of(judged: Judged, foreseen: dict[str, Foreseen], rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Compare ``learned`` with ``euler`` on the same windows, as JSON values.

    Args:
        judged: the windows.
        foreseen: their states by model.
        rows: of both models.

    Returns:
        For each of ``STEPS_AHEAD``: ``nearer``, the ratio of the position errors (None where there is no error);
        ``pose_nats`` and ``image_nats``, learned minus euler with the interval over stretches of the log.
    """
    gains = []
    for steps in STEPS_AHEAD:
        euler, learned = (
            next(row for row in rows if (row["model"], row["steps"]) == (name, steps)) for name in ("euler", "learned")
        )
        difference = foreseen["learned"].log_prob[:, steps - 1] - foreseen["euler"].log_prob[:, steps - 1]
        image = None
        if euler["image"] and euler["image"]["images"] == len(judged.stretches):
            values = np.subtract(*(row["image"]["nats"]["values"] for row in (learned, euler)))
            image = interval(values.tolist(), judged.stretches)
        gains.append(
            {
                "steps": steps,
                "nearer": euler["position"] / learned["position"] if learned["position"] > 0.0 else None,
                "pose_nats": interval(difference.tolist(), judged.stretches),
                "image_nats": image,
            }
        )
    return gains
