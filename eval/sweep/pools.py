"""Open pools of workers that run the episodes of a sweep: processes of this machine, or of a Ray cluster."""

import contextlib
import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from vssm_gym.errors import InputError
from vssm_gym.eval.sweep import worker
from vssm_gym.eval.sweep.own_agents import GUARD

if TYPE_CHECKING:
    from vssm_gym.agents.base import Agent

WORKERS = 2  # processes on this machine, unless another number is asked for


@runtime_checkable
class Pool(Protocol):
    """Run jobs in worker processes, each with one thread, and return their rows as futures."""

    machines: int  # that have compilation caches of their own
    processes: int  # jobs that run at once

    def submit(self, job: worker.Job, machine: int | None = None) -> "Future[dict[str, Any]]":
        """Return the future row of a job; ``machine`` says where it should run, None: anywhere."""
        ...

    def stop(self) -> None:
        """Begin no further job; those that have begun, or wait in Ray for a CPU, go on."""
        ...

    def close(self) -> None:
        """End all worker processes."""
        ...

    def lost(self, kept: str) -> InputError:
        """Return the error for a pool that raised ``BrokenExecutor``; ``kept`` says which episodes there are."""
        ...


PoolOf = Callable[[int], Pool]  # opens a pool for a number of jobs


class LocalPool:
    """Run jobs in spawned processes of this machine; one that dies breaks the pool."""

    machines = 1

    def __init__(self, processes: int, own: "tuple[type[Agent], ...]" = ()) -> None:
        worker.check_semaphores()
        self._children = contextlib.ExitStack()
        self._children.enter_context(worker.single_threaded_children())
        context = multiprocessing.get_context("spawn")
        self._started = context.Event()
        arguments = self._started, own
        self.processes = processes
        self._pool = ProcessPoolExecutor(processes, context, initializer=worker.initialise, initargs=arguments)

    def submit(self, job: worker.Job, machine: int | None = None) -> "Future[dict[str, Any]]":
        """Return the future row of a job."""
        return self._pool.submit(worker.run, job)

    def stop(self) -> None:
        """Begin no further job; one that we cancelled ourselves would break the pool."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def close(self) -> None:
        """End all worker processes; the environment of this process is as it was before."""
        self._pool.shutdown(wait=True, cancel_futures=True)
        self._children.close()

    def lost(self, kept: str) -> InputError:
        """Return the error for a worker that died, or never started."""
        if not self._started.is_set():
            expected = f"worker processes that can import this program: start the sweep below {GUARD}"
            return InputError("sweep", "workers", expected)
        expected = "worker processes that live to the end; one was killed, possibly for lack of memory"
        return worker.WorkerDiedError("sweep", "workers", f"{expected}; {kept}")


@contextlib.contextmanager
def pools(workers: int | None, ray: str | None, own: "tuple[type[Agent], ...]" = ()) -> Iterator[PoolOf]:
    """Yield a function that opens a pool.

    Args:
        workers: processes at most; None: WORKERS on this machine, one for each CPU of a cluster.
        ray: address of a Ray cluster; None: this machine.
        own: classes of the agents that the program has registered.

    Raises:
        InputError: as :func:`vssm_gym.cluster.ray_cluster.connected`.
    """
    if ray is None:
        yield lambda jobs: LocalPool(min(workers or WORKERS, jobs), own)
        return
    from vssm_gym.cluster.ray_cluster import connected
    from vssm_gym.eval.sweep.ray_pool import RayPool

    with connected(ray, worker.one_thread()) as cluster:
        # One waits for each CPU, unless a number was asked for: on a CPU that is free it would be one more.
        waiting = lambda: 0 if workers else cluster.cpus
        yield lambda jobs: RayPool(cluster, min(workers or cluster.cpus, jobs), waiting(), own)
