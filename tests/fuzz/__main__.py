"""Feed damaged files to every reader, in worker processes with limits of time and memory.

    python -m tests.fuzz [--cases 10000] [--seed 0] [--workers 2] [--first 0] [--out DIR]

The first cases are the special ones; the others are mutations, each from the seed and its number. Fails where a reader
neither reads nor refuses with one clear error, within ``SECONDS`` of CPU time and ``MEGABYTES`` above the process after
imports. ``--out`` keeps the inputs of those cases. Linux only: memory is read from ``/proc``.
"""

import argparse
import contextlib
import json
import os
import queue
import select
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

SECONDS, MEGABYTES = 10.0, 1000.0  # what a refusal may cost; a file that is read may cost more memory
CPU_PATIENCE, WALL_PATIENCE = 90.0, 600.0  # s until a worker is killed; it may wait for a busy machine, or for ever
CHECKOUT = Path(__file__).resolve().parents[2]


@dataclass
class Tally:
    """Count outcomes by reader, and keep the failures."""

    kinds: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    megabytes: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    failures: list[str] = field(default_factory=list)

    def add(self, case: int, answer: dict[str, Any]) -> bool:
        """Count an answer; return True for a failure."""
        reader, kind = answer["reader"], answer["kind"]
        self.kinds[reader][kind] += 1
        self.seconds[reader] = max(self.seconds[reader], answer["seconds"])
        self.megabytes[reader] = max(self.megabytes[reader], answer["megabytes"])
        why = kind if kind not in ("read", "refused") else ""
        if kind == "refused" and (answer["seconds"] > SECONDS or answer["megabytes"] > MEGABYTES):
            why = "over budget"
        if kind == "read" and answer["seconds"] > 6.0 * SECONDS:
            why = "over budget"
        if why:
            cost = f"{answer['seconds']:.1f} s, {answer['megabytes']:.0f} MB"
            self.failures.append(f"case {case}: {reader}: {why}, {cost}, {answer['how']}\n{answer['said']}")
        return bool(why)

    def table(self) -> str:
        """Return a line for each reader."""
        lines = ["reader              cases   read  refused  failed  most s  most MB"]
        for name in sorted(self.kinds):
            kinds = self.kinds[name]
            cases, read, refused = kinds.total(), kinds["read"], kinds["refused"]
            failed = cases - read - refused
            cost = f"{self.seconds[name]:7.1f} {self.megabytes[name]:8.0f}"
            lines.append(f"{name:18s} {cases:6d} {read:6d} {refused:8d} {failed:7d} {cost}")
        return "\n".join(lines)


class Worker:
    """Run the readers in a process that is replaced when it dies or hangs."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None

    def ask(self, question: dict[str, Any]) -> dict[str, Any]:
        """Return the worker's answer, or one that says how the worker ended."""
        if self._process is None or self._process.poll() is not None:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "tests.fuzz.worker"],
                cwd=CHECKOUT,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
            )
            if self._line(600.0) is None:
                raise SystemExit("a worker does not start: run `python -m tests.fuzz.worker` to see why")
        process = self._process
        assert process.stdin is not None
        process.stdin.write(json.dumps(question) + "\n")
        process.stdin.flush()
        started = time.monotonic()
        spent = _cpu_seconds(process.pid)
        while process.poll() is None and time.monotonic() - started < WALL_PATIENCE:
            if (line := self._line(1.0)) is not None:
                return json.loads(line)
            if _cpu_seconds(process.pid) - spent > CPU_PATIENCE:
                break
        waited = time.monotonic() - started
        kind = "hang" if process.poll() is None else f"exit {process.returncode}"
        self.close()
        return {"reader": "?", "how": "", "kind": kind, "said": "", "seconds": waited, "megabytes": 0.0}

    def close(self) -> None:
        """Kill the process."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def _line(self, seconds: float) -> str | None:
        """Return the next line of the worker; None where it ends, or writes none for so long."""
        assert self._process is not None and self._process.stdout is not None
        ready, _, _ = select.select([self._process.stdout], [], [], seconds)
        return (self._process.stdout.readline() or None) if ready else None


def _cpu_seconds(pid: int) -> float:
    """Return the CPU time of a process, s; 0 where it has ended."""
    with contextlib.suppress(OSError):
        words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
    return 0.0


def run(cases: Iterable[int], seed: int, workers: int, out: Path | None = None) -> Tally:
    """Run the cases of these numbers; return the tally."""
    tally, lock = Tally(), threading.Lock()
    numbers: queue.SimpleQueue[int] = queue.SimpleQueue()
    for case in cases:
        numbers.put(case)

    def work() -> None:
        worker = Worker()
        with contextlib.suppress(queue.Empty):
            while True:
                case = numbers.get_nowait()
                with tempfile.TemporaryDirectory() as name:
                    folder = Path(name)
                    answer = worker.ask({"seed": seed, "case": case, "folder": name})
                    with lock:
                        failed = tally.add(case, answer)
                    if failed and out is not None:
                        shutil.copytree(folder, out / f"case_{case}", dirs_exist_ok=True)
        worker.close()

    threads = [threading.Thread(target=work) for _ in range(workers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return tally


def main() -> None:
    """Run as the command line says; exit with 1 where a case failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("cases", 10_000), ("seed", 0), ("workers", 2), ("first", 0)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    started = time.monotonic()
    tally = run(range(given.first, given.first + given.cases), given.seed, given.workers, given.out)
    minutes = (time.monotonic() - started) / 60.0
    summary = f"{given.cases} cases, {len(tally.failures)} failures, {minutes:.1f} min"
    sys.stdout.write("\n\n".join([*tally.failures, tally.table(), summary]) + "\n")
    sys.exit(bool(tally.failures))


if __name__ == "__main__":
    main()
