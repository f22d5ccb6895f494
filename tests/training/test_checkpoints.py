"""Test checkpoints: what has diverged is not kept, and damaged or foreign ones are refused without running code."""

from pathlib import Path

import numpy as np
import pytest

from tests.helpers.training.configurations import PPO, SAC, config
from vssm_gym.agents.policy import policy_file
from vssm_gym.errors import InputError
from vssm_gym.training import run as run_module
from vssm_gym.training.run import read_progress
from vssm_gym.training.train import run_training


@pytest.mark.parametrize(("algorithm", "rate"), [(PPO, 10.0), (PPO, 1e3), (SAC, 10.0)], ids=["mean", "width", "sac"])
def test_a_diverged_training_keeps_what_was_finite(corridor, tmp_path, monkeypatch, algorithm, rate):
    """The densities of PPO lose their mean, or their width."""
    for name in ("ROW_SECONDS", "CHECKPOINT_SECONDS"):
        monkeypatch.setattr(run_module, name, 0.0)
    wanted = config(algorithm=algorithm | {"learning_rate": rate}, steps=4000)
    expected = rf"learning_rate: expected less than {rate:g}, with which the training diverged at step [1-9]"
    with pytest.raises(InputError, match=expected):
        run_training(wanted, tmp_path)
    steps = policy_file.load(tmp_path / "policy.npz").spec.trained["steps"]  # which refuses what is not finite
    assert steps <= read_progress(tmp_path / "progress.jsonl")[-1]["steps"] < 4000
    assert (tmp_path / "checkpoint.pt").is_file()


def test_a_training_that_diverges_in_its_last_update_keeps_nothing_of_it(corridor, tmp_path, monkeypatch):
    from vssm_gym.training.sb3 import learner

    learn = learner.learn

    def diverge(model, *given):
        learn(model, *given)
        model.policy.action_net.bias.data.fill_(np.nan)

    monkeypatch.setattr(learner, "learn", diverge)
    with pytest.raises(InputError, match="the training diverged at step 64"):
        run_training(config(), tmp_path)
    assert not list(tmp_path.glob("*.pt")) and not list(tmp_path.glob("*.npz"))


class Bomb:
    """Write a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@pytest.mark.parametrize("damage", ["text", "code"])
def test_a_damaged_checkpoint_is_refused_and_runs_no_code(corridor, tmp_path, damage):
    import torch

    run_training(config(), tmp_path / "run").unlink()  # as if it had been killed before its end
    checkpoint = tmp_path / "run" / "checkpoint.pt"
    if damage == "text":
        checkpoint.write_bytes(b"not a checkpoint")
    else:
        torch.save({"model": Bomb(tmp_path / "exploded")}, checkpoint)
    with pytest.raises(InputError, match="a checkpoint of this training"):
        run_training(config(), tmp_path / "run", resume=True)
    assert not (tmp_path / "exploded").exists()


@pytest.mark.parametrize(
    "change",
    [
        {"counters": {"num_timesteps": 64, "_n_updates": 1, "save": 0}},
        {"counters": {"num_timesteps": 64}},
        {"counters": {"num_timesteps": -1, "_n_updates": 1}},
        {"counters": {"num_timesteps": 1.5, "_n_updates": 1}},
        {"variables": {"policy": 0}},
    ],
)
def test_a_checkpoint_with_other_variables_is_refused(corridor, tmp_path, change):
    import torch

    run_training(config(), tmp_path / "run").unlink()
    checkpoint = tmp_path / "run" / "checkpoint.pt"
    content = torch.load(checkpoint, weights_only=True)
    torch.save(content | change, checkpoint)
    with pytest.raises(InputError, match="a checkpoint of this training"):
        run_training(config(), tmp_path / "run", resume=True)
