"""Run episodes in a worker process of a sweep, which keeps a world, its map and the agents between them.

Workers are spawned and single-threaded: two on two cores then do twice the work, and an episode's floating-point sums
do not depend on the number of workers. Nothing is compiled twice.
"""

import contextlib
import ctypes
import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vssm_gym.envs.scenes.faults import SceneWarning
from vssm_gym.errors import InputError, OutputError
from vssm_gym.eval.episodes.identity import Episode
from vssm_gym.eval.episodes.recorder import Wrap, unwrapped
from vssm_gym.eval.metrics.failure import FAULT
from vssm_gym.eval.protocols.registry import protocol_of
from vssm_gym.eval.sweep.supervision import SupervisedAgent
from vssm_gym.instruction_set import cpu_model

if TYPE_CHECKING:  # a worker is up before it pays for JAX and MuJoCo
    from multiprocessing.synchronize import Event

    from vssm_gym.agents.base import Agent
    from vssm_gym.maps.voxel_map import VoxelMap

# NPROC is what XLA's CPU client sizes its thread pool by.
ONE_THREAD = {
    "NPROC": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
    "NUMEXPR_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
    "MALLOC_ARENA_MAX": "1",  # compiler threads come and go: one heap serves them all instead of one each
}


_compiled: set[tuple[str, str]] = set()  # agents that this process has run, and in which scenes


class WorkerDiedError(InputError):
    """Report a worker process that has ended before its episode did."""


@dataclass(frozen=True)
class Job:
    """Hold one episode to run, the files of its map and tasks, and the fields that sign its row."""

    episode: Episode
    map_file: Path | None  # None for an agent that needs no map
    map_hash: str | None
    task_file: Path
    scene_hash: str
    config_hash: str
    version: str
    explored_file: Path | None = None  # for the final map of an explorer
    agent_seconds: float | None = None  # of processor time that the agent may use; its errors are then failures
    fault: str | None = None  # with agent_seconds: why the agent has failed already, so that it is not run


def one_thread() -> dict[str, str]:
    """Return the variables of a process with one thread; its flags for XLA begin with those of this process."""
    flags = [os.environ.get("XLA_FLAGS"), ONE_THREAD["XLA_FLAGS"]]
    return ONE_THREAD | {"XLA_FLAGS": " ".join(filter(None, flags))}


@contextlib.contextmanager
def single_threaded_children() -> Iterator[None]:
    """Start processes in this context with numerical libraries limited to one thread; this process is unchanged.

    Libraries read these environment variables when they are loaded, before a pool's initializer could run.
    """
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(one_thread())
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def check_semaphores() -> None:
    """Raise :class:`InputError` where processes cannot wait for each other, as in a container without shared memory."""
    try:
        multiprocessing.get_context("spawn").Lock()
    except OSError as error:
        expected = f"semaphores, for which /dev/shm has to be writable; found: {error.strerror or error}"
        raise InputError("machine", "workers", expected) from None


def initialise(started: "Event | None" = None, own: "Sequence[type[Agent]]" = ()) -> None:
    """Initialise a worker: ignore Ctrl-C, which the parent handles, exit with the parent, and know the own agents.

    Args:
        started: set here; a worker that could not import the program never comes so far.
        own: classes of the agents that the program has registered.
    """
    if started is not None:
        started.set()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    prepare(own)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_leave_with, args=(parent.sentinel,), daemon=True).start()


def prepare(own: "Sequence[type[Agent]]") -> None:
    """Silence the notices of scenes, which the manifest has, and register the own agents."""
    warnings.simplefilter("ignore", SceneWarning)
    if own:
        from vssm_gym.agents.registry import register_agent

        for kind in own:
            register_agent(kind)


def _leave_with(sentinel: int) -> None:
    multiprocessing.connection.wait([sentinel])
    os._exit(1)


def run(job: Job, wrap: Wrap = unwrapped) -> dict[str, Any]:
    """Run one episode, in the environment that ``wrap`` returns, and return its row for the log."""
    episode = job.episode
    try:
        protocol = protocol_of(episode.condition.env)
        supervised = None if job.agent_seconds is None else _supervised(job, job.agent_seconds)
        agent = supervised or _agent(episode.agent)
        learned = _map(episode.condition.env, job.map_file) if job.map_file else None
        result = protocol.run(episode, agent, job.task_file, learned, wrap=wrap)
    except (InputError, OutputError):
        raise
    except Exception as error:  # of a class that only this process may know, so that its text is sent
        message = f"{episode.words()}: {type(error).__name__}: {error}"
        raise RuntimeError(message).with_traceback(error.__traceback__) from None
    if supervised is not None and supervised.fault is not None:
        result |= {"success": False, "failure": f"{FAULT}: {supervised.fault}"}
    if job.explored_file:
        result["explored"] = _keep(agent, job)
    made_by = {"version": job.version, "processor": cpu_model()}
    signature = made_by | {"config_hash": job.config_hash, "map_hash": job.map_hash}
    if (episode.agent, episode.condition.scene) not in _compiled:
        _compiled.add((episode.agent, episode.condition.scene))
        release_memory()
    return episode.identity(job.scene_hash) | signature | result


def _keep(agent: "Agent", job: Job) -> str | None:
    """Write an agent's final map; return its file's name, None for an agent without a map."""
    final: VoxelMap | None = getattr(agent, "map", None)
    if final is None or job.explored_file is None:
        return None
    job.explored_file.parent.mkdir(parents=True, exist_ok=True)
    final.save(job.explored_file, agent=job.episode.agent, scene_hash=job.scene_hash, package_version=job.version)
    return job.explored_file.name


def release_memory() -> None:
    """Return freed memory to the system, where the C library can; compiling leaves hundreds of megabytes allocated."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def _supervised(job: Job, seconds: float) -> SupervisedAgent:
    """Return who makes a new agent for the episode, and lets it fail."""
    from vssm_gym.agents.registry import agent_type, make_agent

    name = job.episode.agent
    return SupervisedAgent(agent_type(name), lambda: make_agent(name), seconds, job.fault)


@cache
def _agent(name: str) -> "Agent":
    from vssm_gym.agents.registry import make_agent

    return make_agent(name)


@lru_cache(maxsize=1)
def _map(env: str, path: Path) -> Any:
    return protocol_of(env).load_map(path)
