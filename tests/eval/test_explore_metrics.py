"""Test metrics of explorers on curves made by hand, above all for runs that never reach a level of coverage."""

import math

import numpy as np
import pytest

from tests.helpers.explore_runs import STEP, STEPS, run
from vssm_gym.eval.metrics import exploration as metrics
from vssm_gym.eval.metrics.exploration import Recorder, at, censored_ratio, mean_curve, median, median_to_level, ratio
from vssm_gym.eval.metrics.training_runs import by_method

BUDGET = STEPS * STEP


def test_a_recorder_stores_the_step_of_each_level_and_samples_by_metre_or_second():
    calls = []
    recorder = Recorder(lambda: (calls.append(1), (-10.0 * len(calls), 0.1))[1])
    steps = 101  # 20 s at 0.25 m/s, 5 m; coverage 0.2 each metre
    for k in range(steps):
        recorder.record(0.05 * k, 0.2 * k, min(1.0, 0.01 * k))
    recorder.record(0.05 * (steps - 1), 0.2 * (steps - 1), 1.0, last=True)
    row = recorder.row()
    assert (row["metres_50"], row["seconds_50"]) == (2.5, 10.0)
    assert (row["metres_90"], row["metres_99"]) == (4.5, 4.95)
    curve = row["curve"]
    assert curve["metres"] == [0.0, 0.1, 2.0, 2.5, 4.0, 5.0]  # once it moves, every 2 m, and after 10 s and 20 s
    assert curve["seconds"] == [0.0, 0.4, 8.0, 10.0, 16.0, 20.0]  # the last step was sampled already: not twice
    assert curve["entropy"] == [-10.0, -20.0, -30.0, -40.0, -50.0, -60.0]
    assert len(calls) == 6  # what costs is measured when a sample is due, and only then


def test_a_standing_robot_is_sampled_by_time_and_the_end_is_always_sampled():
    recorder = Recorder(lambda: (None, None))
    for k in range(120):
        recorder.record(0.0, 0.2 * k, 0.3)
    recorder.record(0.0, 24.0, 0.3, last=True)
    row = recorder.row()
    assert row["curve"]["seconds"] == [0.0, 10.0, 20.0, 24.0]
    assert row["curve"]["entropy"] == [None] * 4  # an agent without a map
    assert row["metres_50"] is None


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        # Both got there.
        (run("a", 10.0), run("b", 20.0), 0.5),
        # Time was out for the other after 40 m: its path is longer than that.
        (run("a", 10.0), run("b", 60.0, ends=40.0, stopped=False), 0.25),
        # ... and after 5 m, which says little: the ratio stays what the bound allows, above 1.
        (run("a", 10.0), run("b", 60.0, ends=5.0, stopped=False), 2.0),
        # The other stopped early: it would never have got there, however little it drove.
        (run("a", 10.0), run("b", 60.0, ends=5.0, stopped=True), 1.0),
        (run("a", 10.0), run("b", 60.0, ends=40.0, stopped=True), 0.25),
        # The first did not get there: all that can be driven in the time counts, whether it stopped or not.
        (run("a", 60.0, ends=5.0, stopped=True), run("b", 20.0), BUDGET / 20.0),
        (run("a", 60.0, ends=50.0, stopped=False), run("b", 20.0), BUDGET / 20.0),
        # Neither.
        (run("a", 60.0, ends=5.0), run("b", 60.0, ends=50.0), None),
    ],
)
def test_a_censored_path_length_counts_against_the_agent_that_is_tested(first, second, expected):
    assert censored_ratio(first, second) == (expected if expected is None else pytest.approx(expected))


def test_the_only_agent_that_reaches_a_level_is_ahead():
    rows = [run("a", 50.0), run("b", 60.0, ends=40.0, stopped=True)]
    assert (ratio(rows, "a", "b").shorter, ratio(rows, "b", "a").shorter) == (1, 0)


def test_times_are_compared_by_the_same_rules():
    """Runs at 0.4 m/s within a limit of 100 s."""
    assert censored_ratio(run("a", 10.0), run("b", 20.0), axis="seconds") == pytest.approx(0.5)
    assert censored_ratio(run("a", 10.0), run("b", 60.0, ends=40.0, stopped=False), axis="seconds") == pytest.approx(
        0.25
    )
    assert censored_ratio(run("a", 60.0, ends=5.0, stopped=True), run("b", 20.0), axis="seconds") == pytest.approx(2.0)


def test_ratios_stay_finite_where_the_first_image_shows_everything():
    at_once = run("a", 10.0) | {"metres_90": 0.0}
    assert censored_ratio(at_once, run("b", 1.6)) == pytest.approx(0.1)  # one step counts
    assert censored_ratio(at_once, at_once) == 1.0


def test_an_earlier_end_never_improves_the_ratio():
    """Wherever a run is cut, the ratio of its agent does not improve."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        a, b, cut = rng.uniform(5.0, 60.0, 3)
        whole = censored_ratio(run("a", a), run("b", b))
        for stopped in (True, False):
            assert censored_ratio(run("a", a, ends=min(cut, 0.9 * a), stopped=stopped), run("b", b)) >= min(
                whole, BUDGET / b
            )
        timed_out = censored_ratio(run("a", a), run("b", b, ends=min(cut, 0.9 * b), stopped=False))
        assert timed_out >= whole  # the lead over a run that was cut short is never overstated


def grid_of_runs(metres, **more):
    """Return runs of agents ``a`` and ``b``; ``metres[scene]`` is a list of (metres of a, metres of b)."""
    return [
        run(agent, driven, scene=scene, task=task, **more)
        for scene, pairs in metres.items()
        for task, pair in enumerate(pairs)
        for agent, driven in zip("ab", pair, strict=True)
    ]


def test_the_ratio_is_the_geometric_mean_over_pairs_and_resamples_scenes():
    rows = grid_of_runs({"oak": [(10.0, 20.0), (10.0, 20.0)], "elm": [(8.0, 10.0), (8.0, 10.0)]})
    found = ratio(rows, "a", "b")
    assert found.interval.mean == pytest.approx(math.sqrt(0.5 * 0.8))
    # Two clusters: a resample is one scene twice or both; its extremes are the scenes' own ratios.
    assert (found.interval.low, found.interval.high) == (pytest.approx(0.5), pytest.approx(0.8))
    assert (found.interval.tasks, found.interval.episodes) == (2, 4)
    assert (found.pairs, found.shorter, found.first_missed, found.second_missed) == (4, 4, 0, 0)
    backwards = ratio(rows, "b", "a")
    assert backwards.interval.mean == pytest.approx(1.0 / found.interval.mean)
    assert backwards.shorter == 0


def test_more_starts_in_a_scene_do_not_narrow_the_interval_over_scenes():
    """Starts of one scene are not independent: a hundred of them narrow nothing but their scene's own mean."""
    few = ratio(grid_of_runs({"oak": [(10.0, 20.0)], "elm": [(9.0, 10.0)]}), "a", "b").interval
    many = ratio(grid_of_runs({"oak": [(10.0, 20.0)] * 50, "elm": [(9.0, 10.0)] * 50}), "a", "b").interval
    assert (many.low, many.high) == pytest.approx((few.low, few.high))
    assert many.episodes == 100


def test_every_policy_of_a_method_is_compared_and_resampled():
    """Policies that need 10, 20 and 40 m, against 20 m: the last alone would be twice as long, and without doubt."""
    starts = [(scene, task) for scene in ("oak", "elm", "fir") for task in range(2)]
    rows = [run(f"p@0000000{k}", 10.0 * 2**k, scene=s, task=t) for k in range(3) for s, t in starts]
    rows = by_method([*rows, *(run("b", 20.0, scene=s, task=t) for s, t in starts)])
    found = ratio(rows, "p (3 seeds)", "b")
    assert found.interval.mean == pytest.approx(1.0)
    assert (found.pairs, found.shorter, found.interval.tasks) == (18, 6, 3)
    assert found.interval.low < 0.6 < 1.7 < found.interval.high
    back = ratio(rows, "b", "p (3 seeds)").interval
    assert (back.low, back.high) == pytest.approx((1.0 / found.interval.high, 1.0 / found.interval.low), rel=0.1)
    covered = metrics.paired_at(rows, "coverage", "p (3 seeds)", "b", 5.0)
    assert covered.mean == pytest.approx((0.45 + 0.225 + 0.1125) / 3 - 0.225, abs=1e-3)
    assert covered.low < 0.0 < covered.high


def test_missed_runs_are_counted_and_pairs_without_a_path_length_are_left_out():
    rows = [
        *(run("a", 10.0, task=0), run("b", 20.0, task=0)),
        *(run("a", 10.0, task=1), run("b", 60.0, ends=40.0, stopped=False, task=1)),
        *(run("a", 60.0, ends=30.0, task=2), run("b", 60.0, ends=30.0, task=2)),
        run("a", 10.0, task=3),  # without a partner
    ]
    found = ratio(rows, "a", "b")
    assert (found.pairs, found.interval.episodes, found.first_missed, found.second_missed) == (3, 2, 1, 2)
    assert found.interval.mean == pytest.approx(math.sqrt(0.5 * 0.25))
    nothing = ratio(rows[4:6], "a", "b")
    assert nothing.pairs == 1
    assert math.isnan(nothing.interval.mean)


def test_the_first_turn_adds_no_metres_to_the_curve():
    """All that it shows is covered at zero metres, not gradually along the first one."""
    recorder = Recorder(lambda: (None, None))
    for k in range(30):  # turns for 6 s
        recorder.record(0.0, 0.2 * k, k / 40)
    for k in range(30, 60):
        recorder.record(0.16 * (k - 29), 0.2 * k, 0.75)
    row = recorder.row() | {"stopped": True}
    assert at(row, "coverage", "metres", np.array([0.2, 1.0])).tolist() == [0.75, 0.75]


def test_medians_count_runs_that_never_reach_the_level_as_longest():
    there = [run("a", metres, task=i) for i, metres in enumerate([10.0, 12.0, 14.0])]
    never = [run("a", 60.0, ends=3.0, task=3 + i) for i in range(2)]
    assert median_to_level(there, 90).mean == 12.0
    assert median_to_level([*there, *never], 90).mean == 14.0  # of five
    assert median_to_level(there[:2], 90).mean == 11.0  # of two their mean
    assert math.isinf(median_to_level([there[0], never[0]], 90).mean)  # half of them did not get there
    most = median_to_level([*there, *never, *(run("a", 60.0, ends=3.0, task=9 + i) for i in range(2))], 90)
    assert math.isinf(most.mean)
    assert math.isinf(most.high)


def test_a_medians_interval_is_of_medians_that_occur_and_never_nan():
    values = [1.0, 2.0, 3.0, math.inf, math.inf]
    interval = median(values, list(range(5)))
    between = [0.5 * (a + b) for a in values for b in values]
    assert interval.low in between and interval.high in between
    assert interval.low <= interval.mean <= interval.high
    assert math.isnan(median(values, ["one"] * 5).low)
    assert median([], []).episodes == 0


@pytest.mark.parametrize("axis", ["metres", "seconds"])
def test_curves_are_interpolated_and_end_as_the_run_did(axis):
    grid = np.array([0.0, 5.0, 10.0, 15.0]) * (1.0 if axis == "metres" else 2.5)
    stopped, cut = run("a", 9.0, ends=12.0), run("a", 9.0, ends=12.0, stopped=False)
    expected = np.array([0.0, 0.5, 1.0, 1.0])
    np.testing.assert_allclose(at(stopped, "coverage", axis, grid), expected, atol=1e-4)
    np.testing.assert_allclose(at(stopped, "entropy", axis, grid), -1e6 * expected, atol=1e2)
    found = at(cut, "coverage", axis, grid)
    np.testing.assert_allclose(found[:3], expected[:3], atol=1e-4)
    assert np.isnan(found[3])  # unknown


def test_coverage_gained_in_place_counts_at_that_path_length():
    row = run("a", 9.0)
    row["curve"] = {
        "metres": [0.0, 2.0, 2.0, 4.0],
        "seconds": [0.0, 5.0, 10.0, 15.0],
        "coverage": [0.1, 0.2, 0.6, 0.7],
        "entropy": [None] * 4,
        "completeness": [None] * 4,
    }
    np.testing.assert_allclose(at(row, "coverage", "metres", np.array([1.0, 2.0, 3.0])), [0.15, 0.6, 0.65])
    assert np.isnan(at(row, "entropy", "metres", np.array([1.0]))).all()


def test_a_mean_curve_is_the_mean_and_stops_where_runs_drop_out():
    rows = [run("a", 9.0, ends=12.0, scene=s, task=t) for s in ("oak", "elm") for t in range(5)]
    rows += [run("a", 18.0, ends=10.0, stopped=False, scene="fir", task=t) for t in range(5)]
    grid = np.array([0.0, 4.5, 9.0, 11.0])
    mean, low, high = mean_curve(rows, "coverage", "metres", grid)
    np.testing.assert_allclose(mean[:3], [0.0, (2 * 0.45 + 0.225) / 3, (2 * 0.9 + 0.45) / 3], atol=1e-3)
    np.testing.assert_allclose(low[1:3], [0.225, 0.45], atol=1e-3)
    np.testing.assert_allclose(high[1:3], [0.45, 0.9], atol=1e-3)
    assert np.isnan([mean[3], low[3], high[3]]).all()  # a third is unknown at 11 m
    assert np.isnan(mean_curve(rows[:1], "coverage", "metres", grid)[1:]).all()  # one cluster: no interval


def test_maps_are_compared_at_equal_length_over_pairs_that_both_drove_so_far():
    rows = grid_of_runs({"oak": [(9.0, 18.0), (9.0, 18.0)], "elm": [(9.0, 9.0)]})
    d = metrics.paired_at(rows, "coverage", "b", "a", 9.0)
    assert d.mean == pytest.approx(-(0.45 + 0.45 + 0.0) / 3, abs=1e-3)
    cut = [run("a", 9.0, task=0), run("b", 18.0, ends=5.0, stopped=False, task=0)]
    assert metrics.paired_at(cut, "coverage", "b", "a", 9.0).episodes == 0
    soon = metrics.paired_at(cut, "coverage", "b", "a", cut[1]["seconds"], axis="seconds")
    assert soon.episodes == 1
    assert metrics.paired_at(cut, "coverage", "b", "a", cut[1]["seconds"] + 1.0, axis="seconds").episodes == 0
