"""Test scores and tables: values by hand, failures as the worst, ranks, and names of any content in Markdown."""

import math

import numpy as np
import pytest

from vssm_gym.eval.benchmark import page
from vssm_gym.eval.benchmark.manifest import Entrant, Manifest
from vssm_gym.eval.benchmark.prediction.levels import UNINFORMED
from vssm_gym.eval.benchmark.results import Table, _placed, score_of, step_of
from vssm_gym.eval.benchmark.scores import NOT_RUN, SCORES, line
from vssm_gym.eval.benchmark.suite import DrivingTrack, SlamTrack
from vssm_gym.eval.benchmark.times import Took
from vssm_gym.geometry.car import Car

NAVIGATION = DrivingTrack(kind="driving", about="Drive.", score="spl", seconds=1.0, sweep={"scenes": "oak", "tasks": 1})
WALK = {"scene": "oak", "motion": "handheld", "length": 5.0}
SLAM = SlamTrack(kind="slam", about="Follow.", seconds=1.0, recordings=[WALK])


def driven(task=0, **fields):
    """Return a row of PointNav, half as direct as possible."""
    found = {"scene_hash": "a", "task": task, "success": True, "failure": None, "geodesic": 2.0, "path_length": 4.0}
    return found | {"collisions": 1, "version": "1", "decision_p95": 0.1} | fields


def explored(failure=None, stopped=True):
    """Return a row that has seen a half after 10 s and all after 20 s, and has 40 s."""
    curve = {"seconds": [0.0, 10.0, 20.0], "coverage": [0.0, 0.5, 1.0]}
    return {"failure": failure, "curve": curve, "budget": {"seconds": 40.0}, "stopped": stopped}


def test_spl_is_that_of_the_metrics():
    assert SCORES["spl"].function(driven()) == 0.5
    assert SCORES["spl"].function(driven(success=False)) == 0.0


def test_timely_success_is_one_for_no_car():
    fastest = 2.0 / Car().max_speed
    row = {"success": True, "geodesic": 2.0}
    assert SCORES["timely"].function(row | {"seconds": 4.0 * fastest}) == pytest.approx(0.25)
    assert SCORES["timely"].function(row | {"seconds": 0.5 * fastest}) == 1.0
    assert SCORES["timely"].function(row | {"seconds": fastest, "success": False}) == 0.0


def test_explored_is_the_mean_coverage_over_the_time_limit():
    assert SCORES["explored"].function(explored()) == pytest.approx((10.0 * 1.0 + 20.0) / 40.0, abs=0.02)
    assert SCORES["explored"].function(explored(failure="stopped early: 5 % covered")) > 0.7
    assert SCORES["explored"].function(explored(failure="fault: KeyError: 'goal'")) == 0.0


def test_a_line_of_an_entry():
    rows = [driven(0), driven(1, success=False, failure="fault: ValueError: no"), driven(2, collisions=4)]
    found = line("mine", rows, SCORES["spl"], 4)
    assert found.score.mean == pytest.approx((0.5 + 0.0 + 0.5 + 0.0) / 4)  # the fourth episode was not run
    assert found.score.low < found.score.mean < found.score.high
    assert found.success == 0.5
    assert found.collisions == 2.0
    assert found.p95 == pytest.approx(0.1)
    assert found.faults == {"ValueError: no": 1, NOT_RUN: 1}


def test_an_entry_without_any_row_has_the_worst_score():
    found = line("mine", [], SCORES["spl"], 3)
    assert (found.score.mean, found.success, found.p95, found.faults) == (0.0, 0.0, None, {NOT_RUN: 3})


def test_the_order_of_rows_changes_no_interval():
    rows = [driven(k, path_length=4.0 + k * k) for k in range(12)]
    found = [line("mine", rows[::step], SCORES["spl"], 12) for step in (1, -1)]
    assert found[0] == found[1]


def test_starts_in_one_home_are_not_independent():
    rows = [driven(k, curve={}, scene_hash="ab"[k // 4], success=k < 4) for k in range(8)]
    assert line("mine", rows, SCORES["spl"], 8).score.tasks == 2
    assert line("mine", rows[:4], SCORES["spl"], 4).score.tasks == 4  # one home: the interval is for that home alone
    assert line("mine", [driven(k) for k in range(4)], SCORES["spl"], 4).score.tasks == 4
    drives = [row | {"scene": scene} for row, scene in zip(units(1.0, 2.0, 3.0, 4.0), "aabb", strict=True)]
    found = line("mine", drives, SCORES["nats"], 4).score
    assert (found.tasks, found.episodes) == (2, 4)
    assert found.low < 1.0  # of two scenes nothing certain can be said


def units(*scores):
    """Return rows of SLAM."""
    shared = {"success": True, "fault": None, "scene": None, "p95": 0.2, "version": "1"}
    return [{"unit": f"walk-{k}", "score": score} | shared for k, score in enumerate(scores)]


def test_ranks_follow_the_better_direction_and_leave_out_what_is_given_the_pose():
    agent = lambda label, **given: Entrant(label=label, kind="agent", tracks=("navigation",), **given)
    lines = [
        (line("late", [driven(path_length=8.0)], SCORES["spl"], 1), agent("late"), False, True),
        (line("cheat", [driven(path_length=2.0)], SCORES["spl"], 1), agent("cheat", needs_pose=True), True, True),
        (line("good", [driven()], SCORES["spl"], 1), agent("good"), True, True),
    ]
    placed = _placed(lines, NAVIGATION)
    assert [(place.line.entry, place.rank) for place in placed] == [("good", 1), ("late", 2), ("cheat", None)]
    open_to_all = NAVIGATION.model_copy(update={"pose": "observed"})
    assert [place.line.entry for place in _placed(lines, open_to_all)] == ["cheat", "good", "late"]
    slam = lambda label: Entrant(label=label, kind="slam", tracks=("slam",))
    lines = [(line(n, units(s), SCORES["ate"], 1), slam(n), False, True) for n, s in (("far", 0.2), ("near", 0.1))]
    assert [place.line.entry for place in _placed(lines, SLAM)] == ["near", "far"]


def test_equal_scores_share_a_rank_unless_one_has_faults():
    slam = lambda label: Entrant(label=label, kind="slam", tracks=("slam",))
    (still,), (far,) = units(0.3), units(0.4)
    broken = still | {"fault": "it broke"}
    rows = {
        "still": [still] * 2,
        "same": [still] * 2,
        "broken": [still, broken],
        "far": [far] * 2,
        "never": [broken] * 2,
    }
    lines = [(line(n, of, SCORES["ate"], 2), slam(n), False, True) for n, of in reversed(rows.items())]
    placed = {place.line.entry: place.rank for place in _placed(lines, SLAM)}
    assert placed == {"still": 1, "same": 1, "broken": 3, "far": 4, "never": None}  # one that never ran has no rank
    assert _placed(lines, SLAM)[-1].line.entry == "never"


def test_a_run_shares_the_rank_of_its_own_committed_rows_which_are_rounded():
    slam = Entrant(label="prism", kind="slam", tracks=("slam",))
    rows = [(units(0.0261987654, 0.3), False), (units(0.0261988, 0.3), True), (units(0.03, 0.3), True)]
    placed = _placed([(line("prism", of, SCORES["ate"], 2), slam, committed, True) for of, committed in rows], SLAM)
    assert [place.rank for place in placed] == [1, 1, 3]


def test_recordings_that_were_not_run_leave_an_entry_without_a_score_and_drives_are_worth_knowing_nothing():
    found = line("mine", units(0.1), SCORES["ate"], 3)
    assert np.isnan([found.score.mean, found.score.low, found.score.high]).all()
    assert found.success == pytest.approx(1 / 3)
    assert found.faults == {NOT_RUN: 2}
    found = line("mine", units(1.0), SCORES["nats"], 3)
    assert found.score.mean == pytest.approx((1.0 + 2 * UNINFORMED) / 3)
    assert found.faults == {NOT_RUN: 2}
    assert line("mine", [], SCORES["nats"], 3).score.mean == UNINFORMED


def test_an_entry_without_a_score_stands_below_the_ranks():
    slam = lambda label: Entrant(label=label, kind="slam", tracks=("slam",))
    rows = {"none": units(), "begun": units(0.1), "far": units(0.4, 0.4), "near": units(0.3, 0.3)}
    placed = _placed([(line(n, of, SCORES["ate"], 2), slam(n), False, True) for n, of in rows.items()], SLAM)
    assert [(place.line.entry, place.rank) for place in placed[:2]] == [("near", 1), ("far", 2)]
    assert {place.line.entry: place.rank for place in placed[2:]} == {"none": None, "begun": None}


def test_a_page_shows_names_of_any_content_as_text():
    wild = "a|b [link](x) <script>\n# `y`"
    found = line(wild, units(0.1, 0.3), SCORES["ate"], 2)
    entrant = Entrant(label=wild, kind="slam", tracks=("slam",))
    places = [_placed([(found, entrant, False, steady)], SLAM) for steady in (True, False)]
    table, busy = (Table("slam", SLAM, score_of(SLAM), step_of(SLAM), placed) for placed in places)
    machine = {"processor": "CPU", "cores": 1, "of_cores": 2, "accelerator": None, "system": "Linux"}
    own = Manifest(suite="s", suite_hash="0", tracks={}, entries=(entrant,), version="1", machine=machine)
    text = page.markdown([table], own, [], ["one | two"], {"slam": Took(wall_seconds=1.0, processor_seconds=2.0)})
    row = next(text for text in text.splitlines() if text.startswith("| 1 "))
    assert row.count(" | ") == 6
    assert "200.0 (late)" in row  # of a camera with ten images a second
    assert "0.2000 [" in row
    assert "200.0 (busy machine)" in page.markdown([busy], own, [], [], {})  # it may not be the entry that is late
    assert "- slam: 1 s, 2 s of the processor, for all entries." in text
    assert "<script>" not in text.replace("\\<script\\>", "")
    assert "- one \\| two" in text
    assert "CPU, 1 of 2 cores, no accelerator, Linux" in text
    assert math.isclose(step_of(SLAM), 0.1)
    assert step_of(NAVIGATION) == 0.2
    assert np.isfinite(found.score.low)
