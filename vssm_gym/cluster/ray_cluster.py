"""Call functions on a Ray cluster, each on a CPU of its own, from ordinary futures; files travel by their content.

A call that loses its process or its machine is repeated by Ray. A machine on which another version of the package or
of its libraries is installed is refused. Files that calls read are put into Ray's object store, and written once on
each machine, into the folder of Ray's session there, which is emptied of them at the end.
"""

import contextlib
import hashlib
import importlib.util
import itertools
import logging
import os
import shutil
import signal
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from vssm_gym.cluster.address import check_address
from vssm_gym.cluster.installed import check_same, installed
from vssm_gym.errors import InputError
from vssm_gym.files.atomic import atomic_write

LEASE_SECONDS = 20.0  # s that a worker is kept for the next calls; Ray has 0.5, and a free one is found within 0.1
MOST_LOSSES = 3  # times that a call may lose its process or machine and is repeated
REMOVAL_SECONDS = 5.0  # s that nodes have to remove files
FILES = "vssm_gym"  # folder in that of Ray's session


class CallLost(BrokenExecutor):
    """Report a call that was lost with its process or machine more than ``MOST_LOSSES`` times, or with the cluster."""


@dataclass(frozen=True)
class SharedFile:
    """Hold a file that travels: its name, a hash of its content, and the content in Ray's object store."""

    name: str
    digest: str
    folder: str  # of all files of one :class:`Calls`
    content: Any  # a reference, which is not fetched where the file is there

    def path(self) -> Path:
        """Return the file on the machine of the call, which the first call there writes."""
        import ray

        path = _files(self.folder) / self.digest / self.name
        if not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(path) as temporary:
                temporary.write_bytes(ray.get(self.content))
        return path


class Cluster:
    """Describe a cluster that this process is connected to, as it is when it is asked: machines join and leave.

    Args:
        variables: of the environment of all processes that run calls.
    """

    def __init__(self, variables: Mapping[str, str]) -> None:
        self.variables, self.numbers = dict(variables), itertools.count()
        _ = self.cpus

    @property
    def cpus(self) -> int:
        """Return the number of CPUs; raise :class:`InputError` where there is none."""
        if not (nodes := _alive()):
            raise InputError("--ray", "cluster", "a node with a CPU; the cluster has none")
        return sum(int(node["Resources"]["CPU"]) for node in nodes)

    @property
    def nodes(self) -> list[str]:
        """Return the nodes."""
        return [node["NodeID"] for node in _alive()]

    @property
    def machines(self) -> list[str]:
        """Return one node of each machine."""
        return list({node["NodeManagerAddress"]: node["NodeID"] for node in _alive()}.values())

    def check(self) -> None:
        """Raise :class:`InputError` where a node lacks the package, or has other versions than this machine.

        The processes that this starts run the first calls.
        """
        nodes = self.nodes
        with contextlib.closing(Calls(self, len(nodes), number=0)) as calls:
            for future in [calls.submit(os.getpid, node=node) for node in nodes]:
                try:
                    future.result()
                except InputError:
                    raise
                except Exception as error:
                    last = (str(error).strip().splitlines() or [type(error).__name__])[-1]
                    expected = f"nodes whose Python has vssm_gym and its libraries; one answers: {last}"
                    raise InputError("--ray", "cluster", expected) from None


def _alive() -> list[dict[str, Any]]:
    """Return the nodes that have a CPU, as Ray describes them."""
    import ray

    return [node for node in ray.nodes() if node["Alive"] and node["Resources"].get("CPU", 0) >= 1]


class Calls:
    """Run calls on a cluster, at most ``most`` at a time; each call has a CPU, and processes are kept between calls.

    Args:
        cluster: that this process is connected to.
        most: calls at a time.
        waiting: more calls that Ray holds, to be begun as soon as it has a CPU for them, without an answer of ours.
        number: calls of one number share their processes; None: the next number, whose memory is that of no others.
    """

    def __init__(self, cluster: Cluster, most: int, waiting: int = 0, number: int | None = None) -> None:
        import ray

        self._cluster = cluster
        number = next(cluster.numbers) if number is None else number
        self._folder = f"{ray.get_runtime_context().get_job_id()}-{number}"
        self._environment = {"env_vars": {**cluster.variables, "VSSM_GYM_CALLS": self._folder}}
        self._remote = ray.remote(num_cpus=1, max_retries=MOST_LOSSES, runtime_env=self._environment)(_call)
        self._threads = ThreadPoolExecutor(most + waiting, thread_name_prefix="ray-call")
        self._lock, self._running, self._shared = threading.Lock(), set[Any](), dict[str, SharedFile]()

    def submit(
        self,
        function: Callable[..., Any],
        *arguments: Any,
        node: str | None = None,
        then: Callable[[Any], Any] | None = None,
    ) -> Future:
        """Return the future of ``function(*arguments)``.

        It raises what the function has raised, :class:`CallLost`, and :class:`InputError` on a machine that differs.

        Args:
            function: at the top level of a module.
            arguments: its arguments; they are pickled by Ray.
            node: on which it runs if that has a CPU; None: any.
            then: called here with what the function returned; what it returns is the result.
        """
        return self._threads.submit(self._run, function, arguments, node, then)

    def share(self, path: Path) -> SharedFile:
        """Put the content of a file into the object store, once."""
        import ray

        content = path.read_bytes()
        digest = hashlib.sha256(content).hexdigest()[:16]
        key = digest + path.name
        with self._lock:
            if (found := self._shared.get(key)) is None:
                found = self._shared[key] = SharedFile(path.name, digest, self._folder, ray.put(content))
        return found

    def stop(self) -> None:
        """Hand no further call to Ray; those that it holds are run."""
        self._threads.shutdown(wait=False, cancel_futures=True)

    def interrupt(self) -> None:
        """Interrupt the calls that have begun, as Ctrl-C would."""
        import ray

        with self._lock:
            for reference in self._running:
                ray.cancel(reference, force=False)

    def close(self) -> None:
        """End all calls, and remove what :meth:`share` has brought to the machines."""
        import ray
        from ray.exceptions import RayError
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        self.stop()
        with self._lock:
            for reference in self._running:
                ray.cancel(reference, force=True)
        self._threads.shutdown(wait=True)
        if self._shared and ray.is_initialized():
            self._shared.clear()
            remove = ray.remote(num_cpus=0, max_retries=MOST_LOSSES, runtime_env=self._environment)(_remove_files)
            on = [NodeAffinitySchedulingStrategy(node, soft=False) for node in self._cluster.nodes]
            removed = [remove.options(scheduling_strategy=one).remote(self._folder) for one in on]
            ready, _ = ray.wait(removed, num_returns=len(removed), timeout=REMOVAL_SECONDS)
            for one in ready:
                with contextlib.suppress(RayError):  # of a node that has died
                    ray.get(one)

    def _run(
        self,
        function: Callable[..., Any],
        arguments: tuple[Any, ...],
        node: str | None,
        then: Callable[[Any], Any] | None,
    ) -> Any:
        """Run a call and wait for it, in a thread of its own."""
        import ray
        from ray.exceptions import RayError, RayTaskError, TaskCancelledError
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        remote = self._remote
        if node is not None:
            remote = remote.options(scheduling_strategy=NodeAffinitySchedulingStrategy(node, soft=True))
        reference = remote.remote(function, installed(), arguments)
        with self._lock:
            self._running.add(reference)
        try:
            result = ray.get(reference)
        except TaskCancelledError:
            raise KeyboardInterrupt from None
        except RayTaskError as error:
            raise error.cause from RuntimeError(str(error))  # which has the traceback of the machine
        except RayError as error:
            raise CallLost(" ".join(str(error).split())) from error
        finally:
            with self._lock:
                self._running.discard(reference)
        return result if then is None else then(result)


@contextlib.contextmanager
def connected(address: str, variables: Mapping[str, str]) -> Iterator[Cluster]:
    """Connect to a cluster, one of whose nodes is this machine, and check all of its nodes.

    A program that is connected already stays so. Signals go on doing what they did.

    Args:
        address: ``auto`` or ``HOST:PORT``.
        variables: of the environment of the processes that run calls, beside those that the nodes have.

    Raises:
        InputError: no such cluster; Ray is not installed; a node that has no CPU, not the package, or other versions.
    """
    check_address(address)
    if importlib.util.find_spec("ray") is None:
        raise InputError("--ray", "ray", 'the extra "cluster": pip install -c constraints.txt ".[cluster]"')
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent; both are read at the import
    os.environ.setdefault("RAY_worker_lease_timeout_milliseconds", f"{LEASE_SECONDS * 1000:.0f}")
    import ray

    mine = not ray.is_initialized()
    if mine:
        before = signal.getsignal(signal.SIGTERM)
        try:
            ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
        except Exception as error:  # of many classes: no cluster, no node here, another version of Ray or Python
            found = " ".join(str(error).split())
            expected = f"a running cluster with this machine as a node (`ray start`); Ray says: {found}"
            raise InputError("--ray", "address", expected) from None
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, before)  # Ray would end the process at once
    try:
        cluster = Cluster(variables)
        cluster.check()
        yield cluster
    finally:
        if mine:
            ray.shutdown()


def _call(function: Callable[..., Any], expected: Mapping[str, str], arguments: tuple[Any, ...]) -> Any:
    """Run a call in a process of the cluster."""
    _check(tuple(expected.items()))
    return function(*arguments)


@cache
def _check(expected: tuple[tuple[str, str], ...]) -> None:
    check_same(dict(expected), installed(), socket.gethostname())


def _files(folder: str) -> Path:
    """Return the folder of shared files of this node."""
    import ray

    here = ray.get_runtime_context()
    return Path(here.get_temp_dir(), here.get_session_name(), FILES, folder, here.get_node_id()[:12])


def _remove_files(folder: str) -> None:
    shutil.rmtree(_files(folder).parent, ignore_errors=True)
