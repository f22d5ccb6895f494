"""Test that an entry's faults become failures of its episode: errors, wrong decisions, lost time."""

import subprocess
import sys
import time
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.agents.base import Decision
from vssm_gym.agents.registry import make_agent
from vssm_gym.eval.sweep.supervision import LONGEST_REASON, SupervisedAgent, Supervisor, reason_of

START = {"goal": np.zeros(2)}


class Context:
    """Hold what a supervisor reads of a context."""

    car, stops = None, False


class Car(Context):
    car = object()


class Scripted:
    """Return what a test wants, or raise it."""

    name, robot, task, needs_pose, needs_map = "scripted", "holonomic", "pointgoal", False, False

    def __init__(self, *results):
        self.results = list(results)

    def reset(self, context, observation, seed):
        """Begin."""

    def act(self, observation):
        found = self.results.pop(0)
        if callable(found):
            found = found()
        return found


def supervised(agent, seconds=5.0):
    """Return an agent that is this one in every episode."""
    return SupervisedAgent(type(agent), lambda: agent, seconds)


def decision(**changed):
    """Return a decision that drives on."""
    fields = {"action": np.array([0.0, 0.0, 0.1, 0.0], np.float32), "pose": np.zeros(3), "status": "driving"}
    return Decision(**(fields | changed))


class Hiding(Decision):
    """Raise where its action is read."""

    def __getattribute__(self, name):
        if name == "action":
            raise RuntimeError("no action for you")
        return super().__getattribute__(name)


class Turning(Decision):
    """Have another action each time that it is read."""

    reads = 0

    def __getattribute__(self, name):
        if name == "action":
            Turning.reads += 1
            return np.zeros(4, np.float32) if Turning.reads == 1 else "left"
        return super().__getattribute__(name)


def interrupt():
    raise KeyboardInterrupt


def leave(*_):
    raise SystemExit(3)


def loop():
    while True:
        pass


def stubborn():
    while True:
        try:
            time.sleep(10.0)
        except Exception:  # a program that goes on whatever happens
            continue


def test_decisions_pass_unchanged():
    wanted = [decision(), decision(pose=None)]
    agent = supervised(Scripted(*wanted))
    agent.reset(Context(), START, 0)
    for one in wanted:
        found = vars(agent.act(START))
        for name, value in vars(one).items():
            np.testing.assert_equal(found[name], value)
    assert agent.fault is None
    assert agent.map is None


@pytest.mark.parametrize(
    ("result", "reason"),
    [
        (lambda: 1 / 0, "ZeroDivisionError: division by zero"),
        (leave, "SystemExit: 3"),
        (None, "agent scripted: act: expected a Decision as its result; found NoneType"),
        (decision(action=np.zeros(3)), "an action of 4 finite numbers was expected; found array"),
        (decision(action=np.full(4, np.nan)), "an action of 4 finite numbers was expected"),
        (decision(action="left"), "an action of 4 finite numbers was expected; found 'left'"),
        (decision(pose=np.zeros(2)), "a pose of 3 finite numbers, or None, was expected"),
        (decision(action=[[1.0], [1.0, 2.0]]), "an action of 4 finite numbers was expected"),
        (decision(action=np.array(["left"] * 4)), "an action of 4 finite numbers was expected"),
        (decision(pose=[[1.0], [1.0, 2.0]]), "a pose of 3 finite numbers, or None, was expected"),
        (decision(plan=np.zeros(3)), "waypoints (n, 2) as plan, or None, were expected"),
        (decision(status=type("Rude", (), {"__repr__": leave})()), "SystemExit: 3"),
        (decision(expansions=10**400), "a count as expansions, or None, was expected"),
        (interrupt, "KeyboardInterrupt"),
        (lambda: Hiding(np.zeros(4), None, ""), "RuntimeError: no action for you"),
        (decision(status=7), "a text as status was expected; found 7"),
        (decision(latency={"all": np.inf}), "seconds by stage as latency were expected"),
        (decision(covariance=-np.eye(3)), "covariance: expected of"),
        (decision(pose=np.full(3, 1e200)), "a pose of at most 1e+06 m was expected"),
        (decision(responses={"turn": -1}), "counts by name as responses, or None, were expected"),
        (decision(expansions="many"), "a count as expansions, or None, was expected; found 'many'"),
    ],
)
def test_a_fault_gives_the_episode_up_once_and_for_all(result, reason):
    agent = supervised(Scripted(result, decision()))
    agent.reset(Context(), START, 0)
    for _ in range(2):
        found = agent.act(START)
        assert found.gives_up
        assert found.action.tolist() == [0.0, 0.0, 0.0, 1.0]
    assert reason in agent.fault
    assert found.status == f"fault: {agent.fault}"
    agent.reset(Context(), START, 1)
    assert agent.fault is None
    assert not agent.act(START).gives_up  # the next episode begins anew


@given(st.text(st.characters(codec="utf-8"), max_size=400))
def test_a_reason_ends_with_the_place_in_the_entrys_own_code(words):
    """The entry is this file; its error comes from a library that it calls."""

    def fails():
        Fraction("x" + words)

    with pytest.raises(ValueError, match="Fraction") as raised:
        fails()
    number = fails.__code__.co_firstlineno + 1
    reason = reason_of(raised.value)
    assert reason.endswith(f" (test_supervision.py, line {number})")
    assert len(reason) <= LONGEST_REASON


def test_a_decision_is_read_once():
    agent = supervised(Scripted(lambda: Turning(np.zeros(4), None, "")))
    agent.reset(Context(), START, 0)
    found, Turning.reads = agent.act(START), 0
    assert type(found) is Decision
    assert found.action.tolist() == [0.0] * 4


def test_a_map_that_raises_is_a_fault():
    agent = supervised(type("Mapping", (Scripted,), {"map": property(leave)})())
    agent.reset(Context(), START, 0)
    assert agent.map is None
    assert agent.fault.startswith("SystemExit: 3 (test_supervision.py, line ")


def test_each_episode_has_a_new_agent_that_the_class_speaks_for():
    made = []
    agent = SupervisedAgent(Scripted, lambda: made.append(Scripted(decision())) or made[-1], 5.0)
    for count in (1, 2):
        agent.reset(Context(), START, 0)
        made[-1].needs_pose = True
        assert len(made) == count
        assert not agent.needs_pose


def test_a_class_that_cannot_be_made_fails_its_episode():
    agent = SupervisedAgent(Scripted, leave, 5.0)
    agent.reset(Context(), START, 0)
    assert agent.act(START).gives_up
    assert agent.fault.startswith("SystemExit: 3 (test_supervision.py, line ")


def test_an_agent_that_has_failed_before_is_not_run():
    agent = SupervisedAgent(Scripted, leave, 5.0, "it is dead")
    agent.reset(Context(), START, 0)
    assert agent.act(START).status == "fault: it is dead"


def test_time_of_children_counts():
    supervisor = Supervisor(0.3)
    loop = "import time\nwhile time.process_time() < 0.6: pass"
    supervisor.call(lambda: subprocess.run([sys.executable, "-c", loop]))
    supervisor.call(lambda: busy(0.2))
    assert supervisor.fault.startswith("more than 0.3 s of processor time")


def test_a_status_that_no_row_can_hold_is_shown_by_its_escapes():
    agent = supervised(Scripted(decision(status="half \ud800\nnext"), decision(status="x" * 5000)))
    agent.reset(Context(), START, 0)
    assert agent.act(START).status == "half \\ud800\\nnext"
    assert len(agent.act(START).status) == 1000


@pytest.mark.parametrize("result", [loop, stubborn])
def test_an_agent_that_takes_too_long_is_interrupted(result):
    agent = supervised(Scripted(decision(), result), 0.1)
    agent.reset(Context(), START, 0)
    assert not agent.act(START).gives_up
    began = time.process_time()
    assert agent.act(START).gives_up
    assert time.process_time() - began < 1.0
    assert agent.fault == "more than 0.1 s of processor time, or 10 times as much on the clock"


def busy(seconds):
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass


def test_time_is_that_of_all_calls_together_and_of_the_entry_alone():
    supervisor = Supervisor(0.4)
    for _ in range(2):
        supervisor.call(lambda: busy(0.1))
        busy(0.4)  # somebody else's
    supervisor.call(lambda: time.sleep(1.0))  # a busy machine
    assert supervisor.fault is None
    supervisor.call(lambda: busy(5.0))
    assert supervisor.fault.startswith("more than 0.4 s of processor time")
    assert supervisor.call(lambda: 1) is None  # it is not asked again


def test_the_action_that_gives_up_is_that_of_the_robot():
    for context, size in ((Context, 4), (Car, 2), (type("Stopping", (Car,), {"stops": True}), 3)):
        agent = supervised(Scripted(leave))
        agent.reset(context(), START, 0)
        assert agent.act(START).action.shape == (size,)


def test_an_agent_of_the_package_is_what_it_was():
    agent = supervised(make_agent("random"))
    assert (agent.name, agent.robot, agent.needs_map) == ("random", "holonomic", False)
