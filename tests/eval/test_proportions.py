"""Test intervals of proportions against scipy's, against their coverage, and for events that never happened."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from vssm_gym.errors import InputError
from vssm_gym.eval.metrics.aggregate import mean, paired_difference
from vssm_gym.eval.metrics.proportions import clopper_pearson, paired_percent, percent, tango
from vssm_gym.eval.metrics.training_runs import by_method


def episode(task, value, agent="vi_mpc", physics="mujoco", seed=0):
    row = {"env": "E", "scene_hash": "h", "robot": "car", "noise": "low", "sensor_noise": "none", "renderer": "raycast"}
    return row | {"physics": physics, "agent": agent, "task": task, "seed": seed, "collided": value}


@given(st.integers(1, 300), st.data())
def test_clopper_and_pearson_as_in_scipy(n, data):
    k = data.draw(st.integers(0, n))
    expected = stats.binomtest(k, n).proportion_ci(0.95, "exact")
    assert clopper_pearson(k, n) == pytest.approx((expected.low, expected.high), abs=1e-9)


def test_an_event_that_never_happened_has_an_upper_bound_above_zero():
    interval = percent([episode(t, False) for t in range(1000)], "collided")
    assert (interval.mean, interval.low) == (0.0, 0.0)
    assert interval.high == pytest.approx(100.0 * (1.0 - 0.025 ** (1 / 1000)))  # 0.37 %
    paired = [episode(t, False, physics=p) for t in range(1000) for p in ("mujoco", "bullet")]
    difference = paired_percent(paired, "collided", "bullet", "mujoco", by="physics")
    assert difference.mean == 0.0
    assert (difference.low, difference.high) == pytest.approx((-0.3827, 0.3827), abs=1e-4)


def test_episodes_of_one_task_count_as_one_task():
    """Seeds that repeat each other add no information."""
    values = np.random.default_rng(0).random(40) < 0.1
    once = percent([episode(t, bool(v)) for t, v in enumerate(values)], "collided")
    thrice = percent([episode(t, bool(v), seed=s) for t, v in enumerate(values) for s in range(3)], "collided")
    assert (thrice.mean, thrice.low, thrice.high) == pytest.approx((once.mean, once.low, once.high))
    assert (thrice.tasks, thrice.episodes) == (40, 120)


@pytest.mark.parametrize(("up", "down"), [(0.0, 0.0), (0.01, 0.01), (0.05, 0.0), (0.3, 0.1)])
def test_the_paired_interval_covers_the_true_difference(up, down):
    """Exact coverage at n = 50, summed over all outcomes (trinomial); nominal 95 %."""
    n, covered = 50, 0.0
    for gained in range(n + 1):
        for lost in range(n + 1 - gained):
            p = stats.multinomial.pmf([gained, lost, n - gained - lost], n, [up, down, 1.0 - up - down])
            low, high = tango(gained, lost, n) if p > 1e-9 else (1.0, 0.0)
            covered += p * (low <= up - down <= high)
    assert covered > 0.935


@pytest.mark.parametrize(("b", "c", "n"), [(1, 7, 21), (0, 3, 40), (5, 5, 30), (0, 0, 50), (2, 0, 9)])
def test_the_ends_of_the_paired_interval_are_at_1_96_deviations(b, c, n):
    """The nuisance proportion at each end is found by brute force, the likeliest of all tables with that difference."""
    for end, side in zip(tango(b, c, n), (1.0, -1.0), strict=True):
        q = np.linspace(max(0.0, -end), (1.0 - end) / 2.0, 400_001)[1:-1]  # of the second alone
        likelihood = stats.multinomial.logpmf(
            [b, c, n - b - c], n, np.stack([q + end, q, 1.0 - 2.0 * q - end], axis=-1)
        )
        q = q[np.argmax(likelihood)]
        score = (b - c - n * end) / np.sqrt(n * (2.0 * q + end * (1.0 - end)))
        assert score == pytest.approx(1.96 * side, abs=2e-3)


def test_the_paired_interval_as_published():
    """1 and 7 disagreements in 21 pairs (Fagerland, Lydersen and Laake, 2014): -0.517 to -0.026."""
    assert tango(1, 7, 21) == pytest.approx((-0.517, -0.026), abs=5e-4)


@given(st.integers(1, 60), st.data())
def test_laws_of_the_paired_interval(n, data):
    b = data.draw(st.integers(0, n))
    c = data.draw(st.integers(0, n - b))
    low, high = tango(b, c, n)
    assert -1.0 <= low <= (b - c) / n <= high <= 1.0
    assert tango(c, b, n) == pytest.approx((-high, -low), abs=1e-6)  # the other way round


def policies(collided):
    """Return rows of policies that collided where ``collided[run, task]``, and of ``astar``, which always did."""
    rows = [episode(t, bool(s), f"p@{r:08x}") for r, of_run in enumerate(collided) for t, s in enumerate(of_run)]
    return by_method([*rows, *(episode(t, True, "astar") for t in range(collided.shape[1]))])


def test_policies_whose_events_differ_from_task_to_task_differ_from_an_agent_that_always_has_them():
    rows = policies(np.arange(3)[:, None] != np.arange(21) % 3)
    found = paired_percent(rows, "collided", "p (3 seeds)", "astar")
    assert found.mean == pytest.approx(-100.0 / 3.0)
    assert found.low < found.mean < found.high < 0.0
    assert found == paired_difference(rows, "collided", "p (3 seeds)", "astar").times(100.0)
    back = paired_percent(rows, "collided", "astar", "p (3 seeds)")
    assert back.low > 0.0 and back.mean == pytest.approx(-found.mean)


def test_one_policy_of_three_that_differs_everywhere_leaves_the_method_open():
    """Three trainings say little of a fourth, however many tasks they ran."""
    rows = policies(np.repeat([[True], [True], [False]], 20, axis=1))
    alone, pair = percent(rows[:60], "collided"), paired_percent(rows, "collided", "p (3 seeds)", "astar")
    assert alone == mean(rows[:60], "collided").times(100.0)
    assert (alone.mean, pair.mean) == pytest.approx((200.0 / 3.0, -100.0 / 3.0))
    assert (alone.low, alone.high) == (0.0, 100.0)
    assert (pair.low, pair.high) == (-100.0, 0.0)


def test_one_policy_has_the_interval_of_a_proportion():
    rows = policies(np.array([[True] * 18 + [False] * 2]))
    assert percent(rows[:20], "collided").low == pytest.approx(100.0 * clopper_pearson(18, 20)[0])
    found = paired_percent(rows, "collided", rows[0]["agent"], "astar")
    assert (found.low, found.high) == pytest.approx([100.0 * end for end in tango(0, 2, 20)])


def test_missing_values_and_missing_partners():
    assert percent([episode(0, None)], "collided").text() == "-"
    with pytest.raises(InputError, match="b - a"):
        paired_percent([episode(0, True, agent="a"), episode(1, True, agent="b")], "collided", "b", "a")
