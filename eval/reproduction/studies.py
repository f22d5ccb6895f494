"""List the studies whose rows can be run again: how each runs one; those of tables are in :mod:`study_tables`,
those of predictions in :mod:`prediction_rows` and those of the benchmark in :mod:`benchmark_rows`.

A row takes less than a second (odometry), 15 to 60 s (SLAM in a maze), 5 to 40 s (an explorer), or a minute (a pose
graph). Each returns the figures that the study stores.
"""

from collections.abc import Mapping
from typing import Any

import jax

from vssm_gym.data.traversals import errors, traverse
from vssm_gym.envs.tasks.mazes import MAZES, load_maze
from vssm_gym.errors import InputError, one_of
from vssm_gym.eval.reproduction.benchmark_rows import BENCHMARK
from vssm_gym.eval.reproduction.prediction_rows import PREDICTION
from vssm_gym.eval.reproduction.study_rows import StudyRows
from vssm_gym.eval.reproduction.study_tables import TABLES
from vssm_gym.eval.studies.maze_exploration.episodes import EXPLORERS, explore
from vssm_gym.eval.studies.maze_exploration.run import EXPLORATION_ROWS
from vssm_gym.eval.studies.maze_slam.methods import ERRORS_EVERY, METHODS, judged_run
from vssm_gym.eval.studies.maze_slam.run import MAZE_SLAM_ROWS
from vssm_gym.eval.studies.scan_graph.run import run_scan_graph
from vssm_gym.slam.latent_run import run_strips

SLAM2D_ROWS = "rows.jsonl"  # of the folders of methods of slam2d
CONDITIONS = ("steps", "noise", "sensor_noise")  # of runs in mazes
GRAPH_STEPS = 3000  # of the traversals of the pose graph's rows, which do not say so
Row = Mapping[str, Any]


def _maze_slam(row: Row) -> dict[str, Any]:
    if row["method"] not in METHODS:
        raise InputError("maze-slam", "method", one_of(METHODS, row["method"]))
    conditions = {name: row[name] for name in CONDITIONS}
    return judged_run(row["method"], _maze(row["maze"]), row["traversal"], row["seed"], **conditions) | conditions


def _exploration(row: Row) -> dict[str, Any]:
    if row["agent"] not in EXPLORERS:
        raise InputError("maze-exploration", "agent", one_of(EXPLORERS, row["agent"]))
    conditions = {name: row[name] for name in CONDITIONS}
    agent = EXPLORERS[row["agent"]](_maze(row["maze"]))
    return explore(agent, row["maze"], row["seed"], **conditions) | conditions


def _strips(row: Row) -> dict[str, Any]:
    """Run the latent grid on the strips of a traversal, at low noise, as the rows of ``slam2d_strips`` were made."""
    log = traverse(load_maze(_maze(row["maze"])), row["steps"], row["traversal"], "low", "low", sensor="camera")
    found = run_strips(log, row["cell_size"], passes=row["passes"], seed=row["seed"])
    off = errors(log, found.poses)
    return {
        "end": round(float(off[-1]), 5),
        "mean": round(float(off.mean()), 5),
        "largest": round(float(off.max()), 5),
        "path_integration": round(float(errors(log, log.path())[-1]), 5),
        "log_evidence": [round(value, 1) for value in found.log_evidence],
        "error_every_100": [round(float(value), 5) for value in off[::ERRORS_EVERY]],
    }


def _graph(row: Row) -> dict[str, Any]:
    """Run the pose graph on a traversal; rows of recorded logs, which the package does not hold, have no seed."""
    log = traverse(load_maze(_maze(row["log"])), GRAPH_STEPS, row["seed"], row["noise"], row["sensor_noise"])
    found = run_scan_graph(log, row["cell"])
    figures: dict[str, Any] = {"scans": len(log), "keyframes": len(found.keyframes), "loops_closed": found.loops}
    for prefix, poses in (("", found.poses), ("online_", found.online), ("path_integration_", log.path())):
        off = errors(log, poses)
        for name, value in (("end", off[-1]), ("mean", off.mean()), ("largest", off.max())):
            figures[f"{prefix}{name}"] = round(float(value), 6)
    return figures


def _maze(name: str) -> str:
    if name not in MAZES:
        raise InputError("reproduce", "maze", one_of(MAZES, name))
    return name


CLOCK = frozenset({"seconds", "scans_per_second", "version", "code", "decision_p50", "decision_p95"})
STUDIES = (
    StudyRows(
        "maze-slam",
        MAZE_SLAM_ROWS,
        ("maze", "traversal", "method", "seed"),
        _maze_slam,
        CLOCK,
        release=jax.clear_caches,
    ),
    StudyRows("maze-exploration", EXPLORATION_ROWS, ("maze", "seed", "agent"), _exploration, CLOCK),
    StudyRows(
        "slam2d by strips",
        SLAM2D_ROWS,
        ("maze", "traversal", "steps", "method", "mode", "passes", "seed", "cell_size"),
        _strips,
        CLOCK,
        release=jax.clear_caches,
    ),
    StudyRows("slam2d by a pose graph", SLAM2D_ROWS, ("log", "seed", "cell", "noise", "sensor_noise"), _graph, CLOCK),
    *TABLES,
    PREDICTION,
    BENCHMARK,
)
"""The kinds of studies, each by the file and the fields of its rows."""
