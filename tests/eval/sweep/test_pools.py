"""Test how many jobs a pool has on this machine and on a cluster."""

import contextlib
import multiprocessing
from types import SimpleNamespace

import pytest

from vssm_gym.cluster import ray_cluster
from vssm_gym.errors import InputError
from vssm_gym.eval.sweep import pools, ray_pool

CPUS = 3


@pytest.mark.parametrize(
    ("workers", "jobs", "processes", "waiting"), [(None, 9, CPUS, CPUS), (4, 9, 4, 0), (4, 2, 2, 0)]
)
def test_a_number_of_workers_is_never_exceeded_on_a_cluster(monkeypatch, workers, jobs, processes, waiting):
    """Jobs that wait in Ray run on any CPU that is free, also on one of a machine that joins later."""
    monkeypatch.setattr(
        ray_cluster, "connected", lambda *_: contextlib.nullcontext(SimpleNamespace(cpus=CPUS, machines=["head"]))
    )
    monkeypatch.setattr(
        ray_pool, "Calls", lambda cluster, most, waiting: SimpleNamespace(held=(most, waiting), share=len)
    )
    with pools.pools(workers, "auto") as pool_of:
        pool = pool_of(jobs)
    assert (pool.processes, pool._calls.held) == (processes, (processes, waiting))


def test_a_machine_without_shared_memory_is_one_sentence(monkeypatch):
    def lock():
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(multiprocessing, "get_context", lambda method: SimpleNamespace(Lock=lock))
    with pytest.raises(InputError, match="/dev/shm has to be writable; found: Permission denied"):
        pools.LocalPool(1)
