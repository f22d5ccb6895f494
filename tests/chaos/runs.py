"""Start commands of ``vssm-gym``, watch their folders, and kill them."""

import contextlib
import os
import random
import re
import resource
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from tests.chaos.commands import Command
from tests.helpers.paths import CHECKOUT

PATIENCE = 600.0  # s that no run here takes
POLL = 0.005  # s between looks at a folder
RUN = "import sys\nfrom vssm_gym.cli.main import program\nprogram()"
SIGNALS = {signal.SIGKILL: 0.7, signal.SIGTERM: 0.15, signal.SIGINT: 0.15}
LEFT_OVER = re.compile(r"\..+\.(tmp|lock)|\.lock")  # names of temporary files and locks


@dataclass(frozen=True)
class Ended:
    """Hold how a run ended: its exit code (negative: the signal), seconds, standard error, processes it left."""

    code: int
    seconds: float
    errors: str
    left: bool

    @property
    def lines(self) -> list[str]:
        """The lines of the standard error that are neither warnings nor progress."""
        return [line for line in self.errors.splitlines() if line and not re.match("warning: |progress: ", line)]

    @property
    def refused_in_one_line(self) -> bool:
        """True if it was refused as bad input is."""
        return self.code == 2 and len(self.lines) == 1 and self.lines[0].startswith("error: ")


class Process:
    """Run ``vssm-gym`` in a process group of its own, as a terminal does."""

    def __init__(self, arguments: list[str], scratch: Path, before: str = "", largest: int | None = None) -> None:
        self._errors = (scratch / f"stderr-{time.monotonic_ns()}").open("w+")
        self.began = time.monotonic()

        def prepare() -> None:
            signal.signal(signal.SIGINT, signal.SIG_DFL)  # a suite in the background of a shell ignores it
            if largest is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (largest, largest))

        self._process = subprocess.Popen(
            [sys.executable, "-c", before + RUN, *arguments],
            env=os.environ | {"PYTHONPATH": str(CHECKOUT)},
            cwd=scratch,
            start_new_session=True,
            preexec_fn=prepare,
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
        )

    def runs(self) -> bool:
        """Return whether it has not ended."""
        return self._process.poll() is None

    def kill(self, number: signal.Signals) -> None:
        """Send a signal: SIGINT to all processes of the group, as a terminal does, others to the first one."""
        with contextlib.suppress(ProcessLookupError):
            (os.killpg if number is signal.SIGINT else os.kill)(self._process.pid, number)

    def wait(self) -> Ended:
        """Wait until it and what it started have ended; kill what outlives it by half a minute."""
        code = self._process.wait(PATIENCE)
        seconds, deadline, left = time.monotonic() - self.began, time.monotonic() + 30.0, False
        with contextlib.suppress(ProcessLookupError):
            while True:
                os.killpg(self._process.pid, 0)
                if time.monotonic() > deadline:
                    left = True
                    os.killpg(self._process.pid, signal.SIGKILL)
                time.sleep(POLL)
        self._errors.seek(0)
        with self._errors:
            return Ended(code, seconds, self._errors.read(), left)


def arguments_of(command: Command, inputs: Path, out: Path) -> list[str]:
    """Return the words of a command that writes to ``out``."""
    return [*command.arguments.format(inputs).split(), "--out", str(out)]


def names_in(out: Path) -> frozenset[str]:
    """Return what a kill may fall between: the names beside a folder, in it and one level below."""
    folders = [out.parent, *(path for path in out.parent.iterdir() if path.name.startswith((out.name, f".{out.name}")))]
    folders += [path for path in out.glob("*") if path.is_dir()]
    found: set[str] = set()
    for folder in folders:
        with contextlib.suppress(OSError):
            found |= {str(folder / name) for name in os.listdir(folder)}
    return frozenset(found)


def changes(out: Path, process: Process, until: int | None = None) -> int:
    """Watch a folder while a process runs; return how often its names changed, at most ``until``."""
    count, before = 0, names_in(out)
    while process.runs() and (until is None or count < until):
        time.sleep(POLL)
        now = names_in(out)
        count, before = count + (now != before), now
    return count


def killed(process: Process, out: Path, rng: random.Random, seconds: float, events: int) -> Ended:
    """Kill a process at a random moment of the seconds and events that a whole run has; it may end before."""
    number = rng.choices(list(SIGNALS), SIGNALS.values())[0]
    if rng.random() < 0.5:
        moment = process.began + rng.uniform(0.2, 1.0) * seconds
        while process.runs() and time.monotonic() < moment:
            time.sleep(POLL)
    else:
        changes(out, process, rng.randint(1, max(1, events)))
    process.kill(number)
    return process.wait()


def left_over(out: Path) -> list[str]:
    """Return temporary files and locks in a folder and beside it."""
    near = [path for path in out.parent.iterdir() if path.name.startswith(f".{out.name}.")]
    return [str(path) for path in (*near, *out.rglob(".*")) if LEFT_OVER.fullmatch(path.name)]
