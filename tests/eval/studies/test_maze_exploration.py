"""Test the comparison of explorers of mazes: rows, their continuation, paired leads, and the page."""

import json

import numpy as np
import pytest

from vssm_gym.agents.base import Decision
from vssm_gym.agents.exploration.maze_random import MazeRandomAgent
from vssm_gym.cli.studies import mazes as commands
from vssm_gym.errors import InputError
from vssm_gym.eval.studies.maze_exploration import run as runner
from vssm_gym.eval.studies.maze_exploration.comparison import LEADER, curves, lead, picture, study
from vssm_gym.eval.studies.maze_exploration.episodes import EXPLORERS, SAMPLED_EVERY, explore
from vssm_gym.eval.studies.maze_exploration.run import EXPLORATION_ROWS, ExplorationSetting, read_exploration, run

QUICK = ExplorationSetting(("pillars-v1", "rooms-v1"), ("maze_random",), seeds=2, steps=40)


def test_a_run_is_paired_by_maze_and_seed():
    """Start and noise do not depend on the agent, and the watching map does not depend on its seed."""
    first, again = (explore(MazeRandomAgent(), "rooms-v1", 3, 40, "low", "low") for _ in range(2))
    assert first == again
    assert len(first["coverage"]) == len(first["nats"]) == 40 // SAMPLED_EVERY + 1
    assert (np.diff(first["coverage"]) >= 0.0).all() and (np.diff(first["nats"]) > 0.0).all()

    class Still(MazeRandomAgent):
        name = "still"

        def act(self, observation):
            return Decision(np.zeros(3, np.float32), None, "stands")

    still = explore(Still(), "rooms-v1", 3, 40, "low", "low")
    assert still["task"] == first["task"] and still["path_length"] == 0.0
    assert still["nats"][0] == first["nats"][0] and still["coverage"][-1] == still["coverage"][0]


def test_rows_are_kept_and_continued(tmp_path, monkeypatch):
    rows = run(QUICK, tmp_path)
    assert [(row["maze"], row["seed"]) for row in rows] == [(m, s) for s in (0, 1) for m in QUICK.mazes]
    stored = (tmp_path / EXPLORATION_ROWS).read_bytes()
    monkeypatch.setattr(runner, "explore", None)  # nothing is run again
    assert run(QUICK, tmp_path) == rows
    with pytest.raises(InputError, match="steps: expected 60, as in this study; found 40"):
        run(ExplorationSetting(QUICK.mazes, QUICK.explorers, 2, 60), tmp_path)
    (tmp_path / EXPLORATION_ROWS).write_bytes(stored + b'{"maze"')  # killed while it wrote
    assert read_exploration(tmp_path / EXPLORATION_ROWS) == rows
    (tmp_path / EXPLORATION_ROWS).write_bytes(b"[1]\n")
    with pytest.raises(InputError, match="line 1: expected a run of this study"):
        read_exploration(tmp_path / EXPLORATION_ROWS)


def made(mazes: tuple[str, ...], seeds: int, by: dict[str, float]) -> list[dict]:
    """Return rows whose coverage grows to a number of the agent, plus a little that maze and seed share."""
    rows = []
    for agent, reached in by.items():
        for k, maze in enumerate(mazes):
            for seed in range(seeds):
                curve = [round(share * (reached + 0.01 * (k + seed)), 4) for share in (0.0, 0.5, 1.0)]
                row = {"maze": maze, "seed": seed, "agent": agent, "coverage": curve}
                row |= {"nats": [1000.0 * value for value in curve], "collisions": 1, "location_error_mean": 0.004}
                rows.append(row)
    return rows


def test_leads_are_paired_and_leave_out_the_tuned_maze():
    mazes = ("pillars-v1", "rings-v1", "rooms-v1", "tree-v1")
    rows = made(mazes, 3, {LEADER: 0.8, "maze_lstm": 0.5, "maze_random": 0.2})
    found = lead(rows, "maze_lstm", mazes[1:], "coverage", 1.0)
    assert (found.mean, found.low, found.high) == pytest.approx((0.3, 0.3, 0.3), abs=1e-3)
    assert (found.tasks, found.episodes) == (3, 9)
    assert curves(rows, "maze_lstm", mazes, "coverage").shape == (12, 3)
    rows = [row | ({"coverage": [0.0, 0.0, 0.0]} if row["maze"] == "pillars-v1" else {}) for row in rows]
    outcome = study(rows, {"steps": 40})
    assert "In 3 mazes" in outcome.answer and "0.30 [0.30, 0.30]" in outcome.answer
    assert [line[0] for line in outcome.lines] == [
        "information of sampled scans",
        "ARS-LSTM, trained in pillars-v1",
        "random",
    ]
    json.dumps(outcome.figures, allow_nan=False)
    assert outcome.picture.startswith(b"<?xml")
    drawn = picture(rows, mazes, [LEADER, "maze_lstm"])
    assert [len(ax.lines) for ax in drawn.axes] == [2, 2, 2, 2, 2, 0, 0, 0]


def test_the_command_writes_a_page(tmp_path):
    commands.maze_exploration(tmp_path / "out", "rooms-v1", "maze_random", seeds=1, steps=20)
    assert {path.suffix for path in (tmp_path / "out").iterdir()} == {".json", ".jsonl", ".svg", ".html"}
    with pytest.raises(InputError):
        commands.maze_exploration(tmp_path / "out", "rooms-v1", "maze_random", seeds=1, steps=20)
    commands.maze_exploration(tmp_path / "out2", "rooms-v1", "maze_random", seeds=1, steps=20, resume=True)


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        ({"mazes": ("rooms",)}, "mazes: expected"),
        ({"explorers": ("nobody",)}, "explorers: expected"),
        ({"noise": "much"}, "noise: expected"),
        ({"seeds": 0}, "seeds: expected at least 1, not 0"),
    ],
)
def test_bad_settings_are_refused(keywords, words):
    with pytest.raises(InputError, match=words):
        ExplorationSetting(**keywords)


def test_every_explorer_is_made_for_a_maze():
    for name, make in EXPLORERS.items():
        agent = make("rooms-v1")
        assert name.startswith(agent.name) and agent.task == "explore" and not agent.needs_pose
