"""Test every registered metric on stored rows: it equals the stored value, and the tables show it."""

import functools
import math

import pytest

from tests.eval.test_episode_row import BASELINES, ROWS
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.log import FILE, read_rows
from vssm_gym.eval.episodes.row import RENAMED_FIELDS
from vssm_gym.eval.metrics import aggregate, navigation, proportions
from vssm_gym.eval.metrics.registry import METRICS, measured, shown_in, within
from vssm_gym.eval.protocols.registry import SWEPT_ENVIRONMENTS, view_of
from vssm_gym.eval.report import summary
from vssm_gym.eval.report.tables import Measures, results

# Derived again from other fields that the row stores, and not read: the two have to agree.
DERIVED = {"spl": ("rl",), "collided": ("exploration",)}


@functools.cache
def stored():
    """Return the rows of every folder of baselines, by its name."""
    return {folder.name: read_rows(folder / FILE) for folder in BASELINES}


def every():
    """Return the stored rows and an example of each report's."""
    return {**stored(), **{name: [row] for name, row in ROWS.items()}}


@pytest.mark.parametrize("name", METRICS)
def test_a_metric_has_a_value_in_some_stored_row_and_equals_the_stored_one(name):
    metric, said = METRICS[name], 0
    for source, rows in every().items():
        for row in rows:
            value = metric.function(row)
            if value is None:
                continue
            said += 1
            assert isinstance(value, bool) or not metric.proportion
            assert math.isfinite(value)
            least, most = within(name) or (-math.inf, math.inf)
            assert least <= value <= most
            if source in stored() and row.get(name) is not None:
                assert value == pytest.approx(row[name], abs=1.01e-4)  # kept to four digits
    assert said


@pytest.mark.parametrize(("name", "folder"), [(name, folder) for name, of in DERIVED.items() for folder in of])
def test_derived_and_stored_values_are_compared(name, folder):
    rows = [row for row in stored()[folder] if row.get(name) is not None]
    assert rows
    assert all(METRICS[name].function(row) == pytest.approx(row[name], abs=1.01e-4) for row in rows)


@pytest.mark.parametrize("name", METRICS)
def test_a_metric_is_shown_in_its_reports(name):
    metric = METRICS[name]
    assert metric.label
    assert metric.reports
    assert set(metric.headline) | set(metric.compared) <= set(metric.reports)
    assert metric.direction in ("higher", "lower", "neither")
    for report in metric.reports:
        rows = [measured(row) for row in every()[report]]
        assert metric.label in results(rows, 0, Measures(report)).header


def test_every_report_has_metrics_of_its_own_labels():
    reports = {view_of(env).measures.report for env in SWEPT_ENVIRONMENTS}
    assert reports == {report for metric in METRICS.values() for report in metric.reports}
    for report in reports:
        labels = [metric.label for metric in shown_in(report).values()]
        assert len(set(labels)) == len(labels)


def test_by_hand():
    row = {
        "success": True,
        "geodesic": 2.0,
        "path_length": 4.0,
        "collision_events": 1,
        "seconds": 6.0,
        "metres_99": None,
    }
    row |= {"latency": {"total": {"p50": 0.01, "p95": 0.02}}, "navigation": {"success": 0.5, "spl": 0.25}}
    found = measured(row)
    assert (found["spl"], found["path_ratio"], found["seconds_driven"]) == (0.5, 2.0, 6.0)
    assert (found["collided"], found["covered_99"]) == (True, False)
    assert (found["control_p50_ms"], found["decision_p95_ms"]) == (10.0, 20.0)
    assert (found["navigation_success"], found["navigation_spl"]) == (50.0, 0.25)
    failed = measured(row | {"success": False})
    assert (failed["spl"], failed["seconds_driven"], failed["path_ratio"]) == (0.0, None, None)


def test_spl_is_that_of_the_literature():
    """One function computes the field of the row and the column of the table."""
    row = ROWS["car"]
    assert METRICS["spl"].function(row) == navigation.spl(row["success"], row["geodesic"], row["path_length"])


def test_the_tables_show_which_direction_is_better():
    said = Measures("navigation").directions(["spl", "steps"])
    assert said == "Higher is better: SPL. Lower is better: steps."


@pytest.mark.parametrize(("old", "new"), RENAMED_FIELDS.items())
@pytest.mark.parametrize(
    "ask",
    [
        lambda name: results([], 0, Measures("car"), metrics=(name,), by=()),
        lambda name: Measures("car").label(name),
        lambda name: summary.mean(name),
        lambda name: aggregate.mean([], name),
        lambda name: aggregate.paired_difference([], name, "a", "b"),
        lambda name: proportions.percent([], name),
    ],
)
def test_an_old_name_of_a_metric_is_an_error_that_gives_the_new_one(ask, old, new):
    with pytest.raises(InputError, match=f"{old}: expected '{new}', as this metric is called now"):
        ask(old)
