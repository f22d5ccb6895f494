"""Let trainings run in a corridor.

What compiles is imported by the fixture: pytest may read this file before ``tests/conftest.py`` has set up XLA.
"""

import pytest


@pytest.fixture
def corridor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make all trainings run in the corridor, for any map; skip without the extra."""
    pytest.importorskip("stable_baselines3", reason="needs the extra vssm-gym[rl]")
    from tests.helpers.training.corridor import Corridor
    from vssm_gym.training import train as training
    from vssm_gym.training.environment import PolicyView

    monkeypatch.setattr(
        training, "make_training_env", lambda where, parts, seed: PolicyView(Corridor(where.num_envs), parts)
    )
    monkeypatch.setattr(training, "world_hash", lambda where: "0" * 16)
