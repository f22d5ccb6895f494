"""Show the progress of long work on stderr: bars in a terminal, and plain lines where the output goes to a file.

A line is printed every :data:`LOG_SECONDS` by a thread of its own, so that a log grows during one long item, or while a
compiler works, too. Another line is printed when a stage has ended.
"""

import contextlib
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from vssm_gym.cli.shared.console import literal_console, say
from vssm_gym.progress import OnProgress
from vssm_gym.viz.text import visible

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn, TaskID

LOG_SECONDS = 15.0  # s between two lines of a log
TIMED_FROM, TIMED_SHARE = 10, 0.2  # units, or of all: before, most of the time goes into what is compiled once
STAGES = {
    "recording": "driving and recording",
    "map": "building the map",
    "episodes": "running episodes",
    "ending": "ending begun episodes",
}


class Show(Protocol):
    """Show a stage, what is done of its total, and a note; a ``float`` as the total means a share, not a count."""

    def __call__(self, stage: str, done: float, total: float, note: str = "") -> None:
        """Show the present state of a stage."""
        ...


@contextlib.contextmanager
def progress_bars() -> Iterator[OnProgress]:
    """Yield an ``on_progress(stage, done, total)`` callback, each of whose stages has a bar, or lines in a log."""
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
    from rich.progress import TimeRemainingColumn as Remaining

    name = TextColumn("{task.description:>24}", markup=False)
    with progress_of(name, BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), Remaining()) as show:
        yield show


@contextlib.contextmanager
def progress_of(*columns: "ProgressColumn") -> Iterator[Show]:
    """Yield a :class:`Show`, with these columns of rich in a terminal: ``task.fields[note]`` is the note.

    A display that was never called prints nothing, so that the message of an early error stands alone.
    """
    from rich.progress import Progress

    display: Bars | Lines
    if sys.stderr.isatty():
        display = Bars(Progress(*columns, console=literal_console(stderr=True, highlight=True)))
    else:
        display = Lines()
    try:
        yield display.show
    finally:
        display.close()


class Bars:
    """Draw a bar for each stage in a terminal. A stage that begins again gets a new bar."""

    def __init__(self, progress: "Progress") -> None:
        self._progress, self._bars = progress, dict[str, "TaskID"]()

    def show(self, stage: str, done: float, total: float, note: str = "") -> None:
        """Move the bar of a stage."""
        if stage not in self._bars:
            self._progress.start()
            self._bars[stage] = self._progress.add_task(visible(STAGES.get(stage, stage)), total=total, note=note)
        self._progress.update(self._bars[stage], completed=done, total=total, note=note)
        if done >= total:
            del self._bars[stage]

    def close(self) -> None:
        """Leave the bars as they are; rich would end a display without any with an empty line."""
        if self._progress.live.is_started:
            self._progress.stop()


@dataclass
class _Stage:
    """Hold the state of a stage; ``first`` was done when it ``began`` (s)."""

    name: str
    began: float
    first: float
    done: float
    total: float
    note: str

    def line(self, now: float) -> str:
        """Return "progress: NAME: DONE of TOTAL, NOTE, TIME, about TIME left"."""
        spent, done = now - self.began, self.done - self.first
        share = isinstance(self.total, float)
        words = [f"{100.0 * self.done / self.total:.0f} %" if share else f"{self.done:,} of {self.total:,}"]
        words += [self.note] if self.note else []
        words.append(_clock(spent))
        enough = 0.0 if share else min(TIMED_FROM, TIMED_SHARE * (self.total - self.first))
        if done > 0 and done >= enough and self.done < self.total:
            words.append(f"about {_clock(spent / done * (self.total - self.done))} left")
        return f"progress: {STAGES.get(self.name, self.name)}: {', '.join(words)}"


class Lines:
    """Print the present stage as a line every :data:`LOG_SECONDS`, and when it has ended."""

    def __init__(self) -> None:
        self._lock, self._closed = threading.Lock(), threading.Event()
        self._stage: _Stage | None = None
        self._idle = time.monotonic()  # since when there is no stage
        self._thread = threading.Thread(target=self._print, name="progress", daemon=True)
        self._thread.start()

    def show(self, stage: str, done: float, total: float, note: str = "") -> None:
        """Take the state of a stage, which becomes the present one."""
        with self._lock:
            now, last = time.monotonic(), self._stage
            if last is None or last.name != stage or done < last.done:
                last = self._stage = _Stage(stage, now, done, done, total, note)
            last.done, last.total, last.note = done, total, note
            if done >= total:
                self._stage, self._idle = None, now
                say(last.line(now), error=True)

    def close(self) -> None:
        """End the thread."""
        self._closed.set()
        self._thread.join()

    def _print(self) -> None:
        while not self._closed.wait(LOG_SECONDS):
            with self._lock:
                now = time.monotonic()
                idle = f"progress: building, compiling or writing, {_clock(now - self._idle)}"
                say(idle if self._stage is None else self._stage.line(now), error=True)


def _clock(seconds: float) -> str:
    """Return hours, minutes and seconds as h:mm:ss."""
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{seconds:02}"
