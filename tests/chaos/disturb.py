"""Kill a command at random moments, fill its disk, start it twice, and hold it to its claims."""

import contextlib
import random
import shutil
import time
from dataclasses import dataclass, field
from pathlib import Path

from tests.chaos.commands import Command
from tests.chaos.disks import small_disk
from tests.chaos.runs import (
    Ended,
    Process,
    arguments_of,
    changes,
    killed,
    left_over,
)

FULL = ("No space left on device", "File too large")


@dataclass
class Outcome:
    """Count what happened to a command, and list the claims that were violated."""

    kills: dict[str, int] = field(default_factory=dict)  # by signal
    undisturbed: int = 0  # runs that ended before their kill
    disks: int = 0
    pairs: int = 0
    seconds: float = 0.0
    violations: list[str] = field(default_factory=list)

    def claim(self, holds: bool, text: str, ended: Ended | None = None) -> None:
        """Note a violation unless the claim holds, with the end of what the run said."""
        if not holds:
            self.violations.append(text + (f" (exit {ended.code}: ...{ended.errors[-600:]})" if ended else ""))


class Chaos:
    """Disturb one command in folders under ``scratch``."""

    def __init__(self, name: str, command: Command, inputs: Path, scratch: Path, rng: random.Random) -> None:
        self.name, self.command, self.inputs, self.rng = name, command, inputs, rng
        self.scratch, self.outcome, self._folders = scratch, Outcome(), 0
        self.scratch.mkdir(parents=True)
        out = self._new()
        self._start(out).wait()  # fills the compilation cache
        shutil.rmtree(out)
        process = self._start(out)
        self.events = changes(out, process)
        whole = process.wait()
        self.seconds, self.size = whole.seconds, sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
        self.largest = max((path.stat().st_size for path in out.rglob("*") if path.is_file()), default=0)
        self.outcome.claim(whole.code == 0, "a run that nobody disturbs ends", whole)
        self.reference = command.result(out) if whole.code == 0 else None

    def kill(self, times: int) -> None:
        """Kill runs in one folder after the other until ``times`` were; let the last one in each folder end."""
        done = 0
        while done < times:
            out, kept = self._new(), {}
            for _ in range(self.rng.randint(1, 5)):
                ended = killed(self._start(out), out, self.rng, self.seconds, self.events)
                self.outcome.claim(not ended.left, "no process outlives a kill", ended)
                if ended.code == 0:
                    self.outcome.undisturbed += 1
                    break
                done += 1
                number = {130: "INT", -2: "INT", -9: "KILL", -15: "TERM", 143: "TERM"}.get(ended.code, str(ended.code))
                self.outcome.kills[number] = self.outcome.kills.get(number, 0) + 1
                self.outcome.claim(number in ("INT", "KILL", "TERM"), "a kill is no error", ended)
                if ended.code in (130, 143):
                    said = ended.lines and ended.lines[-1].startswith("interrupted: ")
                    one_line = bool(said) and "Traceback" not in ended.errors
                    self.outcome.claim(one_line, "an interruption is one line", ended)
                kept = self._check_kept(out, kept)
                if done == times or self._finished(out):
                    break
            self._finish(out, kept)

    def fill(self, disks: int, mounted: bool) -> None:
        """Run on disks that are too small by a random share, then on larger ones."""
        for _ in range(disks):
            share = self.rng.uniform(0.05, 0.9)
            folder = self.scratch / "disk"
            with contextlib.ExitStack() as stack:
                enlarge = stack.enter_context(small_disk(folder, int(share * self.size))) if mounted else None
                folder.mkdir(exist_ok=True)
                out = folder / "out"
                ended = self._start(out, None if enlarge else int(share * self.largest)).wait()
                self.outcome.disks += 1
                self.outcome.claim(ended.code == 1, f"a disk of {share:.0%} of the size ends a run with 1", ended)
                last = ended.lines[-1] if ended.lines else ""
                said = last.startswith("error: ") and last.endswith(FULL) and "Traceback" not in ended.errors
                self.outcome.claim(said, "a full disk is one line, after the progress", ended)
                kept = self.command.kept(out) if out.is_dir() else {}
                if enlarge:
                    enlarge()
                self._finish(out, kept)
            shutil.rmtree(folder, ignore_errors=True)

    def pair(self) -> None:
        """Start two runs on one folder, the second while the first one runs."""
        out = self._new()
        first = self._start(out)
        time.sleep(self.rng.uniform(0.0, 0.3) * self.seconds)
        both = self._start(out), first
        ended = [process.wait() for process in both]
        self.outcome.pairs += 1
        codes = sorted(one.code for one in ended)
        self.outcome.claim(codes == [0, 2], f"of two runs one ends and one is refused; found {codes}", ended[0])
        for one in ended:
            self.outcome.claim(one.code == 0 or one.refused_in_one_line, "a refusal is one line", one)
        if 0 in codes:
            self.outcome.claim(self.command.result(out) == self.reference, "two at once end as one alone")

    def _new(self) -> Path:
        self._folders += 1
        return self.scratch / f"out-{self._folders}"

    def _start(self, out: Path, largest: int | None = None) -> Process:
        return Process(arguments_of(self.command, self.inputs, out), self.scratch, self.command.before, largest)

    def _check_kept(self, out: Path, before: dict) -> dict:
        """Compare what is finished now with what was before; return it."""
        now = self.command.kept(out) if out.is_dir() else {}
        lost = [name for name, value in before.items() if now.get(name) != value]
        self.outcome.claim(not lost, f"what was finished stays; lost or changed: {lost[:3]}")
        return now

    def _finished(self, out: Path) -> bool:
        """Return whether the output is whole, although its run was killed: the next run is refused."""
        return self.command.final is not None and (out / self.command.final).is_file()

    def _finish(self, out: Path, kept: dict) -> None:
        """Let a last run end, or be refused because all was finished; then nothing may change any more."""
        finished = self._finished(out)
        ended = self._start(out).wait()
        if finished:
            self.outcome.claim(ended.refused_in_one_line, "a finished output is never overwritten", ended)
        else:
            self.outcome.claim(ended.code == 0, "the next run ends", ended)
        if out.is_dir():
            self._check_kept(out, kept)
            result = self.command.result(out)
            differs = "" if result == self.reference else f": {result} and not {self.reference}"[:600]
            self.outcome.claim(not differs, f"{out.name} has the undisturbed results{differs}")
            self.outcome.claim(not left_over(out), f"no temporary file stays: {left_over(out)[:3]}")
            shutil.rmtree(out)
