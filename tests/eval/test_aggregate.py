"""Test intervals: coverage on synthetic data, clustering by task, exact paired differences, reproducibility."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.errors import InputError
from vssm_gym.eval.metrics.aggregate import Interval, bootstrap_mean, group_rows, mean, paired_difference


def episode(agent="astar", task=0, seed=0, scene="oak", noise="low", **metrics):
    row = {"env": "E", "scene": scene, "scene_hash": scene, "robot": "r", "noise": noise, "sensor_noise": "none"}
    return row | {"renderer": "raycast", "physics": "mujoco", "agent": agent, "task": task, "seed": seed} | metrics


@pytest.mark.parametrize("draw", [lambda rng: rng.normal(1.0, 2.0, 60), lambda rng: rng.random(60) < 0.8])
def test_the_interval_covers_the_true_mean_about_95_times_in_100(draw):
    truth = 1.0 if draw(np.random.default_rng(0)).dtype == float else 0.8
    hits = 0
    for trial in range(500):
        interval = bootstrap_mean(draw(np.random.default_rng(trial)).astype(float), range(60))
        hits += interval.low <= truth <= interval.high
    # 500 Bernoulli trials at 0.94 (the percentile interval is slightly short at n = 60): four sigma either side.
    assert 0.90 < hits / 500 < 0.98


def test_seeds_of_one_task_count_as_one_task():
    """Repeating every episode three times adds no information: the interval must not shrink by sqrt(3)."""
    x = np.random.default_rng(1).normal(size=80)
    once = bootstrap_mean(x, range(80))
    thrice = bootstrap_mean(np.repeat(x, 3), np.repeat(np.arange(80), 3))
    assert (thrice.low, thrice.high) == pytest.approx((once.low, once.high))
    assert (thrice.tasks, thrice.episodes) == (80, 240)
    independent = bootstrap_mean(np.repeat(x, 3), range(240))
    assert independent.high - independent.low < 0.7 * (thrice.high - thrice.low)


def test_the_width_matches_the_normal_theory():
    x = np.random.default_rng(2).normal(size=400)
    interval = bootstrap_mean(x, range(400))
    half = 1.96 * x.std() / np.sqrt(400)
    assert (interval.low, interval.high) == pytest.approx((x.mean() - half, x.mean() + half), abs=0.1 * half)


@given(st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=20), st.integers(0, 5))
def test_interval_laws(values, seed):
    interval = bootstrap_mean(values, range(len(values)), seed)
    assert interval == bootstrap_mean(values, range(len(values)), seed)  # the same seed, the same interval
    slack = 1e-9 * (1 + max(map(abs, values)))
    assert min(values) - slack <= interval.low <= interval.high <= max(values) + slack
    assert interval.mean == pytest.approx(np.mean(values))


def test_another_seed_draws_other_resamples():
    x = np.random.default_rng(3).normal(size=50)
    first, second = bootstrap_mean(x, range(50), 0), bootstrap_mean(x, range(50), 1)
    assert first.low != second.low
    assert first.low == pytest.approx(second.low, abs=0.05)


def test_no_data_and_one_task_have_no_interval():
    assert bootstrap_mean([], []).text() == "-"
    one = bootstrap_mean([0.5, 0.7], ["t", "t"])
    assert one.mean == pytest.approx(0.6)
    assert np.isnan(one.low)
    assert one.text() == "0.60 [-]"
    assert Interval(0.5, 0.25, 0.75, 9, 9).text(1) == "0.5 [0.2, 0.8]"


def test_the_paired_difference_is_exact_where_it_is_constant():
    """Tasks differ wildly, the agents by 0.25 on each: pairing must see 0.25 with a zero-width interval."""
    difficulty = np.random.default_rng(4).normal(size=30)
    rows = [episode("a", t, s, spl=difficulty[t] + s + 0.25) for t in range(30) for s in range(2)]
    rows += [episode("b", t, s, spl=difficulty[t] + s) for t in range(30) for s in range(2)]
    rows += [episode("b", 99, spl=1000.0)]  # without a partner: left out
    interval = paired_difference(rows, "spl", "a", "b")
    assert (interval.mean, interval.low, interval.high) == pytest.approx((0.25, 0.25, 0.25))
    assert (interval.tasks, interval.episodes) == (30, 60)


def test_pairs_never_mix_conditions():
    rows = [episode("a", t, noise="low", spl=1.0) for t in range(5)] + [
        episode("b", t, noise="mid", spl=0.0) for t in range(5)
    ]
    with pytest.raises(InputError, match=r"a - b.*episodes of both agents"):
        paired_difference(rows, "spl", "a", "b")


def test_groups_keep_their_order_and_missing_values_are_left_out():
    rows = [episode("z", t, error=None) for t in range(3)] + [episode("a", t, error=0.5 + t) for t in range(3)]
    groups = group_rows(rows, ["agent"])
    assert list(groups) == [("z",), ("a",)]
    assert mean(groups["z",], "error").text() == "-"
    assert mean(groups["a",], "error").mean == pytest.approx(1.5)
    assert mean(rows, "error").episodes == 3


def test_simulators_are_paired_agent_by_agent():
    rows = [episode("a", t, physics=p, spl=0.5 + (p == "mujoco")) for t in range(4) for p in ("mujoco", "bullet")]
    rows += [episode("b", t, physics="bullet", spl=9.0) for t in range(4)]
    interval = paired_difference(rows, "spl", "bullet", "mujoco", by="physics")
    assert (interval.mean, interval.episodes) == (-1.0, 4)
