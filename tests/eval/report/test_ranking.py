"""Test the order of agents and the summary that a page opens with."""

import pytest

from tests.eval.report.test_report import episode
from tests.eval.report.test_report_car import episode as drive
from tests.helpers.explore_runs import run
from vssm_gym.agents.registry import AGENTS
from vssm_gym.eval.metrics.registry import measured
from vssm_gym.eval.report.car import CAR_VIEW
from vssm_gym.eval.report.explore import EXPLORE_VIEW
from vssm_gym.eval.report.ranking import BASELINES, DIFFERENCE, NO_DIFFERENCE, summarise
from vssm_gym.eval.report.view import POINTNAV_VIEW
from vssm_gym.viz.html import Table

POINTNAV, CAR, EXPLORE = POINTNAV_VIEW.ranking, CAR_VIEW.ranking, EXPLORE_VIEW.ranking


def navigation(successes):
    """Return ten episodes of each agent, of which the first ``successes`` succeed."""
    rows = [episode(agent, t, t < n, None if t < n else "lost") for agent, n in successes.items() for t in range(10)]
    return [measured(row) for row in rows]


def test_agents_are_ordered_by_the_main_metric_and_baselines_stand_last():
    rows = navigation({"random": 5, "oracle": 10, "dead_reckoning": 2, "astar": 8, "no_map": 4})
    assert POINTNAV.order(rows) == ["astar", "no_map", "dead_reckoning", "oracle", "random"]
    assert set(BASELINES) <= set(AGENTS)


def test_the_leader_is_no_baseline_and_the_next_is_compared_in_pairs():
    found = summarise(POINTNAV, navigation({"oracle": 10, "random": 0, "no_map": 3, "astar": 8}), 0)
    assert (found.leader.agent, found.second.agent, found.others, found.tied) == ("astar", "no_map", 1, 0)
    assert found.versus.text.startswith("0.450 [") and found.versus.verdict == DIFFERENCE  # 0.9 (8 - 3) / 10
    assert [standing.is_baseline for standing in found.standings] == [False, False, True, True]
    widths = [float(standing.bar.mean) for standing in found.standings]
    assert widths == pytest.approx([0.8 * widths[2], 0.3 * widths[2], widths[2], 0.0], abs=0.1)
    assert 90.0 < widths[2] < 100.0  # of the largest bound, which is astar's
    tiles = {tile.label: tile for tile in found.tiles}
    assert (tiles["agent"].value, tiles["SPL"].value, tiles["failures"].value) == ("astar", "0.72", "2")
    assert tiles["failures"].kind == "bad"
    close = summarise(POINTNAV, navigation({"no_map": 7, "astar": 8}), 0)
    assert close.versus.verdict == NO_DIFFERENCE


def test_equal_agents_are_ordered_and_compared_by_the_second_measure():
    rows = [drive("slow", "bullet", t) for t in range(6)] + [drive("fast", "mujoco", t) for t in range(6)]
    rows = [measured(row | {"physics": "mujoco"}) for row in rows]
    found = summarise(CAR, rows, 0)
    assert (found.leader.agent, found.tied) == ("fast", 1)
    assert found.then == ("the fastest", "6.0 [6.0, 6.0] s", "7.0 [7.0, 7.0] s")
    assert (found.versus.text, found.versus.verdict) == ("-1.00 [-1.00, -1.00]", DIFFERENCE)


def test_a_level_that_was_never_reached_is_last_and_has_no_bar():
    rows = [run("random_walk", 60.0, ends=40.0, stopped=False, task=t) for t in range(4)]
    rows += [run("lost", 60.0, ends=40.0, stopped=False, task=t) for t in range(4)]
    rows += [run("frontier_gain", 20.0, task=t) for t in range(4)]
    rows += [run("mi_explorer", 10.0, task=t) for t in range(4)]
    found = summarise(EXPLORE, [measured(row) for row in rows], 0)
    assert [standing.agent for standing in found.standings] == ["mi_explorer", "frontier_gain", "lost", "random_walk"]
    assert found.standings[2].text.startswith("never") and found.standings[2].bar is None
    assert found.versus.text == "0.50 [0.50, 0.50]"


def test_one_agent_alone_has_no_rival():
    found = summarise(POINTNAV, navigation({"random": 1}), 0)
    assert (found.leader.agent, found.others, found.second, found.versus) == ("random", 0, None, None)


def test_a_wide_table_is_cut_and_every_part_keeps_the_names():
    table = Table(["agent", *map(str, range(11))], [["a", *map(str, range(11))]], 1)
    first, second = table.parts
    assert first.header == ["agent", *map(str, range(6))] and second.header == ["agent", *map(str, range(6, 11))]
    assert second.lines == [["a", *map(str, range(6, 11))]]
    narrow = Table(["agent", "n"], [["a", "1"]], 1)
    assert [part.header for part in narrow.parts] == [["agent", "n"]]
    assert [part.header for part in Table(["agent"], [["a"]], 1).parts] == [["agent"]]
