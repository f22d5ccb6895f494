"""Compare explorers of mazes: coverage and information against steps, and the lead of one over the others, paired.

Mazes are what differs: runs of one maze are resampled together. ``pillars-v1``, on which everything was tuned, is shown
and left out of all means.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from vssm_gym.envs.tasks.mazes import MAZES
from vssm_gym.eval.metrics.aggregate import Interval, bootstrap_mean
from vssm_gym.eval.studies.maze_exploration.episodes import EXPLORERS, SAMPLED_EVERY
from vssm_gym.eval.studies.page import Study
from vssm_gym.viz.pictures import svg

LEADER = "maze_information"
TUNED = MAZES[0]  # the maze on which everything was tuned
COLOURS = dict(zip(EXPLORERS, ("tab:blue", "tab:orange", "tab:green", "tab:olive", "tab:grey"), strict=True))
NAMES = {
    "maze_information": "information of sampled scans",
    "maze_frontier": "nearest frontier",
    "maze_lstm": "ARS-LSTM, trained in pillars-v1",
    "maze_lstm_own": "ARS-LSTM, trained in the same maze",
    "maze_random": "random",
}


def curves(rows: Sequence[dict[str, Any]], agent: str, mazes: Sequence[str], what: str) -> Float[np.ndarray, "runs n"]:
    """Return the curves ``coverage`` or ``nats`` of an agent's runs, by maze and seed."""
    chosen = [row for maze in mazes for row in rows if row["agent"] == agent and row["maze"] == maze]
    return np.array([row[what] for row in sorted(chosen, key=lambda row: (mazes.index(row["maze"]), row["seed"]))])


def lead(rows: Sequence[dict[str, Any]], other: str, mazes: Sequence[str], what: str, share: float) -> Interval:
    """Return the mean difference of :data:`LEADER` and another agent, after a share of the steps, over equal runs."""
    found = {
        agent: {(row["maze"], row["seed"]): row[what] for row in rows if row["agent"] == agent and row["maze"] in mazes}
        for agent in (LEADER, other)
    }
    keys = sorted(found[LEADER].keys() & found[other].keys())
    at = [round(share * (len(found[LEADER][key]) - 1)) for key in keys]
    return bootstrap_mean(
        [found[LEADER][key][k] - found[other][key][k] for key, k in zip(keys, at, strict=True)],
        [key[0] for key in keys],
    )


def study(rows: Sequence[dict[str, Any]], setting: dict[str, Any]) -> Study:
    """Return the outcome for a page."""
    mazes = [maze for maze in MAZES if any(row["maze"] == maze for row in rows)]
    judged = [maze for maze in mazes if maze != TUNED] or mazes
    agents = [agent for agent in EXPLORERS if any(row["agent"] == agent for row in rows)]
    lines, figures = [], {}
    for agent in agents:
        own = [row for row in rows if row["agent"] == agent and row["maze"] in judged]
        places = [row["maze"] for row in own]
        at = {
            share: [row["coverage"][round(share * (len(row["coverage"]) - 1))] for row in own] for share in (0.3, 1.0)
        }
        nats = [row["nats"][-1] / 1000.0 for row in own]
        cover = {share: bootstrap_mean(values, places) for share, values in at.items()}
        leads = {
            what: {share: lead(rows, agent, judged, what, share) for share in (0.3, 1.0)}
            for what in ("coverage", "nats")
        }
        ahead = ["", ""] if agent == LEADER else [leads["coverage"][share].text() for share in (0.3, 1.0)]
        errors = [row["location_error_mean"] for row in own if row["location_error_mean"] is not None]
        lines.append(
            [
                NAMES[agent],
                cover[0.3].text(),
                cover[1.0].text(),
                bootstrap_mean(nats, places).text(1),
                *ahead,
                f"{np.mean([row['collisions'] for row in own]):.1f}",
                f"{1000.0 * np.mean(errors):.1f}" if errors else "",
            ]
        )
        figures[agent] = {
            "coverage": {str(share): vars(interval) for share, interval in cover.items()},
            "kilonats": vars(bootstrap_mean(nats, places)),
            "by_maze": {maze: _last(rows, agent, maze) for maze in mazes},
            "lead": {}
            if agent == LEADER
            else {what: {str(share): vars(i) for share, i in found.items()} for what, found in leads.items()},
        }
    return Study(
        name="maze-exploration",
        question="Who explores a maze, by its laser scanner alone?",
        answer=_answer(rows, agents, judged),
        header=(
            "explorer",
            "tiles after 30 %",
            "tiles at the end",
            "1000 nats",
            "lead after 30 %",
            "lead at the end",
            "collisions",
            "pose, mm",
        ),
        lines=lines,
        picture=svg(picture(rows, mazes, agents)),
        setting=setting,
        figures=_plain(figures),
        notes=(
            f"Means over the mazes that nothing was tuned on ({', '.join(judged)}), with 95 % bootstrap intervals that "
            "resample whole mazes; leads are paired by maze and seed. Tiles: the share of the maze's tiles that the "
            "robot has been in. Nats: the fall of the entropy of the map of what is within 5 cm of the robot's path.",
            "The policy that was trained in the same maze knows that maze, as the published baseline did.",
        ),
    )


def picture(rows: Sequence[dict[str, Any]], mazes: Sequence[str], agents: Sequence[str]) -> Figure:
    """Draw coverage against steps in each maze, and the information over the judged ones; bands: 95 % of the mean."""
    figure = Figure(figsize=(11.0, 5.4), layout="constrained")
    axes = figure.subplots(2, 4).ravel()
    judged = [maze for maze in mazes if maze != TUNED] or list(mazes)
    panels = [(maze, [maze], "coverage", 1.0) for maze in mazes]
    panels.append((f"information, 1000 nats, {len(judged)} mazes", judged, "nats", 1e-3))
    for ax, (title, chosen, what, unit) in zip(axes, panels, strict=False):
        for agent in agents:
            found = unit * curves(rows, agent, list(chosen), what)
            if not len(found):
                continue
            steps = SAMPLED_EVERY * np.arange(found.shape[1])
            low, high = _band(found)
            ax.fill_between(steps, low, high, color=COLOURS[agent], alpha=0.2, lw=0.0)
            ax.plot(steps, found.mean(axis=0), color=COLOURS[agent], lw=1.4, label=NAMES[agent])
        tuned = " (tuned on)" if title == TUNED else ""
        ax.set_title(title + tuned, fontsize=9)
        ax.set_xlim(0, steps[-1])
        ax.set_ylim(0.0, 1.0 if what == "coverage" else None)
        ax.tick_params(labelsize=8)
        ax.grid(alpha=0.3, lw=0.5)
    for ax in axes[len(panels) :]:
        ax.axis("off")
    for ax in axes[4:]:
        ax.set_xlabel("steps", fontsize=8)
    figure.supylabel("share of tiles visited", fontsize=9)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8)
    return figure


def _band(found: Float[np.ndarray, "runs n"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the 95 % bootstrap interval of the mean of runs at each step."""
    drawn = np.random.default_rng(0).integers(len(found), size=(1000, len(found)))
    low, high = np.quantile(found[drawn].mean(axis=1), [0.025, 0.975], axis=0)
    return low, high


def _last(rows: Sequence[dict[str, Any]], agent: str, maze: str) -> dict[str, float]:
    found = curves(rows, agent, [maze], "coverage")
    return {"mean": float(found[:, -1].mean()), "std": float(found[:, -1].std())} if len(found) else {}


def _answer(rows: Sequence[dict[str, Any]], agents: Sequence[str], judged: Sequence[str]) -> str:
    if LEADER not in agents:
        return "The explorer by information did not run."
    said = [f"In {len(judged)} mazes the explorer by information visits"]
    own = curves(rows, LEADER, list(judged), "coverage")[:, -1].mean()
    said.append(f"{own:.0%} of the tiles.")
    leads = {other: lead(rows, other, judged, "coverage", 1.0).text() for other in agents if other != LEADER}
    said += [f"Its lead over {NAMES[other]}: {text}." for other, text in leads.items()]
    return " ".join(said)


def _plain(value: Any) -> Any:
    """Return figures as plain JSON values; None where there is no interval."""
    if isinstance(value, dict):
        return {name: _plain(one) for name, one in value.items()}
    if isinstance(value, float | np.floating):
        return round(float(value), 6) if np.isfinite(value) else None
    return value
