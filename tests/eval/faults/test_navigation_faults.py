"""Test how episodes with faults are judged, on decisions made by hand; and one episode (slow)."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vssm_gym.agents.base import Decision
from vssm_gym.eval.faults import navigation as faults
from vssm_gym.eval.faults.navigation import CASES, RUNS, SILENT_STEPS, WRONG_POSITION, judged, longest
from vssm_gym.inference.status import Status

AGENT: Any = SimpleNamespace(name="astar", task="pointgoal")
EXPLORER: Any = SimpleNamespace(name="explorer", task="explore")
FIRST, END = 3, 20


def episode(
    off: float = 0.0,
    flags: tuple[int, ...] = (),
    said: str = "arrived",
    gives_up: bool = False,
    success: bool = False,
    agent: Any = AGENT,
) -> faults.FaultyEpisode:
    """Judge an episode whose estimate is ``off`` metres off since the fault, flagged at the steps ``flags``."""
    true = np.zeros((END + 1, 3))
    decisions = []
    for k in range(END):
        pose = np.array([off if k >= FIRST else 0.0, 0.0, 0.0])
        status = f"driving; localization: {Status.LOST if k in flags else Status.OK}"
        decisions.append(Decision(np.zeros(4, np.float32), pose, status))
    decisions[-1] = Decision(np.array([0, 0, 0, 1], np.float32), decisions[-1].pose, said, gives_up=gives_up)
    return judged("frozen", agent, 0, decisions, true, FIRST, success)


def test_a_right_arrival_passes():
    row = episode(success=True)
    assert (row.claimed, row.wrong, row.silent, row.flagged) == (True, False, 0, None)
    assert row.passed


def test_a_wrong_claim_fails_whether_or_not_it_was_flagged():
    row = episode(off=2.0, flags=tuple(range(FIRST, END - 1)))
    assert (row.claimed, row.wrong, row.flagged) == (True, True, 0)
    assert row.silent == 1
    assert not row.passed


def test_to_give_up_claims_nothing():
    row = episode(off=2.0, flags=tuple(range(FIRST + 2, END)), said=f"gave up; {Status.LOST}", gives_up=True)
    assert (row.claimed, row.wrong, row.flagged, row.silent) == (False, False, 2, 2)
    assert row.passed


def test_a_wrong_estimate_that_nobody_notices_fails():
    row = episode(off=WRONG_POSITION + 0.1, success=True)
    assert row.silent == END - FIRST > SILENT_STEPS
    assert not row.passed
    assert episode(off=WRONG_POSITION - 0.1, success=True).passed


@pytest.mark.parametrize(("off", "wrong"), [(0.1, False), (1.0, True)])
def test_an_explorer_that_finishes_elsewhere_is_wrong(off, wrong):
    assert episode(off=off, said="finished: nothing left to gain", agent=EXPLORER).wrong is wrong


def test_the_longest_run():
    assert longest(np.array([True, True, False, True, True, True, False])) == 3
    assert longest(np.zeros(4, bool)) == 0
    assert longest(np.ones(4, bool)) == 4


def test_there_are_as_many_episodes_as_the_page_says():
    assert len(CASES) * sum(episodes for _, episodes, _ in RUNS.values()) == 56
