"""Test intervals over tasks and training runs together: coverage, laws, interquartile means, profiles."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from vssm_gym.eval.benchmark.scores import SCORES, line
from vssm_gym.eval.metrics import aggregate, resampling
from vssm_gym.eval.metrics.aggregate import bootstrap_mean
from vssm_gym.eval.metrics.proportions import clopper_pearson
from vssm_gym.eval.metrics.training_runs import RUN, by_method, run_of, training_name

TRIALS = 200
LEVELS = np.linspace(0.0, 1.0, 101)


def crossed(rng, tasks, runs, of_tasks, of_runs, of_episodes):
    """Draw ``x_tr = a_t + b_r + e_tr``, normal with these deviations and mean 0, with its tasks and runs."""
    x = of_tasks * rng.normal(size=(tasks, 1)) + of_runs * rng.normal(size=(1, runs))
    t, r = np.indices((tasks, runs)).reshape(2, -1)
    return (x + of_episodes * rng.normal(size=(tasks, runs))).ravel(), t.tolist(), r.tolist()


def coverage(of_each):
    """Return how often intervals contain 0, of TRIALS."""
    found = [of_each(np.random.default_rng(trial)) for trial in range(TRIALS)]
    return np.mean([one.low <= 0.0 <= one.high for one in found])


@pytest.fixture
def fewer_resamples(monkeypatch):
    """Draw 500 resamples: their Monte Carlo error is far below that of the trials."""
    resampling._draws.cache_clear()
    monkeypatch.setattr(resampling, "RESAMPLES", 500)
    yield
    resampling._draws.cache_clear()


@pytest.mark.parametrize(
    ("runs", "of_runs", "of_episodes", "tasks_alone"),
    [(5, 0.3, 0.5, 0.88), (3, 0.3, 0.5, 0.84), (10, 0.5, 0.5, 0.84)],
)
def test_tasks_alone_undercover_and_both_together_cover(fewer_resamples, runs, of_runs, of_episodes, tasks_alone):
    draw = lambda rng: crossed(rng, 60, runs, 1.0, of_runs, of_episodes)

    def alone(rng):
        x, t, _ = draw(rng)
        return bootstrap_mean(x, t)

    def both(rng):
        x, t, r = draw(rng)
        return bootstrap_mean(x, t, runs=r)

    assert coverage(alone) < tasks_alone
    # Four deviations of 200 Bernoulli trials at 0.95 are 0.062; Owen's variance errs upwards, never downwards.
    assert 0.888 < coverage(both) <= 1.0


def test_the_interval_is_not_wide_where_runs_do_not_differ(fewer_resamples):
    """With noise of episodes alone between runs its width may be up to sqrt(3) of what is needed, and not more."""
    x, t, r = crossed(np.random.default_rng(0), 100, 5, 1.0, 0.0, 0.5)
    alone, both = bootstrap_mean(x, t), bootstrap_mean(x, t, runs=r)
    assert 1.0 < (both.high - both.low) / (alone.high - alone.low) < 1.2


def test_differences_of_methods_cover_and_keep_tasks_paired(fewer_resamples):
    """Tasks differ by 1, methods by nothing: pairing removes the tasks, and the runs of both remain."""

    def difference(rng):
        difficulty = rng.normal(size=40)
        rows = []
        for method, runs in (("a (4 seeds)", 4), ("b (3 seeds)", 3)):
            for run in range(runs):
                off = 0.2 * rng.normal()
                values = difficulty + off + 0.2 * rng.normal(size=40)
                rows += [row(method, task, f"{method}{run}", spl=x) for task, x in enumerate(values)]
        return aggregate.paired_difference(rows, "spl", "a (4 seeds)", "b (3 seeds)")

    assert 0.888 < coverage(difference) <= 1.0
    one = difference(np.random.default_rng(0))
    assert (one.tasks, one.episodes) == (40, 40)


def row(agent, task, run=None, **metrics):
    found = {"env": "E", "scene": "oak", "scene_hash": "oak", "robot": "r", "noise": "low", "sensor_noise": "none"}
    found |= {"renderer": "raycast", "physics": "mujoco", "agent": agent, "task": task, "seed": 0}
    return found | ({} if run is None else {RUN: run}) | metrics


def test_one_run_is_the_bootstrap_over_tasks():
    x, t, _ = crossed(np.random.default_rng(1), 30, 2, 1.0, 0.0, 1.0)
    assert bootstrap_mean(x, t, runs=["only"] * 60) == bootstrap_mean(x, t)


def test_copies_of_one_run_do_not_narrow_the_interval():
    """Five trainings that came out equal say no more of tasks than one: the interval is over tasks, unchanged."""
    x = np.random.default_rng(2).normal(size=50)
    once = bootstrap_mean(x, range(50))
    copies = bootstrap_mean(np.tile(x, 5), [*range(50)] * 5, runs=np.repeat(range(5), 50).tolist())
    assert (copies.low, copies.high) == pytest.approx((once.low, once.high))


def test_where_runs_alone_differ_the_interval_is_that_of_student():
    """All tasks alike: ``mean +- t_{R - 1} s / sqrt(R)`` within the error of a discrete bootstrap of few runs."""
    runs = np.random.default_rng(3).normal(size=12)
    found = bootstrap_mean(np.tile(runs, 5), np.repeat(range(5), 12).tolist(), runs=[*range(12)] * 5)
    half = stats.t.ppf(0.975, 11) * runs.std(ddof=1) / np.sqrt(12)
    assert (found.high - found.low) / 2.0 == pytest.approx(half, rel=0.1)
    assert 0.5 * (found.low + found.high) == pytest.approx(runs.mean(), abs=0.25 * half)


@given(
    st.lists(st.lists(st.floats(0.0, 1.0), min_size=3, max_size=3), min_size=2, max_size=8),
    st.booleans(),
    st.booleans(),
)
def test_laws(of_tasks, scaled, shuffled):
    """Intervals lie among the values, move with them, and do not depend on the order of episodes of equal numbering."""
    x = np.array(of_tasks)
    t, r = np.indices(x.shape).reshape(2, -1)
    found = bootstrap_mean(x.ravel(), t.tolist(), runs=r.tolist())
    assert x.min() - 1e-9 <= found.low <= found.high <= x.max() + 1e-9
    assert found.mean == pytest.approx(x.mean())
    factor = 3.0 if scaled else 1.0
    moved = bootstrap_mean(factor * x.ravel() + 2.0, t.tolist(), runs=r.tolist())
    assert (moved.low, moved.high) == pytest.approx((factor * found.low + 2.0, factor * found.high + 2.0), abs=1e-6)
    if shuffled:
        order = [0, *np.random.default_rng(0).permutation(np.arange(1, x.size)).tolist()]
        names = {task: f"task {task}" for task in t.tolist()}
        again = bootstrap_mean(x.ravel()[order], [names[i] for i in t[order].tolist()], runs=r[order].tolist())
        assert again.mean == pytest.approx(found.mean)


# interquartile means


@given(st.lists(st.floats(-10.0, 10.0), min_size=1, max_size=60))
def test_the_interquartile_mean_is_that_of_scipy(values):
    of = resampling.scores(np.array(values), range(len(values)), [0] * len(values))
    found = resampling.interquartile_mean(of, np.ones((1, len(values))))
    assert found.item() == pytest.approx(stats.trim_mean(values, 0.25), abs=1e-9)


@given(st.lists(st.tuples(st.floats(-10.0, 10.0), st.integers(0, 4)), min_size=1, max_size=30))
def test_weights_repeat_scores(weighted):
    """A score of weight k counts as k equal scores."""
    repeated = [value for value, count in weighted for _ in range(count)]
    if not repeated:
        return
    of = resampling.scores(np.array([value for value, _ in weighted]), range(len(weighted)), [0] * len(weighted))
    weights = np.array([[float(count) for _, count in weighted]])
    assert resampling.interquartile_mean(of, weights).item() == pytest.approx(stats.trim_mean(repeated, 0.25), abs=1e-9)
    assert resampling.mean(of, weights).item() == pytest.approx(np.mean(repeated), abs=1e-9)


def test_cells_keep_every_mean():
    x, t, r = crossed(np.random.default_rng(4), 9, 3, 1.0, 1.0, 1.0)
    twice = resampling.scores(np.concatenate([x, x + 1.0]), t + t, r + r)
    weights = np.random.default_rng(5).integers(0, 4, (20, 9)), np.random.default_rng(6).integers(1, 4, (20, 3))
    of_all, of_cells = (
        resampling.mean(of, (weights[0][:, of.task] * weights[1][:, of.run]).astype(float))
        for of in (twice, resampling.cells(twice))
    )
    np.testing.assert_allclose(of_all, of_cells)


def test_outliers_move_the_mean_and_not_the_interquartile_mean():
    rows = [row("a", task, spl=0.8 + 0.001 * task) for task in range(40)]
    worse = [one | ({"spl": 0.0} if one["task"] < 4 else {}) for one in rows]
    shift = lambda of: abs(of(rows, "spl").mean - of(worse, "spl").mean)
    assert shift(aggregate.interquartile_mean) < 0.003 < 0.08 < shift(aggregate.mean)
    found = aggregate.interquartile_mean(worse, "spl")
    assert found.low < found.mean < found.high
    assert aggregate.interquartile_mean([], "spl").text() == "-"


# profiles


@given(st.lists(st.integers(0, 100), min_size=2, max_size=40))
def test_a_profile_falls_and_its_integral_is_the_mean(percent):
    """Scores are multiples of a step of LEVELS, so that the sum over the steps is the integral."""
    rows = [row("a", task, spl=LEVELS[p]) for task, p in enumerate(percent)]
    found = aggregate.profile(rows, "spl", LEVELS)
    for ends in (found.value, found.low, found.high):
        assert (np.diff(ends) <= 1e-12).all()
        assert ends[-1] == 0.0
    assert (found.low <= found.value + 1e-12).all() and (found.value <= found.high + 1e-12).all()
    assert found.value[:-1].sum() / 100.0 == pytest.approx(np.mean(LEVELS[percent]))
    assert found.value[50] == np.mean(LEVELS[percent] > LEVELS[50])


def test_a_profile_has_the_interval_of_a_mean_at_each_level():
    x, t, r = crossed(np.random.default_rng(7), 20, 4, 0.2, 0.1, 0.1)
    rows = [row("a (4 seeds)", task, str(run), spl=0.5 + value) for value, task, run in zip(x, t, r, strict=True)]
    found = aggregate.profile(rows, "spl", np.array([0.4, 0.6]))
    for k, level in enumerate((0.4, 0.6)):
        one = aggregate.mean([one | {"spl": float(one["spl"] > level)} for one in rows], "spl")
        assert (found.value[k], found.low[k], found.high[k]) == pytest.approx((one.mean, one.low, one.high))
    assert np.isnan(aggregate.profile([], "spl", LEVELS).value).all()


# methods


def test_policies_of_one_name_are_runs_of_one_method():
    labels = ["ppo@0123abcd", "ppo@89ef4567", "ppo-few@00000000", "astar", "astar+theta_star", "x@123"]
    rows = by_method(row(label, 0) for label in labels)
    assert [one["agent"] for one in rows] == ["ppo (2 seeds)"] * 2 + labels[2:]
    assert [run_of(one) for one in rows] == [*labels[:2], "", "", "", ""]
    assert [training_name(label) for label in labels] == ["ppo", "ppo", "ppo-few", None, None, None]


def test_only_episodes_that_all_runs_have_are_compared():
    rows = by_method(row(f"p@0000000{run}", task, spl=float(run)) for run in range(2) for task in range(6 - run))
    rows += [row("b", task, spl=0.0) for task in range(6)]
    found = aggregate.paired_difference(rows, "spl", "p (2 seeds)", "b")
    assert (found.mean, found.episodes) == (0.5, 5)
    assert aggregate.paired_values(rows, "spl", "p (2 seeds)", "b")[0] == [0.5] * 5


@pytest.mark.parametrize("tasks", [3, 4, 12])
@pytest.mark.parametrize("draw", ["normal", "beta"])
def test_intervals_over_few_tasks_contain_the_mean(tasks, draw):
    """Without the correction these contain it in 72 to 91 %."""
    rng, found, trials = np.random.default_rng(tasks), 0, 300
    truth, ends = (0.0, (-np.inf, np.inf)) if draw == "normal" else (0.6, (0.0, 1.0))
    for _ in range(trials):
        values = rng.normal(size=tasks) if draw == "normal" else rng.beta(3.0, 2.0, tasks)
        interval = aggregate.bootstrap_mean(values.tolist(), range(tasks), within=ends)
        assert ends[0] <= interval.low <= interval.high <= ends[1]
        found += interval.low <= truth <= interval.high
    assert found >= 0.9 * trials


@pytest.mark.parametrize("tasks", [2, 5, 14, 16, 40])
@pytest.mark.parametrize("wins", [0.0, 0.6, 1.0])
def test_a_report_states_the_interval_of_the_benchmark(tasks, wins):
    """One table of results and one report of the same rows must not contradict each other."""
    reached = np.random.default_rng(tasks).random(tasks) < wins
    rows = [row("a", task, success=bool(s), geodesic=2.0, path_length=2.0) for task, s in enumerate(reached)]
    rows = [one | {"spl": float(one["success"]), "failure": None, "collisions": 0, "version": "1"} for one in rows]
    assert aggregate.mean(rows, "spl") == line("a", rows, SCORES["spl"], tasks).score
    assert aggregate.mean(rows, "success") == aggregate.mean(rows, "spl")


@pytest.mark.parametrize("tasks", [3, 4, 12])
def test_interquartile_means_and_paired_differences_over_few_tasks_contain_the_truth(fewer_resamples, tasks):
    """Without the correction these contain it in 72 to 93 %."""
    rng = np.random.default_rng(tasks)
    middle, half = stats.beta(3.0, 2.0).ppf([0.25, 0.75]), stats.beta(3.0, 2.0)
    truth, found = 2.0 * half.expect(lambda x: x, lb=middle[0], ub=middle[1]), np.zeros(2)
    for _ in range(TRIALS):
        rows = [row(name, task, spl=rng.beta(3.0, 2.0)) for name in "ab" for task in range(tasks)]
        score = aggregate.interquartile_mean(rows[:tasks], "spl")
        pair = aggregate.paired_difference(rows, "spl", "a", "b")
        assert 0.0 <= score.low <= score.high <= 1.0
        assert -1.0 <= pair.low <= pair.high <= 1.0
        found += score.low <= truth <= score.high, pair.low <= 0.0 <= pair.high
    assert (found >= 0.9 * TRIALS).all()


def test_intervals_over_many_tasks_are_what_they_were():
    values = np.random.default_rng(0).random(15).tolist()
    plain, wide = (aggregate.bootstrap_mean(values, range(15), within=ends) for ends in (None, (0.0, 1.0)))
    assert plain == wide


def test_runs_that_lack_tasks_have_an_interval():
    """Resamples without any score are left out: one run of a single task widens the interval, and does not end it."""
    rng = np.random.default_rng(5)
    tasks = [*range(20), *range(20), 0]
    runs = [0] * 20 + [1] * 20 + [2]
    found = resampling.bootstrap(resampling.mean, resampling.scores(rng.normal(size=41), tasks, runs))
    assert np.isfinite([found.low, found.high]).all()
    assert found.low[0] < found.value[0] < found.high[0]
    middle = resampling.bootstrap(resampling.interquartile_mean, resampling.scores(rng.random(41), tasks, runs))
    assert np.isfinite([middle.low, middle.high]).all()


@pytest.mark.parametrize("tasks", [2, 4, 16, 40])
@pytest.mark.parametrize(("least", "most"), [(0.0, 1.0), (-2.0, 1.0)])
def test_equal_extreme_scores_have_clopper_and_pearsons_interval(tasks, least, most):
    width = most - least
    for end, wins in ((least, 0), (most, tasks)):
        found = aggregate.bootstrap_mean([end] * tasks, range(tasks), within=(least, most))
        low, high = clopper_pearson(wins, tasks)
        assert (found.low, found.high) == pytest.approx((least + width * low, least + width * high), abs=1e-12)
        twice = aggregate.bootstrap_mean([end] * 2 * tasks, [*range(tasks)] * 2, within=(least, most))
        assert (twice.low, twice.high) == (found.low, found.high)  # episodes of a task count once
    middle = aggregate.bootstrap_mean([0.5] * tasks, range(tasks), within=(least, most))
    assert (middle.low, middle.high) == (0.5, 0.5)
