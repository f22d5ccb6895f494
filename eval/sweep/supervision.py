"""Let an entry's code fail without failing what runs it: errors, wrong results and lost time become one reason.

Time is that of the processor, so that a busy machine costs an entry nothing; an entry that waits has WAITING times as
much. A call of the entry's Python code is interrupted by an alarm when its time is used up. Native code that does not
return ends its process some time later, which whoever started the process reports.
"""

import contextlib
import faulthandler
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.eval.metrics.failure import FAULT
from vssm_gym.viz.text import visible

if TYPE_CHECKING:  # a worker is up before it pays for JAX
    from vssm_gym.agents.base import Agent, AgentContext, Decision, Observation

T = TypeVar("T")
WAITING = 10.0  # times its processor time that an entry may take on the clock
TICK_SECONDS = 0.5  # s between two looks at the time of an entry that may have used it up
NATIVE_GRACE = 60.0  # s after the alarm, within which native code has to return before its process is ended
LONGEST_REASON = 200  # characters
LONGEST_STATUS = 1000  # characters of a status that rows keep
FARTHEST_ESTIMATE = 1e6  # m and rad: errors beyond are no numbers of a row


class OutOfTimeError(BaseException):
    """End a call of an entry whose time is used up; no handler of ordinary errors stops it."""


class Supervisor:
    """Call the code of an entry, and keep the first reason why it has failed.

    Attributes:
        seconds: of the processor's time that the entry may use, in all calls together.
        fault: why it has failed, in one line; None as long as it has not.
    """

    def __init__(self, seconds: float) -> None:
        self.seconds, self._used = seconds, np.zeros(2)
        self.fault: str | None = None

    def call(self, function: Callable[[], T]) -> T | None:
        """Return what a function of the entry returns; None where it fails, or has failed, as :attr:`fault` says."""
        if self.fault is not None:
            return None
        before = _clocks() - self._used
        try:
            with _alarm(self.seconds, before):
                return function()
        except OutOfTimeError:
            self.fail(f"more than {self.seconds:g} s of processor time, or {WAITING:g} times as much on the clock")
        except (Exception, SystemExit) as error:
            self.fail(str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}")
        finally:
            self._used = _clocks() - before
        return None

    def fail(self, reason: str) -> None:
        """Keep a reason, unless there is one."""
        self.fault = self.fault or " ".join(reason.split())[:LONGEST_REASON]


def _clocks() -> np.ndarray:
    """Return the time of the processor and that of the clock, s."""
    return np.array([time.process_time(), time.perf_counter()])


@contextlib.contextmanager
def _alarm(seconds: float, before: np.ndarray) -> Iterator[None]:
    """Raise :class:`OutOfTimeError` in the block when time is used up, and end the process if that is not heard.

    Only a main thread hears alarms; elsewhere the block has the time that it takes.

    Args:
        seconds: of the processor; on the clock WAITING times as much.
        before: the clocks when no time was used.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    limits = np.array([seconds, WAITING * seconds])

    def ring(*_: object) -> None:
        if np.any(_clocks() - before >= limits):
            raise OutOfTimeError

    left = np.maximum(limits - (_clocks() - before), 1e-3)
    heard = signal.signal(signal.SIGALRM, ring)
    with open(os.devnull, "w") as nowhere:
        faulthandler.dump_traceback_later(left[1] + NATIVE_GRACE, exit=True, file=nowhere)
        signal.setitimer(signal.ITIMER_REAL, left[0], TICK_SECONDS)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            faulthandler.cancel_dump_traceback_later()
            signal.signal(signal.SIGALRM, heard)


@dataclass(frozen=True)
class _Stop:
    """Hold the size of an action, and where its stop is; None without one."""

    size: int
    stop: int | None


class SupervisedAgent:
    """Act as an agent does, and give the episode up when it fails; ``fault`` then says why."""

    def __init__(self, agent: "Agent", seconds: float) -> None:
        self.name, self.robot, self.task = agent.name, agent.robot, agent.task
        self.needs_pose, self.needs_map = agent.needs_pose, agent.needs_map
        self._agent, self._seconds, self._supervisor = agent, seconds, Supervisor(seconds)

    @property
    def fault(self) -> str | None:
        """Return why the agent has failed in this episode; None where it has not."""
        return self._supervisor.fault

    @property
    def map(self) -> Any:
        """Return the map of an agent that keeps one."""
        from vssm_gym.maps.voxel_map import VoxelMap

        found = getattr(self._agent, "map", None)
        return found if isinstance(found, VoxelMap) else None

    def reset(self, context: "AgentContext", observation: "Observation", seed: int) -> None:
        """Open an episode, with all of the time again."""
        self._supervisor = Supervisor(self._seconds)
        self._form = _Stop(4, 3)
        if context.car is not None:
            self._form = _Stop(3, 2) if context.stops else _Stop(2, None)
        elif self.robot == "disc":
            self._form = _Stop(3, 2)
        self._supervisor.call(lambda: self._agent.reset(context, observation, seed))

    def act(self, observation: "Observation") -> "Decision":
        """Return the agent's decision; once it has failed, one that gives up."""
        from vssm_gym.agents.base import Decision, decide

        if self.fault is None:
            decision = self._supervisor.call(lambda: decide(self._agent, observation))
            if decision is not None and (wrong := _wrong(decision, self._form.size)):
                self._supervisor.fail(wrong)
            if decision is not None and self.fault is None:
                text = visible(decision.status)[:LONGEST_STATUS]
                return decision if text == decision.status else replace(decision, status=text)
        action = np.zeros(self._form.size, np.float32)
        if self._form.stop is not None:
            action[self._form.stop] = 1.0
        return Decision(action, None, f"{FAULT}: {self.fault}", gives_up=True)


def _wrong(decision: "Decision", size: int) -> str | None:
    """Return what a decision lacks that an episode and its row need; None where it lacks nothing."""
    if np.shape(decision.action) != (size,) or not _finite(decision.action):
        return f"an action of {size} finite numbers was expected; found {decision.action!r:.80}"
    if decision.pose is not None and not (np.shape(decision.pose) == (3,) and _finite(decision.pose)):
        return f"a pose of 3 finite numbers, or None, was expected; found {decision.pose!r:.80}"
    if decision.pose is not None and np.abs(np.asarray(decision.pose, float)).max() > FARTHEST_ESTIMATE:
        return f"a pose of at most {FARTHEST_ESTIMATE:g} m was expected; found {decision.pose!r:.80}"
    if not isinstance(decision.status, str):
        return f"a text as status was expected; found {decision.status!r:.80}"
    if not isinstance(decision.latency, Mapping) or not all(
        isinstance(stage, str) and isinstance(seconds, float | int) and 0.0 <= seconds < math.inf
        for stage, seconds in decision.latency.items()
    ):
        return f"seconds by stage as latency were expected; found {decision.latency!r:.80}"
    counts = decision.responses
    if counts is not None and not (isinstance(counts, Mapping) and all(map(_is_count, counts.values()))):
        return f"counts by name as responses, or None, were expected; found {counts!r:.80}"
    if decision.expansions is not None and not _is_count(decision.expansions):
        return f"a count as expansions, or None, was expected; found {decision.expansions!r:.80}"
    return None


def _is_count(value: Any) -> bool:
    return isinstance(value, int | np.integer) and bool(value >= 0)


def _finite(values: Any) -> bool:
    """Return whether an array holds finite numbers alone."""
    try:
        return bool(np.isfinite(np.asarray(values, float)).all())
    except (TypeError, ValueError):
        return False
