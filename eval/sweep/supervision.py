"""Let an entry's code fail without failing what runs it: errors, wrong results and lost time become one reason.

Time is that of the processor, of this process and of those that it has started and that have ended, so that a busy
machine costs an entry nothing; an entry that waits has WAITING times as much. A call of the entry's Python code is
interrupted by an alarm when its time is used up. Native code that does not return ends its process some time later,
which whoever started the process reports.

Whatever an entry returns is read once, inside a supervised call, and kept as plain values: an attribute that raises, or
that is another one when it is read again, harms nobody.
"""

import contextlib
import faulthandler
import math
import os
import resource
import signal
import sysconfig
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
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
LONGEST_REASON, LONGEST_PLACE = 200, 80  # characters
CALLER = "vssm_gym."  # whose modules call an entry
LONGEST_STATUS = 1000  # characters of a status that rows keep
FARTHEST_ESTIMATE = 1e6  # m and rad: errors beyond are no numbers of a row
MOST_COUNTED = 1 << 53  # of a count: more are no numbers of a row
DEAD = "its process has died, or did not return"  # the fault of an entry that ends its process


class WrongResultError(Exception):
    """Say what was expected of a result of an entry, and what it was."""


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
        except BaseException as error:  # a worker ignores Ctrl-C: an interrupt is the entry's own, too
            self.fail(reason_of(error))
        finally:
            self._used = _clocks() - before
        return None

    def fail(self, reason: str) -> None:
        """Keep a reason, unless there is one."""
        self.fault = self.fault or visible(" ".join(reason.split()))[:LONGEST_REASON]


def reason_of(error: BaseException) -> str:
    """Return an error as a reason in one line; one that cannot be printed has the name of its class alone."""
    try:
        words = str(error) if isinstance(error, InputError | WrongResultError) else f"{type(error).__name__}: {error}"
    except BaseException:
        words = type(error).__name__
    where = place_of(error)
    return visible(" ".join(words.split()))[: LONGEST_REASON - len(where)] + where


def place_of(error: BaseException) -> str:
    """Return `` (FILE.py, line N)`` of the entry's own code that an error has passed last; empty where it has none.

    The entry's own code is what lies in the folder of the first file that is neither of this package nor of Python, or
    below it, but for packages that are installed there.
    """
    passed = [
        (frame.f_globals.get("__name__"), frame.f_code.co_filename, n)
        for frame, n in traceback.walk_tb(error.__traceback__)
    ]
    foreign = [
        (Path(file), n) for module, file, n in passed if not (f"{module}.".startswith(CALLER) or _of_python(file))
    ]
    near = [one for one in foreign if one[0].is_relative_to(foreign[0][0].parent)]
    own = [one for one in near if _installed(one[0]) == _installed(foreign[0][0])]
    return visible(f" ({own[-1][0].name}, line {own[-1][1]})")[:LONGEST_PLACE] if own else ""


def _installed(path: Path) -> bool:
    return "site-packages" in path.parts


def _of_python(file: str) -> bool:
    """Return whether a file is one of Python's own library."""
    frozen = file.startswith("<frozen ")
    return frozen or (Path(file).is_relative_to(sysconfig.get_path("stdlib")) and not _installed(Path(file)))


def processor_seconds() -> float:
    """Return the processor's time of this process and of its children that have ended, s."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def _clocks() -> np.ndarray:
    """Return the time of the processor and that of the clock, s."""
    return np.array([processor_seconds(), time.perf_counter()])


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
    """Act as a new agent of a class does in each episode, and give the episode up when it fails; `fault` says why.

    What the class states of its robot, task and needs holds; no instance can ask for more.

    Args:
        kind: the agent's class.
        make: makes it; called at each reset, so that nothing of one episode is known in the next.
        seconds: of processor time that it may use in an episode, its making included.
        fault: why it has failed before it began; None: it has not.
    """

    def __init__(
        self, kind: "type[Agent]", make: "Callable[[], Agent]", seconds: float, fault: str | None = None
    ) -> None:
        self.name, self.robot, self.task = kind.name, kind.robot, kind.task
        self.needs_pose, self.needs_map = kind.needs_pose, kind.needs_map
        self.end_on = getattr(kind, "end_on", "stop")
        self._make, self._seconds, self._dead = make, seconds, fault
        self._agent: Any = None
        self._supervisor = Supervisor(seconds)

    @property
    def fault(self) -> str | None:
        """Return why the agent has failed in this episode; None where it has not."""
        return self._supervisor.fault

    @property
    def map(self) -> Any:
        """Return the map of an agent that keeps one."""
        from vssm_gym.maps.voxel_map import VoxelMap

        found = self._supervisor.call(lambda: getattr(self._agent, "map", None))
        return found if isinstance(found, VoxelMap) else None

    def reset(self, context: "AgentContext", observation: "Observation", seed: int) -> None:
        """Open an episode with a new agent, and with all of the time again."""
        self._supervisor, self._agent = Supervisor(self._seconds), None
        self._form = _Stop(4, 3)
        if context.car is not None:
            self._form = _Stop(3, 2) if context.stops else _Stop(2, None)
        elif self.robot == "disc":
            self._form = _Stop(3, 2)
        if self._dead is not None:
            self._supervisor.fail(self._dead)

        def begin() -> None:
            self._agent = self._make()
            self._agent.reset(context, observation, seed)

        self._supervisor.call(begin)

    def act(self, observation: "Observation") -> "Decision":
        """Return the agent's decision; once it has failed, one that gives up."""
        from vssm_gym.agents.base import Decision, decide

        decision = self._supervisor.call(lambda: _plain(decide(self._agent, observation), self._form.size))
        if decision is not None:
            return decision
        action = np.zeros(self._form.size, np.float32)
        if self._form.stop is not None:
            action[self._form.stop] = 1.0
        return Decision(action, None, f"{FAULT}: {self.fault}", gives_up=True)


def _plain(decision: "Decision", size: int) -> "Decision":
    """Return a decision of plain values; raise :class:`WrongResultError` where it lacks what an episode needs."""
    from vssm_gym.agents.base import Decision

    def check(fits: bool, expected: str, found: Any) -> None:
        if not fits:
            raise WrongResultError(f"{expected} expected; found {found!r:.80}")

    given: Any = decision.action
    action = np.clip(floats(given), -FARTHEST_ESTIMATE, FARTHEST_ESTIMATE).astype(np.float32)
    check(action.shape == (size,) and _finite(action), f"an action of {size} finite numbers was", given)
    given = decision.pose
    pose = None if given is None else floats(given)
    check(pose is None or (pose.shape == (3,) and _finite(pose)), "a pose of 3 finite numbers, or None, was", given)
    near = pose is None or np.abs(pose).max() <= FARTHEST_ESTIMATE
    check(near, f"a pose of at most {FARTHEST_ESTIMATE:g} m was", given)
    status = decision.status
    check(isinstance(status, str), "a text as status was", status)
    given = decision.latency
    times = [(stage, seconds) for stage, seconds in given.items()] if isinstance(given, Mapping) else None
    fits = times is not None and all(isinstance(stage, str) and _is_time(seconds) for stage, seconds in times)
    check(fits, "seconds by stage as latency were", given)
    given = decision.responses
    counts = None if given is None else list(given.items()) if isinstance(given, Mapping) else [("", None)]
    fits = counts is None or all(isinstance(name, str) and _is_count(count) for name, count in counts)
    check(fits, "counts by name as responses, or None, were", given)
    expansions: Any = decision.expansions
    check(expansions is None or _is_count(expansions), "a count as expansions, or None, was", expansions)
    given = decision.covariance
    covariance = None if given is None else floats(given)
    fits = covariance is None or (pose is not None and covariance.shape == (3, 3) and _finite(covariance))
    check(fits, "a covariance of (3, 3) finite numbers with a pose, or None, was", given)
    given = decision.plan
    plan = None if given is None else floats(given)
    plan = np.zeros((0, 2)) if plan is not None and plan.shape == (0,) else plan
    fits = plan is None or (plan.ndim == 2 and plan.shape[1] == 2)
    check(fits, "waypoints (n, 2) as plan, or None, were", given)
    return Decision(
        action,
        pose,
        visible(status)[:LONGEST_STATUS],
        {stage: float(seconds) for stage, seconds in times or ()},
        plan,
        bool(decision.gives_up),
        covariance,
        None if counts is None else {name: int(count or 0) for name, count in counts},
        None if expansions is None else int(expansions),
    )


def floats(values: Any) -> np.ndarray:
    """Return a copy of an array of numbers as float64, by one reading; of anything else an array without a shape.

    Lists of unequal lengths, texts and objects are no such arrays.
    """
    try:
        found = np.array(values)
        return found.astype(np.float64) if found.dtype.kind in "fiub" else np.array(np.nan)
    except (TypeError, ValueError, OverflowError):
        return np.array(np.nan)


def _is_count(value: Any) -> bool:
    return isinstance(value, int | np.integer) and bool(0 <= value <= MOST_COUNTED)


def _is_time(value: Any) -> bool:
    return isinstance(value, float | int | np.floating) and bool(0.0 <= value < math.inf)


def _finite(values: np.ndarray) -> bool:
    """Return whether an array holds finite numbers alone."""
    return bool(np.isfinite(values).all())
