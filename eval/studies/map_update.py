"""Compare the closed-form map update with gradient descent at the same poses (PRISM, fig. 6).

Every map starts with the closed-form update of the first frame, because an empty map renders nothing. Then each method
takes the frames in order: one closed-form update a frame, or k steps of gradient descent through the renderer, each on
newly drawn pixels. Every tenth frame is held out for evaluation. Gradient descent is run with three learning rates, and
the one of highest held-out log-likelihood counts, so that its figures are those of a tuned method.
"""

import time
from dataclasses import asdict
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from vssm_gym.data.sequences import FrameReader, Sequence
from vssm_gym.errors import InputError
from vssm_gym.eval.studies.page import Study
from vssm_gym.inference.mapping import map_learning
from vssm_gym.inference.mapping.map_learning import MapLearningConfig
from vssm_gym.inference.mapping.map_update import MapUpdateConfig, update
from vssm_gym.inference.mapping.views import Views, fit_scales, held_out
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.progress import OnProgress
from vssm_gym.slam.map_building import grid_bounds
from vssm_gym.viz import pictures

DESCENT_STEPS = (1, 4, 16, 64)  # of gradient descent a frame
FACTORS = (1.0, 0.2, 0.04)  # on the rates of gradient descent; the best counts
HELD_OUT = 10  # one frame in so many is held out
# On-line rates: a cell has few steps to move from the prior to its value, a truncation band away.
GRADIENT = MapLearningConfig(images=1, pixels=1024, occupancy_rate=0.02, colour_rate=0.1)


def run(
    sequence: Sequence, *, size: tuple[int, int], frames: int, voxel: float, on_progress: OnProgress | None = None
) -> Study:
    """Run both methods over up to ``frames`` frames, spread over the sequence.

    Args:
        sequence: with ground-truth poses.
        size: width and height that images are resized to.
        frames: largest number of frames, held-out ones included.
        voxel: cell size, m.
        on_progress: called after every frame of every arm.

    Raises:
        InputError: no ground truth, or fewer than 20 frames.
    """
    reader, poses = FrameReader(sequence, size), sequence.true_poses()
    count = min(frames, len(reader))
    if count < 2 * HELD_OUT:
        raise InputError(sequence.root, "frames", f"at least {2 * HELD_OUT}, found {count}")
    used = np.unique(np.linspace(0, len(reader) - 1, count).astype(int))
    test = used[HELD_OUT // 2 :: HELD_OUT]
    train = np.setdiff1d(used, test)
    views = {name: _views(reader, poses, chosen) for name, chosen in (("train", train), ("test", test))}
    low, high = grid_bounds(reader, poses, reader.camera, MapUpdateConfig(), sequence.root)
    nx, ny, nz = (int(n) for n in np.ceil((high - low) / voxel) + 1)
    prior = VoxelMap.prior(low, voxel, (nx, ny, nz))
    arms: dict[str, dict[str, Any]] = {}
    names = {"closed form": 0} | {f"{k} steps": k for k in DESCENT_STEPS}
    for name, k in names.items():
        tried = []
        for factor in FACTORS if k else (0.0,):
            shown = f"{name}, rates x {factor:g}" if k else name
            seconds, m = (
                _descend(prior, views["train"], k, factor, shown, on_progress)
                if k
                else _closed_form(prior, views["train"], shown, on_progress)
            )
            evaluated = held_out(m, views["test"], fit_scales(m, views["train"]))
            timed = {"ms_a_frame": 1e3 * float(np.median(seconds)), "steps": k, "rate_factor": factor}
            tried.append(timed | evaluated._asdict())
        arms[name] = max(tried, key=lambda arm: arm["log_likelihood"])
    setting = {
        "sequence": sequence.root.resolve().name,
        "size": "x".join(map(str, size)),
        "voxel": voxel,
        "cells": list(prior.shape),
        "train_frames": len(train),
        "held_out_frames": len(test),
        "gradient": asdict(GRADIENT),
        "rate_factors": FACTORS,
    }
    return Study(
        name="map-update",
        question="Closed-form map update or gradient descent?",
        answer=_answer(arms),
        header=("map update", "ms a frame", *LABELS.values()),
        lines=[[name, f"{arm['ms_a_frame']:.1f}", *(_text(n, arm[n]) for n in LABELS)] for name, arm in arms.items()],
        picture=_picture(arms),
        setting=setting,
        figures=arms,
        notes=(
            "Same frames, same true poses; every map starts with the closed-form update of the first frame. Errors and "
            "log-likelihood are means over the held-out pixels where the map has an observed surface; their "
            "proportion is the last column. Each map has the emission scales that fit it best on the training images.",
            "Milliseconds are the median wall-clock time of a frame's update, the empty-space index included. A step "
            f"of gradient descent draws {GRADIENT.pixels} pixels of the frame and changes only their cells. Its rate "
            "is the best one on the held-out frames themselves, which favours it.",
        ),
    )


LABELS = {
    "depth_l1": "depth L1, mm",
    "depth_median": "depth median, mm",
    "colour_l1": "colour L1",
    "log_likelihood": "log p a pixel",
    "hit_share": "pixels with a surface",
}


def _text(name: str, value: float) -> str:
    match name:
        case "depth_l1" | "depth_median":
            return f"{1e3 * value:.1f}"
        case "hit_share":
            return f"{value:.1%}"
        case _:
            return f"{value:.3f}"


def _views(reader: FrameReader, poses: np.ndarray, chosen: np.ndarray) -> Views:
    return Views.stack([reader[int(i)] for i in chosen], poses[chosen], reader.camera)


def _fuse(m: VoxelMap, views: Views, i: int) -> VoxelMap:
    rgb = views.rgb[i].astype(jnp.float32) / 255.0
    return jax.block_until_ready(update(m, views.depth[i], rgb, views.T_world_cam[i], views.camera, MapUpdateConfig()))


def _closed_form(
    prior: VoxelMap, views: Views, name: str, on_progress: OnProgress | None
) -> tuple[list[float], VoxelMap]:
    """Update once a frame; the first frames, which compile or see an empty map, are not timed."""
    m, seconds = jax.tree.map(jnp.copy, prior), []
    for i in range(len(views)):
        began = time.perf_counter()
        m = _fuse(m, views, i)
        seconds.append(time.perf_counter() - began)
        if on_progress:
            on_progress(name, i + 1, len(views))
    return seconds[2:], m


def _descend(
    prior: VoxelMap, views: Views, steps: int, factor: float, name: str, on_progress: OnProgress | None
) -> tuple[list[float], VoxelMap]:
    """Descend ``steps`` steps on each frame; observed cells are those of the closed form, for an equal evaluation."""
    observed = _closed_form(prior, views, name, None)[1]
    m = _fuse(jax.tree.map(jnp.copy, prior), views, 0)
    state, seconds, key = map_learning.init(m), [], jax.random.key(0)
    for i in range(len(views)):
        began = time.perf_counter()
        frame = views[i : i + 1]
        for j in range(steps):
            state, _ = map_learning.step(state, frame, GRADIENT, jax.random.fold_in(key, i * steps + j), factor)
        state = jax.block_until_ready(map_learning.refresh(state))
        seconds.append(time.perf_counter() - began)
        if on_progress:
            on_progress(name, i + 1, len(views))
    counts = (observed.occupancy_precision, observed.colour_precision)
    return seconds[2:], eqx.tree_at(lambda m: (m.occupancy_precision, m.colour_precision), state.map, counts)


def _answer(arms: dict[str, dict[str, Any]]) -> str:
    """Compare by log p, which includes depth and colour, and state the depth error too, since the two may disagree."""
    closed = arms["closed form"]
    descents = [arm for arm in arms.values() if arm["steps"]]
    equal = [arm for arm in descents if arm["log_likelihood"] >= closed["log_likelihood"]]
    arm = min(equal, key=lambda a: a["ms_a_frame"]) if equal else max(descents, key=lambda a: a["log_likelihood"])
    verdict = "is as good" if equal else "stays below; it is best"
    return (
        f"By the log-likelihood of held-out pixels: closed form {closed['log_likelihood']:.2f} nats a pixel in "
        f"{closed['ms_a_frame']:.1f} ms a frame. Gradient descent {verdict} with {arm['steps']} steps a frame: "
        f"{arm['log_likelihood']:.2f} nats in {arm['ms_a_frame']:.0f} ms, "
        f"{arm['ms_a_frame'] / closed['ms_a_frame']:.1f} times as long. Depth L1 is {1e3 * closed['depth_l1']:.1f} mm "
        f"on {closed['hit_share']:.1%} of the pixels (closed form) and {1e3 * arm['depth_l1']:.1f} mm on "
        f"{arm['hit_share']:.1%}."
    )


def _picture(arms: dict[str, dict[str, Any]]) -> bytes:
    """Draw held-out depth error and log-likelihood over the time of a frame's update, as SVG."""
    figure = Figure(figsize=(9.6, 3.6), layout="constrained")
    for axes, (name, scale) in zip(figure.subplots(1, 2), (("depth_l1", 1e3), ("log_likelihood", 1.0)), strict=True):
        descents = [arm for arm in arms.values() if arm["steps"]]
        x, y = ([arm[n] * s for arm in descents] for n, s in (("ms_a_frame", 1.0), (name, scale)))
        axes.plot(x, y, "o-", color=pictures.ESTIMATE_COLOUR, label="gradient descent")
        for arm, a, b in zip(descents, x, y, strict=True):
            axes.annotate(f"{arm['steps']}", (a, b), textcoords="offset points", xytext=(5, 5), fontsize=8)
        closed = arms["closed form"]
        axes.plot(closed["ms_a_frame"], closed[name] * scale, "*", markersize=13, color=pictures.TRUE_COLOUR)
        axes.annotate("closed form", (closed["ms_a_frame"], closed[name] * scale), xytext=(8, -4),
                      textcoords="offset points", fontsize=9)  # fmt: skip
        axes.set(xscale="log", xlabel="ms a frame", ylabel=f"held out: {LABELS[name]}")
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    return pictures.svg(figure)
