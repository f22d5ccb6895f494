"""Hand jobs out to the processes of a pool, and go on with another pool where an agent has ended its process.

Where agents may fail, no more jobs are handed out than there are processes. If one of them ends its process, those that
ran are known: each runs again in a process of its own, and the one that ends that process, too, has failed.
"""

import itertools
import time
from collections.abc import Callable, Iterable
from concurrent.futures import BrokenExecutor, Future, as_completed
from dataclasses import replace
from typing import Any

from vssm_gym.eval.sweep import worker
from vssm_gym.eval.sweep.pools import PoolOf
from vssm_gym.eval.sweep.supervision import DEAD

SIGNAL_SECONDS = 0.5  # within which a signal that was sent to a group of processes has reached all of them


class Rounds:
    """Run jobs over pools that are opened one after the other.

    Args:
        pool_of: opens one.
        processes: jobs that there are, for the number of processes.
        keep: takes each row as it comes.
        kept: says which episodes there are, for an error.
    """

    def __init__(
        self, pool_of: PoolOf, processes: int, keep: Callable[[dict[str, Any]], None], kept: Callable[[], str]
    ) -> None:
        self._pool_of, self._processes, self._keep, self._kept = pool_of, processes, keep, kept
        self._futures: dict[Future, worker.Job] = {}
        self.pool = pool_of(processes)

    def run(self, jobs: Iterable[tuple[worker.Job, int | None]]) -> None:
        """Run jobs, each anywhere or on a machine, and keep their rows.

        Raises:
            InputError: a process has died, and its agent is not one that may fail; or none could be started.
        """
        waiting = list(jobs)
        while waiting:
            begun = self._until_one_dies(waiting)
            if begun is None:
                return
            left = waiting[begun:]
            for job in (suspects := self._suspects()):
                if len(suspects) > 1:
                    self._reopen(1)
                    if self._until_one_dies([(job, None)]) is None:
                        continue
                    self._suspects()
                self._reopen(1)
                if self._until_one_dies([(replace(job, fault=DEAD), None)]) is not None:
                    raise self.pool.lost(self._kept())
            self._reopen(self._processes)
            waiting = left

    def interrupted(self, on_ending: Callable[[int, int], None]) -> None:
        """Begin no further job, and keep the rows of those that have begun; ``on_ending`` is told (done, total)."""
        running = [future for future in self._futures if future.running() or future.done()]
        self.pool.stop()
        ended: Future | None
        for done, ended in enumerate(itertools.chain([None], as_completed(running))):
            if ended is not None and ended.exception() is None:
                self._take(ended)
            if running:
                on_ending(done, len(running))

    def close(self) -> None:
        """End all processes."""
        self.pool.close()

    def _take(self, future: Future) -> None:
        row = future.result()
        del self._futures[future]
        self._keep(row)

    def _until_one_dies(self, jobs: list[tuple[worker.Job, int | None]]) -> int | None:
        """Run jobs; return how many had begun when a process died, None where all have their rows."""
        supervised = jobs[0][0].agent_seconds is not None
        at_once = self.pool.processes if supervised else len(jobs)
        begun = 0
        try:
            while begun < len(jobs) or self._futures:
                for job, machine in jobs[begun : begun + at_once - len(self._futures)]:
                    self._futures[self.pool.submit(job, machine)] = job
                    begun += 1
                for future in as_completed(list(self._futures)):
                    self._take(future)
                    if supervised:
                        break
        except BrokenExecutor as error:
            time.sleep(SIGNAL_SECONDS)  # a signal to all processes may end a worker first: this one is then interrupted
            lost = self.pool.lost(self._kept())
            if not supervised or not isinstance(lost, worker.WorkerDiedError):
                raise lost from error
            return begun
        return None

    def _suspects(self) -> list[worker.Job]:
        """Keep the rows of those that ended before a process died; return the jobs of the others."""
        for future in [one for one in self._futures if one.done() and one.exception() is None]:
            self._take(future)
        found = list(self._futures.values())
        self._futures.clear()
        return found

    def _reopen(self, processes: int) -> None:
        """Open another pool."""
        self.pool.close()
        self.pool = self._pool_of(processes)
