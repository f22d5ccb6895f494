"""Draw the figures of a report: curves over all episodes, and single runs on the learned map."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from vssm_gym.eval.metrics import aggregate
from vssm_gym.eval.metrics.metric import Row
from vssm_gym.viz import pictures

SCORE_LEVELS = np.linspace(0.0, 1.0, 101)  # of a score, at which its profile is drawn
KEY_CHARACTERS = 150  # of a legend's line across a figure
GROUPS = ("scene", "noise", "physics", "agent")  # runs are chosen from each of these in turn
# The palette of Okabe and Ito (2008), which colour-blind readers can distinguish.
PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")


def colours(rows: Sequence[Row]) -> dict[str, str]:
    """Assign a colour to each agent, in the order in which they first appear."""
    agents = dict.fromkeys(str(row["agent"]) for row in rows)
    return {agent: PALETTE[i % len(PALETTE)] for i, agent in enumerate(agents)}


def curves(rows: Sequence[Row], seed: int) -> bytes:
    """Draw three panels as SVG: success over geodesic length, the CDF of location error, and error over path length."""
    figure = Figure(figsize=(11.5, 3.3), layout="constrained")
    success, cdf, growth = figure.subplots(1, 3)
    for (agent,), members in aggregate.group_rows(rows, ["agent"]).items():
        colour = colours(rows)[agent]
        _success_by_length(success, members, agent, colour, seed)
        _error_cdf(cdf, members, agent, colour)
        _error_growth(growth, members, agent, colour)
    farthest = 1.05 * max(row["geodesic"] for row in rows)
    success.set(xlabel="geodesic length of the task, m", ylabel="success rate", xlim=(0, farthest), ylim=(-0.04, 1.04))
    cdf.set(
        xlabel="mean location error of an episode, m", ylabel="proportion of episodes", xscale="log", ylim=(0, 1.02)
    )
    drawn = cdf.dataLim.intervalx
    if np.isfinite(drawn).all():  # some agent has an estimate
        low, high = np.log10(drawn)
        # Whole decades, which alone have numbers: those between would overlap
        cdf.set_xlim(10.0 ** np.floor(low), 10.0 ** max(np.ceil(high), np.floor(low) + 1.0))
    cdf.xaxis.set_minor_formatter(NullFormatter())
    growth.set(xlabel="true path so far, m", ylabel="median location error, m")
    for axes in (success, cdf, growth):
        axes.grid(alpha=0.3, linewidth=0.5)
        axes.spines[["top", "right"]].set_visible(False)
    figure.legend(*success.get_legend_handles_labels(), **key_of(list(colours(rows))))
    return pictures.svg(figure)


def profiles(rows: Sequence[Row], labels: Mapping[str, str], seed: int) -> bytes:
    """Draw the performance profile of each score as SVG, with pointwise 95 % intervals.

    Args:
        rows: episodes of one condition.
        labels: of the scores, by name.
        seed: of the resampling.
    """
    figure = Figure(figsize=(4.2 * len(labels), 3.3), layout="constrained")
    panels = figure.subplots(1, len(labels), sharey=True, squeeze=False)[0]
    of_agent = colours(rows)
    for axes, (name, label) in zip(panels, labels.items(), strict=True):
        for (agent,), members in aggregate.group_rows(rows, ["agent"]).items():
            found = aggregate.profile(members, name, SCORE_LEVELS, seed)
            axes.step(SCORE_LEVELS, found.value, where="post", color=of_agent[agent], label=agent)
            axes.fill_between(
                SCORE_LEVELS, found.low, found.high, step="post", color=of_agent[agent], alpha=0.15, linewidth=0
            )
        axes.set(xlabel=f"{label} (\u03c4)", xlim=(0.0, 1.0), ylim=(-0.02, 1.02))
        axes.grid(alpha=0.3, linewidth=0.5)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("proportion of episodes above \u03c4")
    figure.legend(*panels[0].get_legend_handles_labels(), **key_of(list(of_agent)))
    return pictures.svg(figure)


def key_of(names: Sequence[str]) -> dict[str, Any]:
    """Return options of a figure's legend below its panels, with as many names in a line as fit."""
    longest = max(map(len, names), default=1)
    columns = max(1, min(7, int(KEY_CHARACTERS / (min(longest, pictures.LONGEST_IN_FIGURE) + 7))))
    return {"loc": "outside lower center", "ncols": columns, "frameon": False, "fontsize": 9}


def _success_by_length(axes: Axes, rows: Sequence[Row], agent: str, colour: str, seed: int) -> None:
    """Draw success in up to five bins of equal counts, with the 95 % interval of each."""
    lengths = np.array([row["geodesic"] for row in rows])
    bins = int(np.clip(len(set(lengths)) // 8, 1, 5))
    edges = np.quantile(lengths, np.linspace(0.0, 1.0, bins + 1))
    which = np.clip(np.searchsorted(edges, lengths, side="right") - 1, 0, bins - 1)
    members = [[row for row, b in zip(rows, which, strict=True) if b == i] for i in range(bins)]
    members = [chosen for chosen in members if chosen]
    intervals = [aggregate.mean(chosen, "success", seed) for chosen in members]
    x = [float(np.mean([row["geodesic"] for row in chosen])) for chosen in members]
    y = np.array([interval.mean for interval in intervals])
    spread = np.nan_to_num([[y - i.low, i.high - y] for y, i in zip(y, intervals, strict=True)]).T
    axes.errorbar(x, y, yerr=np.maximum(spread, 0.0), marker="o", markersize=3.5, capsize=2, color=colour, label=agent)


def _error_cdf(axes: Axes, rows: Sequence[Row], agent: str, colour: str) -> None:
    errors = np.sort([row["location_error_mean"] for row in rows if row.get("location_error_mean") is not None])
    if len(errors):
        x = np.maximum(errors, 1e-3)  # an oracle's error is 0, which a logarithmic axis cannot show
        axes.step(x, np.arange(1, len(x) + 1) / len(x), where="post", color=colour, label=agent)


def _error_growth(axes: Axes, rows: Sequence[Row], agent: str, colour: str) -> None:
    """Draw the median error over path length, as far as half of the episodes drive."""
    profiles = []
    for row in rows:
        trace = row.get("trace") or {}
        true, estimate = (np.asarray(trace.get(name) or [], dtype=float) for name in ("true", "estimate"))
        if len(estimate) == len(true) > 1:
            driven = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(true, axis=0), axis=1))])
            profiles.append((driven, np.linalg.norm(true - estimate, axis=1)))
    if not profiles:
        return
    x = np.linspace(0.0, np.median([driven[-1] for driven, _ in profiles]), 30)
    errors = np.array([np.interp(x, driven, error, right=np.nan) for driven, error in profiles])
    axes.plot(x, np.nanmedian(errors, axis=0), color=colour, label=agent)


def run_picture(row: Row, background: pictures.Background | None) -> bytes:
    """Draw one episode on the learned map as WebP: true path, estimate, goal region, contacts."""
    figure = Figure(figsize=(4.2, 3.6), layout="constrained")
    axes = figure.subplots()
    pictures.draw_background(axes, background)
    pictures.draw_run(axes, row, float(row["success_radius"]))
    if background is None:
        axes.margins(0.2)
    else:
        axes.set(xlim=background.extent[:2], ylim=background.extent[2:])
    return pictures.webp(figure)


def legend(more: Sequence[Artist] = ()) -> bytes:
    """Draw the key to the pictures of runs, with ``more`` handles."""
    handles = [*pictures.legend_handles(), *more]
    figure = Figure(figsize=(1.25 * len(handles), 0.35))
    figure.legend(handles=handles, loc="center", ncols=len(handles), frameon=False, fontsize=9)
    return pictures.svg(figure)


def has_failed(row: Row) -> bool:
    """Return whether the episode failed."""
    return bool(row["failure"])


def choose_failures(
    rows: Sequence[Row], limit: int, each: int, failed: Callable[[Row], bool] = has_failed
) -> list[Row]:
    """Choose failed runs to draw; agents that fail rarely come first, because their failures tell most.

    Rows without a trace cannot be drawn. At most ``each`` runs of one agent and condition are chosen, and ``limit`` in
    all.
    """
    chosen = aggregate.group_rows(filter(failed, rows), GROUPS)
    episodes: Mapping[tuple, list] = aggregate.group_rows(rows, GROUPS)
    rarest = sorted(chosen, key=lambda group: len(chosen[group]) / len(episodes[group]))
    drawable = {group: [row for row in chosen[group] if row.get("trace")] for group in rarest}
    return [row for group in rarest for row in drawable[group][:each]][:limit]


def choose_successes(rows: Sequence[Row], limit: int) -> list[Row]:
    """Choose the longest successful tasks of each agent and condition, in turn, so that every agent is shown.

    Lengths are geodesics, or path lengths where there is no goal.
    """
    groups = aggregate.group_rows([row for row in rows if row["success"] and row.get("trace")], GROUPS)
    length = lambda row: row.get("geodesic") or row["path_length"]
    ranked = [sorted(members, key=lambda row: -length(row)) for members in groups.values()]
    turns = max((len(members) for members in ranked), default=0)
    return [members[turn] for turn in range(turns) for members in ranked if turn < len(members)][:limit]
