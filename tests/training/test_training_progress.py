"""Test what is logged and shown of a training: success, times, the end, finite numbers, and lines that are kept."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.chaos.disks import largest_file
from tests.helpers.training.configurations import config
from vssm_gym.cli.train import _summary, _times
from vssm_gym.errors import InputError
from vssm_gym.training import run as run_module
from vssm_gym.training.run import ENOUGH_EPISODES, ProgressLog, Run, first_round, read_progress


def running(path: Path, heard: list[dict[str, Any]], **changes: Any) -> Run:
    """Return a training of 4 robots with episodes of 12 steps whose updates are heard."""
    where = {"map": "unread.npz", "num_envs": 4, "max_episode_steps": 12}
    manifest = {"config_hash": "", "world_hash": "", "version": ""}
    log = ProgressLog(path / "progress.jsonl")
    return Run(
        config(environment=where, **changes), path, manifest, log, lambda: False, lambda row, _: heard.append(row)
    )


def update(steps: int, episodes: int) -> dict[str, Any]:
    return {"steps": steps, "episodes": episodes, "return": 1.0, "length": 3.0, "success": 1.0}


def test_success_is_enough_after_100_episodes_and_a_round_of_all_robots(tmp_path):
    """The first episodes are short ones; a resumed training begins with such episodes again."""
    heard: list[dict[str, Any]] = []
    run = running(tmp_path, heard)
    assert first_round(run.config) == 48
    run.stepped()
    for steps, episodes in ((44, 400), (48, 99), (48, ENOUGH_EPISODES)):
        run.report(update(steps, episodes), lambda: None)
    assert [row["enough"] for row in heard] == [False, False, True]
    again = running(tmp_path, heard)
    again.resume(48, 5.0)
    again.stepped()
    for steps in (92, 96):
        again.report(update(steps, 500), lambda: None)
    assert [row["enough"] for row in heard[3:]] == [False, True]


def test_the_command_shows_no_success_of_a_handful_of_episodes(tmp_path):
    few, one, enough = update(44, 7), update(12, 1), update(9600, 500)
    shown = [_summary(row | {"enough": row is enough}, running(tmp_path, []).config) for row in (few, one, enough)]
    assert shown == [
        "44 steps, 7 episodes ended; success needs 100 and 48 steps of this run",
        "12 steps, 1 episode ended; success needs 100 and 48 steps of this run",
        "9,600 steps, return 1.00, success 100%",
    ]


def test_building_and_compiling_are_timed_apart(tmp_path, monkeypatch):
    """Two sessions: 20 + 5 s until the first step, 70 + 10 s afterwards."""
    now, heard = [1000.0], list[dict[str, Any]]()
    monkeypatch.setattr(run_module.time, "monotonic", lambda: now[0])
    run = running(tmp_path, heard)
    now[0] += 20.0
    run.report(update(0, 0), lambda: None)
    assert heard == []  # the robots have not stepped
    run.stepped()
    now[0] += 70.0
    run.stepped()
    run.end(update(640, 0), lambda: None)
    assert (heard[-1]["seconds"], heard[-1]["preparing"]) == (90.0, 20.0)

    again = running(tmp_path, heard)
    again.resume(640, 90.0)
    now[0] += 5.0
    again.stepped()
    now[0] += 10.0
    again.end(update(800, 0), lambda: None)
    assert (heard[-1]["seconds"], heard[-1]["preparing"]) == (105.0, 25.0)
    shown = "trained 105.0 s: 25.0 s building and compiling, 80.0 s stepping and learning (10 steps/s)"
    assert _times(heard[-1]) == shown


def test_a_training_has_finished_when_its_policy_is_of_the_end(tmp_path, monkeypatch):
    """After all steps or all minutes, of which the policy states tenths of seconds."""
    now, layers = [1000.0], ((np.zeros((8, 68)), np.zeros(8)), (np.zeros((3, 8)), np.zeros(3)))
    monkeypatch.setattr(run_module.time, "monotonic", lambda: now[0])
    run = running(tmp_path, [], steps=640, minutes=0.12567)  # 7.54 s
    found = [run.finished()]
    for steps, seconds in ((0, 7.0), (600, 7.41), (640, 7.0), (600, 7.541)):
        run.steps, now[0] = steps, 1000.0 + seconds
        run.write_policy(layers, "clip")
        found.append(run.finished())
    assert found == [False, False, False, True, True]


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_a_row_is_of_finite_numbers(tmp_path, number):
    run = running(tmp_path, [])
    for write in (run.report, run.end):
        with pytest.raises(InputError, match=r"learning_rate: expected less than 0.0005, .* diverged at step 1,200"):
            write(update(1200, 7) | {"loss": number}, lambda: pytest.fail("it was kept"))
    assert (tmp_path / "progress.jsonl").read_bytes() == b""


def test_a_log_forgets_what_was_not_kept_and_rewrites_nothing(tmp_path):
    """Lines that are kept stay where they are: a kill or a full disk cannot cost them."""
    path = tmp_path / "log"
    with ProgressLog(path) as log:
        for steps in (10, 20, 30):
            log.append({"steps": steps, "seconds": 1.0})
        kept = path.read_bytes()[: 2 * len(b'{"steps": 10, "seconds": 1.0}\n')]
        with largest_file(len(kept) - 1):
            log.drop_after(20)
        assert path.read_bytes() == kept
        log.append({"steps": 25, "seconds": 1.0})
    path.write_bytes(path.read_bytes() + b'{"ste')
    with ProgressLog(path) as log:
        log.drop_after(40)
    assert [row["steps"] for row in read_progress(path)] == [10, 20, 25] and path.read_bytes().endswith(b"\n")
    path.write_bytes(path.read_bytes() + b'{"seconds": 2.0}\n')
    with ProgressLog(path) as log, pytest.raises(InputError, match=r"line 4: expected numbers as seconds and steps"):
        log.drop_after(40)
