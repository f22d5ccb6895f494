"""Test cloning of an expert: the fit of its data, and a run that is interrupted among demonstrations and resumed."""

import os
import signal
from typing import Any

import numpy as np
import pytest

from tests.helpers.training.configurations import config
from vssm_gym.agents.policy import policy_file
from vssm_gym.training.run import read_progress
from vssm_gym.training.train import run_training


def test_cloning_fits_its_data():
    pytest.importorskip("torch", reason="needs the extra vssm-gym[rl]")
    from vssm_gym.training.sb3.cloning import fit

    rng = np.random.default_rng(0)
    x = rng.normal(size=(512, 4)).astype(np.float32)
    a = np.tanh(x @ rng.normal(size=(4, 3))).astype(np.float32)
    losses: list[float] = []
    layers = fit(
        x, a, (32,), "tanh", epochs=60, batch_size=64, learning_rate=0.01, seed=0,
        on_epoch=lambda epoch, loss: losses.append(loss), stop=lambda: False,
    )  # fmt: skip
    assert losses[-1] < 0.05 * losses[0]
    hidden = np.tanh(x @ layers[0][0].T + layers[0][1])
    assert np.mean((hidden @ layers[1][0].T + layers[1][1] - a) ** 2) < 0.05 * losses[0]


@pytest.mark.slow
def test_interrupted_cloning_writes_no_policy_and_is_resumed(tmp_path):
    pytest.importorskip("stable_baselines3", reason="needs the extra vssm-gym[rl]")
    from tests.helpers.imagined_room import room

    room().save(tmp_path / "room.npz")
    settings = {"environment": {"map": str(tmp_path / "room.npz"), "num_envs": 4, "pool": 64, "goals": 4}, "steps": 400}
    wanted = config(**settings, algorithm={"name": "bc", "epochs": 2})

    def interrupt(row: dict[str, Any], share: float) -> None:
        if row["steps"] == 200:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run_training(wanted, tmp_path / "run", on_update=interrupt)
    assert not (tmp_path / "run" / "policy.npz").exists()
    with np.load(tmp_path / "run" / "demonstrations.npz") as kept:
        assert int(kept["steps"]) == 200 and 100 < len(kept["vectors"]) == len(kept["actions"]) <= 200
    path = run_training(wanted, tmp_path / "run", resume=True)
    assert policy_file.load(path).spec.trained["steps"] == 400
    assert not (tmp_path / "run" / "demonstrations.npz").exists()
    rows = read_progress(tmp_path / "run" / "progress.jsonl")
    assert [row["steps"] for row in rows] == sorted(row["steps"] for row in rows)
