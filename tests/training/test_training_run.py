"""Test runs of a training: interrupted, killed, out of disk and resumed; and none overwrites another."""

import json
import os
import re
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.chaos.disks import largest_file
from tests.helpers.training.configurations import PPO, SAC, config, written
from tests.helpers.training.corridor import Corridor
from vssm_gym.agents.policy import policy_file
from vssm_gym.errors import InputError, OutputError
from vssm_gym.training.environment import PolicyView, commands
from vssm_gym.training.run import deferred_interrupt, read_progress
from vssm_gym.training.train import run_training


def contents(folder: Path) -> dict[Path, bytes]:
    """Return what all files of a folder hold."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("algorithm", [PPO, SAC], ids=["ppo", "sac"])
@pytest.mark.parametrize("frames", [1, 3])
def test_a_run_is_resumed_where_it_was(corridor, tmp_path, algorithm, frames):
    """Steps, seconds and the network continue; the file acts as the trained network."""
    import torch

    from vssm_gym.training.sb3.learner import make_model, restore_checkpoint, wrapped

    shape = {"policy": {"hidden": [8], "inputs": ["scan", "goal"], "frames": frames}, "algorithm": algorithm}
    path = run_training(config(**shape), tmp_path / "run")
    rows = read_progress(tmp_path / "run" / "progress.jsonl")
    assert rows[-1]["steps"] == 64 and rows[-1]["seconds"] > rows[-1]["preparing"] > 0.0
    policy = policy_file.load(path)
    assert policy.spec.trained["steps"] == 64 and policy.spec.frames == frames

    wanted = config(**shape)
    env = wrapped(PolicyView(Corridor(4), ("scan", "goal")), frames)
    settings = wanted.algorithm.model_dump(exclude={"name"})
    model = make_model(wanted.algorithm.name, env, (8,), "tanh", 0, settings, lambda: 0.0, tmp_path / "log")
    assert restore_checkpoint(tmp_path / "run" / "checkpoint.pt", model) >= rows[-1]["seconds"] - 1e-4  # rounded
    assert model.num_timesteps == 64
    if algorithm is SAC:
        assert model.replay_buffer.pos == 16  # type: ignore[attr-defined]
    x = np.random.default_rng(0).normal(size=(5, frames * 68)).astype(np.float32)
    with torch.no_grad():
        theirs, _ = model.predict(x, deterministic=True)
    np.testing.assert_allclose(policy(x), commands(theirs)[:, :3], atol=1e-5)

    with pytest.raises(InputError, match="--resume continues"):
        run_training(wanted, tmp_path / "run")
    before = contents(tmp_path / "run")
    assert run_training(wanted, tmp_path / "run", resume=True) == path and contents(tmp_path / "run") == before
    with pytest.raises(InputError, match="another training belongs into another folder"):
        run_training(config(**shape, seed=5), tmp_path / "run", resume=True)


def test_ctrl_c_keeps_the_training_and_resume_completes_it(corridor, tmp_path):
    def interrupt(row: dict[str, Any], share: float) -> None:
        if row["steps"] == 64:
            os.kill(os.getpid(), signal.SIGINT)

    long = config(steps=160)
    with pytest.raises(KeyboardInterrupt):
        run_training(long, tmp_path, on_update=interrupt)
    rows = read_progress(tmp_path / "progress.jsonl")
    assert 64 <= rows[-1]["steps"] < 100 and (tmp_path / "policy.npz").is_file()
    run_training(long, tmp_path, resume=True)
    again = read_progress(tmp_path / "progress.jsonl")
    assert again[: len(rows)] == rows and again[-1]["steps"] >= 160
    assert again[-1]["seconds"] > rows[-1]["seconds"]
    assert json.loads((tmp_path / "training.json").read_text())["world_hash"] == "0" * 16


def test_a_second_interrupt_stops_at_once():
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), deferred_interrupt() as seen:
        assert not seen()
        os.kill(os.getpid(), signal.SIGINT)
        assert seen()
        os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_a_training_killed_before_its_first_checkpoint_restarts(corridor, tmp_path):
    """Its log is dropped, so that steps along a curve never decrease."""
    run_training(config(), tmp_path)
    for name in ("checkpoint.pt", "policy.npz"):
        (tmp_path / name).unlink()
    run_training(config(), tmp_path, resume=True)
    steps = [row["steps"] for row in read_progress(tmp_path / "progress.jsonl")]
    assert steps == sorted(steps) and steps[-1] == 64


def test_a_full_disk_ends_a_training_and_resume_ends_it(corridor, tmp_path):
    """The network is smaller than the optimiser's state beside it: the checkpoint does not fit."""
    with pytest.raises(OutputError, match=r"could not be written: File too large"), largest_file(8000):
        run_training(config(), tmp_path)
    assert not (tmp_path / "checkpoint.pt").exists() and not list(tmp_path.glob(".*"))
    run_training(config(), tmp_path, resume=True)
    assert read_progress(tmp_path / "progress.jsonl")[-1]["steps"] == 64


@pytest.mark.parametrize("changed", [{}, {"steps": 80}])
def test_a_finished_policy_is_not_overwritten(corridor, tmp_path, changed):
    """This holds without a checkpoint too, as after cloning."""
    path = run_training(config(), tmp_path)
    (tmp_path / "checkpoint.pt").unlink()
    before = path.read_bytes()
    with pytest.raises(InputError, match="config_hash" if changed else "--resume continues"):
        run_training(config(**changed), tmp_path)
    assert path.read_bytes() == before


def test_a_folder_with_other_files_is_refused(corridor, tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(InputError, match=r"it holds thesis.tex"):
        run_training(config(), tmp_path)


def test_a_folder_has_one_training_at_a_time(corridor, tmp_path):
    def meanwhile(row: dict[str, Any], share: float) -> None:
        with pytest.raises(InputError, match="no other run writing to it at the same time"):
            run_training(config(), tmp_path, resume=True)

    run_training(config(), tmp_path, on_update=meanwhile)


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["ppo", "bc"])
def test_a_training_in_a_learned_map(tmp_path, algorithm, monkeypatch):
    """The command line trains from a map file to a policy file, which then runs in the same map."""
    pytest.importorskip("stable_baselines3", reason="needs the extra vssm-gym[rl]")
    from tests.helpers.imagined_room import room, task
    from vssm_gym.cli.train import train
    from vssm_gym.training.imagined_episodes import imagine

    room().save(tmp_path / "room.npz")
    settings = "{name: ppo, n_steps: 16, batch_size: 64}" if algorithm == "ppo" else "{name: bc, epochs: 3}"
    text = f"name: room\nsteps: 256\nalgorithm: {settings}\npolicy: {{hidden: [16]}}\n"
    path = written(tmp_path, text + "environment: {map: room.npz, num_envs: 4, pool: 64, goals: 4}\n")
    train(path, tmp_path / "run")
    policy = policy_file.load(tmp_path / "run" / "policy.npz")
    assert policy.spec.trained["algorithm"] == algorithm
    assert re.fullmatch(r"[0-9a-f]{16}", policy.spec.trained["world_hash"])
    if algorithm == "ppo":
        train(path, tmp_path / "run", resume=True)
    tasks = [task((1.0, 1.2, 0.0), (3.0, 1.2))]
    object.__setattr__(tasks[0], "geodesic", 1.6)
    (row,) = imagine(policy, tmp_path / "room.npz", tasks, "none")
    assert 0.0 <= row["spl"] <= row["success"] and 1 <= row["steps"] <= 500
