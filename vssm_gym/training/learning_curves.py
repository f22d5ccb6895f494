"""Draw how fast trainings learn, by wall-clock time and by steps, with intervals over seeds: ``curves RUN ...``.

    c(t) = mean over seeds of y_seed(t),   y_seed linear between the lines of progress.jsonl

Trainings of one name are one curve, whose 95 % interval resamples seeds. It is drawn where all of its seeds are known.
A line counts from the step on at which every robot has had time for one whole episode: before, only short episodes have
ended, and nearly all of those succeeded.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vssm_gym.errors import InputError
from vssm_gym.eval.metrics.aggregate import Interval, bootstrap_mean
from vssm_gym.eval.report.figures import PALETTE
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.json_file import read_json
from vssm_gym.files.output_folders import check_file
from vssm_gym.training.run import read_progress
from vssm_gym.training.train import MANIFEST, PROGRESS
from vssm_gym.viz import pictures

SUCCESS_LEVELS = (0.5, 0.9)  # success rates whose times the table shows
CURVE_POINTS = 121  # points of a curve
KINDS = (".svg", ".png")
CURVES_DPI = 150  # of the PNG
MEASURES: dict[str, str] = {"success": "success rate", "returns": "return of an episode"}
AXES: dict[str, str] = {"minutes": "minutes of training", "steps": "steps of all robots"}

Axis = Literal["minutes", "steps"]


@dataclass(frozen=True)
class Training:
    """Hold one folder of ``vssm-gym train``, with the lines that count.

    Attributes:
        folder: of the training.
        name: the configuration's.
        seed: the configuration's.
        of: what else determined it, as JSON: the configuration without the seed, and the hash of map or scene.
        minutes: at each line, not decreasing.
        steps: at each line, not decreasing.
        success: mean over the last episodes.
        returns: mean over the last episodes.
    """

    folder: Path
    name: str
    seed: int
    of: str
    minutes: Float[np.ndarray, "n"]
    steps: Float[np.ndarray, "n"]
    success: Float[np.ndarray, "n"]
    returns: Float[np.ndarray, "n"]


@dataclass(frozen=True)
class Curve:
    """Hold a mean curve; ``x`` is minutes or steps, ``low`` and ``high`` are NaN with one seed."""

    x: Float[np.ndarray, "n"]
    mean: Float[np.ndarray, "n"]
    low: Float[np.ndarray, "n"]
    high: Float[np.ndarray, "n"]


@dataclass(frozen=True)
class Speed:
    """Hold the table's row of the trainings of one name.

    Attributes:
        name: of the trainings.
        seeds: number of trainings.
        minutes: medians over seeds until success first was each of SUCCESS_LEVELS; infinite where half never were.
        steps: likewise.
        reached: number of seeds that reached each level.
        last: success at the end of the curve by minutes.
    """

    name: str
    seeds: int
    minutes: tuple[float, ...]
    steps: tuple[float, ...]
    reached: tuple[int, ...]
    last: Interval


def write_curves(folders: Sequence[Path], out: Path, seed: int = 0, minutes: float | None = None) -> list[Speed]:
    """Draw the trainings in ``folders`` to ``out`` (.svg or .png).

    Args:
        folders: of ``vssm-gym train``, finished or not.
        out: the picture.
        seed: of the resampling.
        minutes: end of that axis; None: that of the longest training.

    Raises:
        InputError: a folder that holds no training or no line that counts; trainings of one name that are not seeds
            of one configuration; a file that cannot be written.
    """
    check_file(out, KINDS)
    if minutes is not None and not (math.isfinite(minutes) and minutes > 0.0):
        raise InputError("curves", "minutes", f"more than 0; found {minutes:g}")
    groups = grouped([read_training(folder) for folder in folders])
    drawn = figure(groups, seed, minutes)
    content = pictures.svg(drawn) if out.suffix.lower() == ".svg" else pictures.png(drawn, CURVES_DPI)
    with atomic_write(out) as temporary:
        temporary.write_bytes(content)
    return [speed(name, group, seed) for name, group in groups.items()]


def read_training(folder: Path) -> Training:
    """Read the training of a folder, finished or not; raise like :func:`write_curves`."""
    manifest = folder / MANIFEST
    if not manifest.is_file():
        raise InputError(folder, "folder", f"a folder of `vssm-gym train`, which has a {MANIFEST}")
    try:
        stored = read_json(manifest)
        config, world = dict(stored["config"]), stored["world_hash"]
        name, number = str(config["name"]), int(config.pop("seed"))
        where = dict(config["environment"])
        algorithm = str(config["algorithm"]["name"])
        whole = int(where["num_envs"]) * int(where["max_episode_steps"])
    except InputError:
        raise
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(manifest, "file", "the JSON that `vssm-gym train` wrote") from error
    config["environment"] = {key: value for key, value in where.items() if key not in ("map", "scene")}
    lines = [
        line for line in read_progress(folder / PROGRESS) if line["steps"] >= whole and line["success"] is not None
    ]
    if len(lines) < 2:
        since = f"a first episode of all robots has ended ({whole:,} steps)"
        expected = f"two lines with a success rate at least, written after {since}; found {len(lines)}"
        if algorithm == "bc":
            expected = "a training that drives while it learns; cloning (bc) has no success rate until it is evaluated"
        raise InputError(folder / PROGRESS, "success", expected)
    seconds, steps, success, returns = (
        np.array([line[key] for line in lines], np.float64) for key in ("seconds", "steps", "success", "return")
    )
    of = json.dumps([config, world], sort_keys=True)
    return Training(folder, name, number, of, seconds / 60.0, steps, success, returns)


def grouped(trainings: Sequence[Training]) -> dict[str, list[Training]]:
    """Group trainings by name, in order of appearance; raise :class:`InputError` where a group is no set of seeds."""
    groups: dict[str, list[Training]] = {}
    for one in trainings:
        groups.setdefault(one.name, []).append(one)
    for group in groups.values():
        for i, one in enumerate(group):
            if one.of != group[0].of:
                expected = f"a name of its own: its configuration or its map is not that of {group[0].folder}"
                raise InputError(one.folder / MANIFEST, "name", f"{expected}; both are {one.name!r}")
            if twin := next((other for other in group[:i] if other.seed == one.seed), None):
                raise InputError(one.folder / MANIFEST, "seed", f"another than {one.seed}, that of {twin.folder}")
    if not groups:
        raise InputError("curves", "RUN", "a folder of `vssm-gym train` at least")
    return groups


def curve(group: Sequence[Training], measure: str, axis: Axis, seed: int = 0) -> Curve:
    """Compute the mean of ``measure`` over the seeds of a group, where all of them are known.

    Raises :class:`InputError` where no range is known for all.
    """
    low = max(float(getattr(one, axis)[0]) for one in group)
    high = min(float(getattr(one, axis)[-1]) for one in group)
    if not low < high:
        expected = f"seeds that are known over the same {axis}; all of them from {low:g} on, but one ends at {high:g}"
        raise InputError("curves", group[0].name, expected)
    x = (np.linspace if axis == "minutes" else np.geomspace)(low, high, CURVE_POINTS)
    each = np.array([np.interp(x, getattr(one, axis), getattr(one, measure)) for one in group])
    seeds = [one.seed for one in group]
    found = [bootstrap_mean(values.tolist(), seeds, seed) for values in each.T]
    return Curve(x, *(np.array([getattr(one, name) for one in found]) for name in ("mean", "low", "high")))


def speed(name: str, group: Sequence[Training], seed: int = 0) -> Speed:
    """Summarise how fast the trainings of a group learned."""
    times = np.array([[time_to(one, level) for level in SUCCESS_LEVELS] for one in group])  # (seeds, levels, 2)
    middle = np.median(times, axis=0)
    end = min(float(one.minutes[-1]) for one in group)
    last = [float(np.interp(end, one.minutes, one.success)) for one in group]
    return Speed(
        name,
        len(group),
        tuple(middle[:, 0].tolist()),
        tuple(middle[:, 1].tolist()),
        tuple(np.isfinite(times[..., 0]).sum(axis=0).tolist()),
        bootstrap_mean(last, [one.seed for one in group], seed),
    )


def time_to(training: Training, level: float) -> tuple[float, float]:
    """Return minutes and steps until success first was ``level``, linear between lines; infinite where it never was."""
    there = np.flatnonzero(training.success >= level)
    if len(there) == 0:
        return math.inf, math.inf
    i = int(there[0])
    if i == 0:
        return float(training.minutes[0]), float(training.steps[0])
    before, now = training.success[i - 1 : i + 1]
    part = (level - before) / (now - before)
    minutes, steps = (float(a[i - 1] + part * (a[i] - a[i - 1])) for a in (training.minutes, training.steps))
    return minutes, steps


def figure(groups: Mapping[str, Sequence[Training]], seed: int = 0, minutes: float | None = None) -> Figure:
    """Draw success above return, over minutes on the left and over steps (logarithmic) on the right."""
    drawn = Figure(figsize=(11.5, 6.4), layout="constrained")
    panels = drawn.subplots(2, 2, sharex="col", sharey="row")
    for line, (measure, label) in zip(panels, MEASURES.items(), strict=True):
        for axes, axis in zip(line, AXES, strict=True):
            for number, (name, group) in enumerate(groups.items()):
                seeds = f"{len(group)} seeds" if len(group) > 1 else "1 seed"
                found = curve(group, measure, axis, seed)  # type: ignore[arg-type]
                _draw(axes, found, PALETTE[number % len(PALETTE)], f"{name} ({seeds})")
            axes.grid(alpha=0.3, linewidth=0.5)
            axes.spines[["top", "right"]].set_visible(False)
        line[0].set_ylabel(label)
    for axes, label in zip(panels[1], AXES.values(), strict=True):
        axes.set_xlabel(label)
    panels[1, 1].set_xscale("log")
    panels[1, 0].set_xlim(0.0, minutes)
    panels[0, 0].set_ylim(-0.03, 1.03)
    for axes in panels[0]:
        for level in SUCCESS_LEVELS:
            axes.axhline(level, color="0.4", linewidth=0.6, linestyle=pictures.DASHES, zorder=1)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    drawn.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return drawn


def _draw(axes: Axes, found: Curve, colour: str, label: str) -> None:
    axes.plot(found.x, found.mean, color=colour, linewidth=1.6, label=label)
    if np.isfinite(found.low).all():
        axes.fill_between(found.x, found.low, found.high, color=colour, alpha=0.18, linewidth=0)
