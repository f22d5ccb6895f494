"""Apply mutants to copies of the checkout, each in its own, and run their tests in a process of its own.

The tests of each mutant must pass without it first. They do so in one copy that all mutants are then copied from, with
the caches that numba filled there: it keeps compiled code beside its source, and recompiles only where that file has
changed. A copy with a mutant in a compiled function loses them all, since a cached function does not notice a change
of another one that it calls. JAX's cache is keyed by the program and serves all copies.
"""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from tests.mutants.mutant import Mutant, StaleMutantError

COPIED, LINKED = ("vssm_gym", "agents", "eval", "tests", "pyproject.toml"), ("envs",)  # envs holds assets only
TIME_LIMIT = 300.0  # s, of the tests of one mutant
RUN_TESTS = Path(__file__).with_name("run_tests.py")
PYTEST = ("-x", "-m", "not slow", "-p", "no:cacheprovider", "--tb=no", "-rf")
PASSED, FAILED = 0, 1  # pytest's exit codes
RUNNING: set[subprocess.Popen[str]] = set()  # of all workers, each the leader of its own process group


@dataclass(frozen=True)
class Outcome:
    """Hold the outcome of one run of tests.

    Attributes:
        name: of the mutant, or of the test files of a run without one.
        verdict: ``passes`` or ``broken`` without a mutant; ``caught``, ``missed``, ``stale`` or ``broken`` with one.
        detail: the test that failed, or why there is no verdict.
        seconds: that it took.
    """

    name: str
    verdict: str
    detail: str
    seconds: float


@dataclass(frozen=True)
class Run:
    """Hold pytest's exit code (None: out of time) and its output."""

    code: int | None
    output: str

    @property
    def failed(self) -> str | None:
        """Return the first test that failed by itself; None for errors of collection, set-up or the process."""
        found = re.search(r"^FAILED (.+?)(?: - .*)?$", self.output, re.MULTILINE)
        return found[1] if found and self.code == FAILED else None

    @property
    def reason(self) -> str:
        """Return why there is no verdict."""
        if self.code is None:
            return f"out of time after {TIME_LIMIT:.0f} s"
        lines = [line for line in self.output.splitlines() if line.strip()]
        return f"exit code {self.code}: {lines[-1] if lines else 'no output'}"


def copy_checkout(source: Path, target: Path) -> None:
    """Copy code and tests with their times and compiled caches, links as links; link what is data."""
    target.mkdir(parents=True)
    for name in COPIED:
        if (source / name).is_dir():
            shutil.copytree(source / name, target / name, symlinks=True)
        elif (source / name).exists():
            shutil.copy2(source / name, target / name)
    for name in LINKED:
        if (source / name).exists():
            (target / name).symlink_to((source / name).resolve())
    shared = source.parent / "shared"  # recordings beside the checkout, of the tests that use them
    if shared.is_dir() and not (target.parent / "shared").exists():
        (target.parent / "shared").symlink_to(shared.resolve())


def run_tests(copy: Path, tests: Sequence[str]) -> Run:
    """Run tests in a copy; stop them, and the processes that they started, at the time limit."""
    process = subprocess.Popen(
        [sys.executable, str(RUN_TESTS), str(copy), *PYTEST, *tests],
        cwd=copy,
        # Processes that tests start import this copy too. In CI, hypothesis does not shrink what fails.
        env={**os.environ, "PYTHONPATH": str(copy), "CI": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    RUNNING.add(process)
    try:
        output, _ = process.communicate(timeout=TIME_LIMIT)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        return Run(None, process.communicate()[0])
    finally:
        RUNNING.discard(process)
    return Run(process.returncode, output)


def passes(copy: Path, tests: Sequence[str]) -> Outcome:
    """Run tests without a mutant."""
    began = time.monotonic()
    run = run_tests(copy, tests)
    verdict, detail = ("passes", "") if run.code == PASSED else ("broken", run.failed or run.reason)
    return Outcome("without a mutant: " + ", ".join(files_of(tests)), verdict, detail, time.monotonic() - began)


def files_of(tests: Sequence[str]) -> tuple[str, ...]:
    """Return the files in which tests are."""
    return tuple(dict.fromkeys(test.partition("::")[0] for test in tests))


def try_mutant(mutant: Mutant, source: Path, copy: Path) -> Outcome:
    """Run a mutant's tests in a copy of its own, which is removed."""
    began = time.monotonic()
    try:
        text = mutant.mutated(source)
        copy_checkout(source, copy)
        (copy / mutant.file).write_text(text)
        forget_compiled(copy, mutant.file)
        run = run_tests(copy, mutant.tests)
    except StaleMutantError as stale:
        return Outcome(mutant.name, "stale", str(stale), time.monotonic() - began)
    finally:
        shutil.rmtree(copy, ignore_errors=True)
    if run.failed:
        verdict, detail = "caught", run.failed
    else:
        verdict, detail = ("missed", "") if run.code == PASSED else ("broken", run.reason)
    return Outcome(mutant.name, verdict, detail, time.monotonic() - began)


def forget_compiled(copy: Path, file: str) -> None:
    """Remove the bytecode of a file, and numba's caches if it holds functions that numba compiles."""
    path = copy / file
    for cached in path.parent.glob(f"__pycache__/{path.stem}.*"):
        cached.unlink()
    if "njit" in path.read_text():
        for cached in [*copy.rglob("*.nbi"), *copy.rglob("*.nbc")]:
            cached.unlink()


def outcomes(mutants: Sequence[Mutant], checkout: Path, scratch: Path, workers: int) -> Iterator[Outcome]:
    """Yield outcomes of the tests without a mutant, file by file, then of each mutant whose tests pass without it."""
    clean = scratch / "clean" / "checkout"
    copy_checkout(checkout, clean)
    tests: dict[tuple[str, ...], dict[str, None]] = {}
    for mutant in mutants:
        tests.setdefault(files_of(mutant.tests), {}).update(dict.fromkeys(mutant.tests))
    broken: set[tuple[str, ...]] = set()
    with ThreadPoolExecutor(workers) as pool:
        try:
            runs = pool.map(lambda group: passes(clean, tuple(group)), tests.values())
            for files, outcome in zip(tests, runs, strict=True):
                yield outcome
                if outcome.verdict != "passes":
                    broken.add(files)
            usable = [(scratch / m.name / "checkout", m) for m in mutants if files_of(m.tests) not in broken]
            yield from pool.map(lambda one: try_mutant(one[1], clean, one[0]), usable)
        except BaseException:  # an interruption: do not wait for tests whose outcome nobody reads
            pool.shutdown(wait=False, cancel_futures=True)
            for process in tuple(RUNNING):
                os.killpg(process.pid, signal.SIGKILL)
            raise
    unusable = [m.name for m in mutants if files_of(m.tests) in broken]
    yield from (Outcome(name, "broken", "its tests fail without it", 0.0) for name in unusable)
