"""Run the units of SLAM and prediction, each process one after the other, and keep a row of each.

A unit whose process dies, or does not return, is a failure of its entry; the next one gets a new process.
"""

import multiprocessing
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, Protocol, TypeVar

from vssm_gym.envs.validation import StrictModel
from vssm_gym.errors import InputError, OutputError
from vssm_gym.eval.studies.row_file import read_rows
from vssm_gym.eval.sweep import worker
from vssm_gym.eval.sweep.own_agents import GUARD
from vssm_gym.eval.sweep.rounds import SIGNAL_SECONDS
from vssm_gym.eval.sweep.supervision import DEAD, reason_of
from vssm_gym.files.line_file import LineFile
from vssm_gym.progress import OnProgress
from vssm_gym.version import package_version

ROWS = "rows.jsonl"
NOTHING: dict[str, Any] = {"p95": None, "measured": {}, "content": None}  # of a unit that has measured nothing


class UnitRow(StrictModel):
    """Hold what a unit has measured.

    ``score`` is the track's, also of a failure; ``p95`` seconds of a decision; ``content`` a hash of what it was given.
    """

    entry: str
    unit: str
    scene: str | None = None  # of a drive: those of one scene are not independent
    score: float
    success: bool
    fault: str | None
    p95: float | None
    measured: dict[str, float]
    content: str | None
    version: str


class _Unit(Protocol):
    """Describe a unit: an entry's label, the name of what it runs on, and the scene that it shares with others."""

    @property
    def entry(self) -> str: ...

    @property
    def unit(self) -> str: ...

    @property
    def cluster(self) -> str | None: ...


U = TypeVar("U", bound=_Unit)


def run_units(
    units: Sequence[U],
    run: Callable[[U], dict[str, Any]],
    worst: Callable[[U], float],
    folder: Path,
    workers: int = 1,
    on_progress: OnProgress | None = None,
) -> Path:
    """Run the units that have no row in ``folder`` yet; return the file of the rows.

    Args:
        units: to be run, in order.
        run: runs one, in another process: a function at the top level of a module.
        worst: the score of a unit whose process has died.
        folder: that keeps the rows.
        workers: number of processes.
        on_progress: called with ("runs", done, total).
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / ROWS
    done = {(row["entry"], row["unit"]) for row in read_rows(path, UnitRow)}
    keep = path.read_bytes().rfind(b"\n") + 1 if path.is_file() else None
    waiting = deque(unit for unit in units if (unit.entry, unit.unit) not in done)
    idle: list[ProcessPoolExecutor] = []  # of one process each, so that what dies costs its own unit alone
    running: dict[Future[dict[str, Any]], tuple[U, ProcessPoolExecutor]] = {}
    try:
        with LineFile(path, keep=keep) as file:
            while waiting or running:
                if on_progress:
                    on_progress("runs", len(units) - len(waiting) - len(running), len(units))
                while waiting and len(running) < workers:
                    pool = idle.pop() if idle else _pool()
                    try:
                        running[pool.submit(run, waiting[0])] = waiting[0], pool
                    except BrokenProcessPool:  # it has died since its last unit, which has a row
                        pool.shutdown(wait=False)
                    else:
                        waiting.popleft()
                ended = wait(running, return_when=FIRST_COMPLETED).done
                for future in sorted(ended, key=_refuses):  # what another one has measured is kept first
                    unit, pool = running[future]
                    found, fault = _outcome(future)
                    if fault == DEAD:
                        time.sleep(SIGNAL_SECONDS)  # a signal to all processes interrupts this one then: it is no fault
                        pool.shutdown(wait=False)
                    else:
                        idle.append(pool)
                    del running[future]
                    if fault is not None:
                        found = {"score": worst(unit), "success": False, "fault": fault, **NOTHING}
                    row = UnitRow(
                        entry=unit.entry, unit=unit.unit, scene=unit.cluster, version=package_version(), **found
                    )
                    file.append(row.model_dump_json().encode() + b"\n", sync=True)
    except (InputError, OutputError) as error:
        raise error.with_traceback(None) from None
    finally:
        _end([*idle, *(pool for _, pool in running.values())])
    if on_progress:
        on_progress("runs", len(units), len(units))
    return path


def _refuses(future: Future[dict[str, Any]]) -> bool:
    """Return True for a unit whose error ends the run."""
    return isinstance(future.exception(), InputError | OutputError)


def _outcome(future: Future[dict[str, Any]]) -> tuple[dict[str, Any], str | None]:
    """Return what a unit has measured, and the fault that kept it from that."""
    try:
        return future.result(), None
    except BrokenProcessPool:
        return {}, DEAD
    except (InputError, OutputError):
        raise
    except Exception as error:  # of code that the entry has left behind, such as a patched library
        return {}, reason_of(error)


def _end(pools: Sequence[ProcessPoolExecutor]) -> None:
    """End the processes of pools; one that runs would hold up an interrupted command."""
    processes = [process for pool in pools for process in (pool._processes or {}).values()]
    for pool in pools:
        pool.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        process.terminate()
    for process in processes:  # its time counts once it has been waited for
        process.join()


def _pool() -> ProcessPoolExecutor:
    """Start a process with one thread, as those of sweeps are, so that times can be compared.

    Raises:
        InputError: a process that ends before it has begun, or a machine without semaphores.
    """
    worker.check_semaphores()
    with worker.single_threaded_children():
        pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=worker.initialise)
        try:
            pool.submit(int).result()  # started while the limits hold
        except BrokenProcessPool:
            expected = f"processes that can start and import this program: start the benchmark below {GUARD}"
            raise InputError("benchmark", "workers", expected) from None
    return pool
