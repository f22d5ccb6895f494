"""Test the study of SLAM in mazes: rows, a run that goes on, the table's statistics, and what is refused."""

import json

import pytest

from vssm_gym.cli.studies.mazes import maze_slam
from vssm_gym.data.traversals import errors, traverse
from vssm_gym.envs.tasks.mazes import load_maze
from vssm_gym.errors import InputError
from vssm_gym.eval.studies.maze_slam.comparison import study
from vssm_gym.eval.studies.maze_slam.methods import METHODS
from vssm_gym.eval.studies.maze_slam.run import MAZE_SLAM_ROWS, MazeSlamRow
from vssm_gym.eval.studies.row_file import read_rows

SMALL = {"mazes": "rooms-v1", "traversals": 1, "seeds": 1, "steps": 120}


def row(method="latent", maze="rooms-v1", traversal=0, seed=0, end=0.01):
    """Return a row as a run would have written it."""
    shared = {"steps": 200, "noise": "low", "sensor_noise": "low", "version": "0"}
    curve = [0.0, 0.5 * end, end]
    judged = {"end": end, "mean": end, "largest": end, "errors": curve, "nees": 1.0, "in_95": 0.9, "seconds": 2.0}
    return {"maze": maze, "traversal": traversal, "method": method, "seed": seed} | judged | shared


@pytest.mark.slow
def test_a_study_from_end_to_end_goes_on_where_it_stopped(tmp_path, capsys):
    maze_slam(tmp_path / "out", **SMALL, methods="odometry,occupancy")
    rows = read_rows(tmp_path / "out" / MAZE_SLAM_ROWS, MazeSlamRow)
    assert [r["method"] for r in rows] == ["odometry", "occupancy"]
    log = traverse(load_maze("rooms-v1"), 120, 0)
    assert rows[0]["end"] == pytest.approx(errors(log, log.path())[-1])
    assert rows[1]["end"] < rows[0]["end"] and rows[1]["nees"] > 0.0 and rows[0]["nees"] is None
    assert "path integration" in capsys.readouterr().out
    assert (tmp_path / "out" / "maze-slam.html").is_file()
    maze_slam(tmp_path / "out", **SMALL, methods="odometry,occupancy,latent", resume=True)
    again = read_rows(tmp_path / "out" / MAZE_SLAM_ROWS, MazeSlamRow)
    assert again[:2] == rows and again[2]["method"] == "latent" and again[2]["nees"] > 0.0
    with pytest.raises(InputError, match="steps: expected 60"):
        maze_slam(tmp_path / "out", **(SMALL | {"steps": 60}), methods="odometry", resume=True)


def test_seeds_are_averaged_for_each_traversal_first():
    """A traversal with one seed counts as much as one with three: a missing run shifts no mean."""
    rows = [row(seed=seed, end=0.03) for seed in range(3)] + [row(traversal=1, end=0.01)]
    figures = study(rows, {"steps": 200}).figures["latent"]
    assert figures["end"] == pytest.approx(0.02) and figures["end_std"] == pytest.approx(0.01)
    assert (figures["runs"], figures["traversals"]) == (4, 2) and figures["steps_per_second"] == 100.0


def test_the_best_is_named_and_every_method_has_a_name():
    rows = [row(method, end=0.1 - 0.01 * k) for k, method in enumerate(METHODS)]
    found = study(rows, {"steps": 200})
    assert len(found.lines) == len(METHODS) and found.answer.startswith("scan matching, pose graph")
    assert found.picture.startswith(b"<?xml")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"mazes": "attic-v1"}, "mazes: expected one of"),
        ({"methods": "guess"}, "methods: expected one of"),
        ({"steps": 0}, "steps: expected at least 1"),
        ({"noise": "loud"}, "noise: expected one of"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path, given, message):
    with pytest.raises(InputError, match=message):
        maze_slam(tmp_path / "out", **(SMALL | given))


def test_damaged_rows_are_refused_and_an_unfinished_line_is_left_out(tmp_path):
    path = tmp_path / MAZE_SLAM_ROWS
    whole = json.dumps(row()) + "\n"
    path.write_text(whole + whole[:40])
    assert len(read_rows(path, MazeSlamRow)) == 1
    path.write_text(json.dumps(row() | {"end": "far"}) + "\n")
    with pytest.raises(InputError, match="line 1"):
        read_rows(path, MazeSlamRow)
    assert read_rows(tmp_path / "none.jsonl", MazeSlamRow) == []
