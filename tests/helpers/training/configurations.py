"""Make configurations of trainings that end after a few steps, and files of configurations."""

from pathlib import Path
from typing import Any

from vssm_gym.training.config import TrainingConfig

PPO = {"name": "ppo", "n_steps": 8, "batch_size": 32, "n_epochs": 2}
SAC = {"name": "sac", "buffer_size": 500, "learning_starts": 32, "batch_size": 16}


def config(**changes: Any) -> TrainingConfig:
    """Return a training of 64 steps of four robots."""
    fields: dict[str, Any] = {
        "name": "tiny",
        "environment": {"map": "unread.npz", "num_envs": 4},
        "policy": {"hidden": [8], "inputs": ["scan", "goal"]},
        "algorithm": PPO,
        "steps": 64,
    }
    return TrainingConfig.model_validate(fields | changes)


def written(path: Path, text: str) -> Path:
    """Write the file of a configuration into a folder."""
    (path / "train.yaml").write_text(text)
    return path / "train.yaml"
