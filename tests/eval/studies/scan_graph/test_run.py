"""Test whole runs: a corridor whose loop must be closed, a false loop, and a short maze."""

import dataclasses
import functools
import json

import numpy as np
import pytest

from tests.eval.studies.scan_graph.corridor import drive
from tests.eval.studies.scan_graph.optimisers import GTSAM_COMMAND, LEAST_SQUARES, OPTIMISERS, needs_gtsam
from vssm_gym.cli.slam2d import slam2d
from vssm_gym.data.laser_logs import LaserLog
from vssm_gym.data.traversals import errors, traverse
from vssm_gym.envs.tasks.mazes import load_maze
from vssm_gym.errors import InputError
from vssm_gym.eval.studies.scan_graph import run as scan_graph
from vssm_gym.eval.studies.scan_graph.clouds import points_of
from vssm_gym.eval.studies.scan_graph.graph import Factor, PoseGraph
from vssm_gym.eval.studies.scan_graph.loops import LoopSearch
from vssm_gym.eval.studies.scan_graph.run import REFINEMENTS, run_scan_graph
from vssm_gym.eval.studies.scan_graph.submaps import SUBMAP, Submaps
from vssm_gym.geometry.planar_poses import compose

CELL = 0.1


@pytest.fixture(params=OPTIMISERS)
def optimiser(request, monkeypatch):
    """Run with each optimiser that there is."""
    monkeypatch.setattr(scan_graph, "PoseGraph", functools.partial(PoseGraph, command=request.param))
    return request.param


@pytest.mark.usefixtures("optimiser")
def test_a_corridor_is_closed(monkeypatch):
    """Walls tell nothing along a corridor: without loops the drive ends far off, with them near the truth."""
    log = drive(too_long=0.2)
    heard = []
    closed = run_scan_graph(log, CELL, on_progress=lambda *event: heard.append(event))
    monkeypatch.setattr(LoopSearch, "close", lambda self, nodes: [])
    monkeypatch.setattr(scan_graph, "REFINEMENTS", 0)
    open_ended = run_scan_graph(log, CELL)
    assert errors(log, open_ended.poses)[-1] > 0.5
    assert closed.loops > 0 and errors(log, closed.poses)[-1] < 0.1
    assert errors(log, closed.online)[-1] < 0.15
    assert heard[-1] == ("refinement", REFINEMENTS, REFINEMENTS)
    assert ("scan graph", len(log) - 1, len(log) - 1) in heard


def standing(command, log, scans, true, drift):
    """Return submaps of scans at true poses, and a graph in which the last keyframe has a drift."""
    submaps, graph = Submaps(CELL), PoseGraph("test", command)
    graph.__enter__()
    for node, scan in enumerate(scans):
        submaps.points.append(points_of(log, scan, log.max_range))
        pose = true[scan] if node < len(scans) - 1 else compose(true[scan], drift)
        graph.add(pose)
        if node:
            motion = scan_graph.relation(graph.poses[-2], graph.poses[-1])
            spread = np.diag([1e-4, 1e-4, 1e-5]) if node < len(scans) - 1 else np.diag([0.04, 0.04, 0.004])
            graph.connect([Factor(node - 1, node, motion, spread)])
    return submaps, graph


@pytest.mark.parametrize("same", [True, False])
def test_a_loop_is_taken_at_its_place_and_refused_at_another(same, optimiser):
    """The estimate claims that the last scan sees the first submap; it does, or it is of another place."""
    log = drive()
    first = list(range(0, 2 * SUBMAP, 2))
    between = list(range(100, 100 + 3 * SUBMAP))
    scans = [*first, *between, len(log) - 12 if same else 150]
    true = log.poses.copy()
    if not same:
        true[150] = true[10]
    else:
        assert np.hypot(*(true[scans[-1]] - true[10])[:2]) < 1.5
    submaps, graph = standing(optimiser, log, scans, true, np.array([0.15, -0.1, 0.03]))
    try:
        search = LoopSearch(submaps, graph)
        found = search.close(range(len(scans) - 1, len(scans)))
        waiting = [loop for _, loop in search._waiting]
        assert not found, "one loop alone, found by a search, does not count"
        if same:
            assert waiting
            error = scan_graph.relation(true[scans[-1]], compose(true[scans[waiting[0].a]], waiting[0].motion))
            assert np.hypot(*error[:2]) < 0.05 and abs(error[2]) < 0.02
        else:
            assert not waiting and search.refused > 0
    finally:
        graph.__exit__(None, None, None)


def test_only_loops_that_agree_count():
    """Two of three loops say the same of the motion between their keyframes, and the third waits in vain."""
    graph = PoseGraph("test")
    graph.poses = np.array([[0.5 * k, 0.0, 0.0] for k in range(60)])
    search, spread = LoopSearch(Submaps(CELL), graph), 1e-3 * np.eye(3)
    loop = lambda node, x: Factor(5, node, np.array([x, 0.0, 0.0]), spread, robust=True)
    assert search._agreed(0, loop(50, 1.0)) == []
    assert search._agreed(0, loop(51, 9.0)) == []
    assert [f.b for f in search._agreed(0, loop(52, 2.0))] == [52, 50]
    assert [f.b for _, f in search._waiting] == [51]
    assert search._agreed(1, loop(53, 10.0)) == []  # another submap
    assert [f.b for f in search._agreed(0, loop(54, 10.5))] == [54, 51]


@pytest.mark.usefixtures("optimiser")
def test_a_slip_is_searched_for():
    """A wheel that slips by 32 degrees in one step turns the drive by as much, and the scan matcher finds it."""
    log = drive(too_long=0.0)
    log = dataclasses.replace(log, ranges=log.ranges[:40], motions=log.motions[:39].copy(), poses=log.poses[:40])
    log.motions[20, 2] += 0.55
    assert errors(log, log.path())[-1] > 0.5
    assert errors(log, run_scan_graph(log, CELL).poses)[-1] < 0.1


@pytest.mark.slow
@pytest.mark.usefixtures("optimiser")
def test_a_maze_from_end_to_end():
    log = traverse(load_maze("pillars-v1"), 300, seed=1)
    blind = LaserLog(log.ranges, log.angles, log.max_range, log.mount, log.motions, None, log.loops, log.relations)
    found = run_scan_graph(blind, 0.01)
    off, integrated = errors(log, found.poses), errors(log, log.path())
    assert off.mean() < 0.006 and off.max() < 0.015 and off[-1] < 0.3 * integrated[-1]
    np.testing.assert_array_equal(found.poses[0], 0.0)
    assert found.keyframes[0] == 0 and found.keyframes[-1] == 300
    again = run_scan_graph(blind, 0.01)
    np.testing.assert_array_equal(found.poses, again.poses)


@pytest.mark.usefixtures("optimiser")
def test_the_command_adds_a_line(tmp_path):
    slam2d("pillars-v1", tmp_path / "out", steps=60, baseline=True)
    figures = json.loads((tmp_path / "out" / "slam2d.json").read_text())["figures"]
    assert figures["scan matching, pose graph"]["mean"] < 0.01
    assert "scan matching, pose graph" in (tmp_path / "out" / "slam2d.html").read_text()


def test_the_command_says_what_is_missing(tmp_path, monkeypatch):
    (tmp_path / "gtsam.py").write_text("raise ImportError('none here')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(InputError, match=r"slam2d: gtsam: expected GTSAM: pip install gtsam \(none here\)"):
        slam2d("pillars-v1", tmp_path / "out", steps=10, baseline=True)
    assert not (tmp_path / "out" / "slam2d.html").exists()


@needs_gtsam
def test_both_optimisers_find_one_path(monkeypatch):
    """Their errors are a logarithm and a difference, and they stop at other points: paths differ by little."""
    log, found = drive(too_long=0.2), []
    for command in (GTSAM_COMMAND, LEAST_SQUARES):
        monkeypatch.setattr(scan_graph, "PoseGraph", functools.partial(PoseGraph, command=command))
        found.append(run_scan_graph(log, CELL).poses)
    apart = scan_graph.relation(*found)
    assert np.hypot(*apart[:, :2].T).max() < 0.02


def test_an_error_is_carried_over_a_motion():
    """By differences: what an error before a motion is in the frame after it."""
    pose, motion, step = np.array([1.0, 2.0, 0.7]), np.array([0.4, -0.2, 0.9]), 1e-6
    carry = scan_graph._carried(motion)
    for k, error in enumerate(step * np.eye(3)):
        after = scan_graph.relation(compose(pose, motion), compose(compose(pose, error), motion))
        np.testing.assert_allclose(after / step, carry[:, k], atol=1e-5)


@pytest.mark.parametrize("max_range", [0.0, -1.0])
def test_a_range_that_sees_nothing_is_refused(max_range):
    with pytest.raises(InputError, match="max-range: expected above 0 m"):
        run_scan_graph(drive(), CELL, max_range)


def test_a_single_scan_is_refused():
    log = drive()
    one = LaserLog(
        log.ranges[:1], log.angles, log.max_range, log.mount, log.motions[:0], None, log.loops, log.relations
    )
    with pytest.raises(InputError, match="two scans or more"):
        run_scan_graph(one, CELL)
