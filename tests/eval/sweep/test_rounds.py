"""Test that an agent that ends its process loses its own episode, and nobody else's."""

from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass

import pytest

from vssm_gym.errors import InputError
from vssm_gym.eval.sweep.rounds import Rounds
from vssm_gym.eval.sweep.supervision import DEAD
from vssm_gym.eval.sweep.worker import WorkerDiedError


@dataclass(frozen=True)
class Job:
    """Hold what rounds read of a job."""

    name: str
    agent_seconds: float | None = 1.0
    fault: str | None = None


class Pool:
    """Run jobs when somebody waits for them; a deadly one breaks it for all that were handed out."""

    machines, opened = 1, []

    def __init__(self, jobs, processes=2, started=True):
        self.processes, self.broken, self.started, self.given = min(processes, jobs), False, started, []
        Pool.opened.append(jobs)

    def submit(self, job, machine=None):
        if self.broken:
            raise BrokenProcessPool
        self.given.append((job, future := Future()))
        deadly = job.name.startswith("deadly") and job.fault is None
        if deadly or len(self.given) == self.processes or job.name.endswith("."):
            self.broken = any(job.name.startswith("deadly") and job.fault is None for job, _ in self.given)
            for one, waiting in self.given:
                if self.broken:
                    waiting.set_exception(BrokenProcessPool())
                else:
                    waiting.set_result({"name": one.name, "fault": one.fault})
            self.given = []
        return future

    def lost(self, kept):
        return WorkerDiedError("sweep", "workers", kept) if self.started else InputError("sweep", "workers", "no guard")

    def close(self):
        """End."""


def rows_of(names, **fields):
    """Run jobs; return their rows."""
    rows, jobs = [], [Job(name, **fields) for name in names]
    Rounds(Pool, len(jobs), rows.append, lambda: "some kept").run([(job, None) for job in jobs])
    return rows


def test_the_guilty_one_alone_has_a_fault_and_every_job_a_row(monkeypatch):
    monkeypatch.setattr("vssm_gym.eval.sweep.rounds.SIGNAL_SECONDS", 0.0)
    names = ["a", "b", "c", "deadly", "d", "e", "deadly too", "f", "g", "h."]
    rows = rows_of(names)
    assert sorted(row["name"] for row in rows) == sorted(names)
    assert {row["name"]: row["fault"] for row in rows if row["fault"]} == {"deadly": DEAD, "deadly too": DEAD}


def test_a_dead_process_ends_a_run_whose_agents_may_not_fail(monkeypatch):
    monkeypatch.setattr("vssm_gym.eval.sweep.rounds.SIGNAL_SECONDS", 0.0)
    with pytest.raises(WorkerDiedError, match="some kept"):
        rows_of(["deadly."], agent_seconds=None)
    monkeypatch.setattr(Pool, "lost", lambda self, kept: InputError("sweep", "workers", "no guard"))
    with pytest.raises(InputError, match="no guard"):  # no process could be started
        rows_of(["deadly."])
