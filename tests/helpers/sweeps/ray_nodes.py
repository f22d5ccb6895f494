"""Start a Ray cluster of two nodes with one CPU each on this machine, in process groups of its own."""

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Collection, Iterator
from pathlib import Path

PATIENCE = 120.0  # s within which a node starts
MEMORY = 200_000_000  # bytes of a node's object store


class Nodes:
    """Hold the address of a cluster, and the two processes that `ray start` runs as."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.processes = folder, list[subprocess.Popen]()
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self.address = f"127.0.0.1:{port}"
        self._start("--head", "--port", str(port), "--include-dashboard=false", "--temp-dir", str(folder))
        self._start("--address", self.address)

    def _start(self, *arguments: str) -> None:
        log = self.folder / f"node-{len(self.processes)}.log"
        ray = Path(sys.executable).with_name("ray")
        command = [ray, "start", "--block", "--num-cpus", "1", "--object-store-memory", str(MEMORY), *arguments]
        with log.open("wb") as out:
            self.processes.append(
                subprocess.Popen(
                    command,
                    stdout=out,
                    stderr=out,
                    start_new_session=True,
                    env=os.environ | {"RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"},
                )
            )
        deadline = time.monotonic() + PATIENCE
        while "Ray runtime started" not in log.read_text():
            assert self.processes[-1].poll() is None and time.monotonic() < deadline, log.read_text()
            time.sleep(0.1)

    def kill(self, number: int) -> None:
        """Kill all processes of a node at once, as when a machine loses its power."""
        process = self.processes[number]
        for pid in [*workers(process.pid), *children(process.pid)]:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()

    def workers(self) -> list[int]:
        """Return the processes that are running a call."""
        return [pid for process in self.processes for pid in workers(process.pid)]

    def kill_workers(self, but: Collection[int] = ()) -> set[int]:
        """Kill the processes that are running a call, other than some; return those that lived."""
        killed = set()
        for pid in set(self.workers()) - set(but):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
                killed.add(pid)
        return killed

    def files(self) -> list[Path]:
        """Return the files that calls have brought to the nodes."""
        return [path for path in self.folder.glob("session_*/vssm_gym/**/*") if path.is_file()]


def children(pid: int) -> list[int]:
    """Return the processes below a process, its children before theirs."""
    found = subprocess.run(["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True, check=False)
    direct = [int(word) for word in found.stdout.split()]
    return [*direct, *(one for child in direct for one in children(child))]


def workers(pid: int) -> list[int]:
    """Return the processes below a process that run a call now: Ray names them after its function."""
    found = []
    for child in children(pid):
        with contextlib.suppress(OSError):
            if Path(f"/proc/{child}/cmdline").read_bytes().startswith(b"ray::_call"):
                found.append(child)
    return found


@contextlib.contextmanager
def two_nodes() -> Iterator[Nodes]:
    """Run a cluster of two nodes; its sockets need a short path."""
    folder = Path(tempfile.mkdtemp(prefix="ray-", dir="/tmp"))
    nodes = None
    try:
        nodes = Nodes(folder)
        yield nodes
    finally:
        for number in range(len(nodes.processes) if nodes else 0):
            nodes.kill(number)
        shutil.rmtree(folder, ignore_errors=True)
