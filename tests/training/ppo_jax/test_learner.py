"""Test the compiled PPO: it learns, is compiled once, sees what the vector environment shows, and resumes."""

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import monitoring

from tests.helpers.imagined_room import room
from vssm_gym.agents.policy import policy_file
from vssm_gym.agents.policy.features import OBSERVED, SIZES, features
from vssm_gym.errors import InputError
from vssm_gym.training import run as run_module
from vssm_gym.training.config import TrainingConfig
from vssm_gym.training.environment import commands, make_training_env
from vssm_gym.training.ppo_jax import rollout
from vssm_gym.training.ppo_jax.learner import Learner
from vssm_gym.training.run import read_progress
from vssm_gym.training.train import run_training

PARTS = tuple(part for part in SIZES if not part.startswith(OBSERVED))


@pytest.fixture(scope="module")
def map_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the file of the room's map."""
    path = tmp_path_factory.mktemp("map") / "room.npz"
    room().save(path)
    return path


def config(map_file: Path, **changes: Any) -> TrainingConfig:
    """Return a training of 8 robots."""
    fields: dict[str, Any] = {
        "name": "room",
        "environment": {"map": str(map_file), "num_envs": 8, "pool": 64, "goals": 4, "max_episode_steps": 30},
        "policy": {"hidden": [16], "inputs": ["goal"]},
        "algorithm": {"name": "ppo_jax", "n_steps": 16, "batch_size": 64, "n_epochs": 2},
        "steps": 512,
    }
    return TrainingConfig.model_validate(fields | changes)


@pytest.mark.slow
@pytest.mark.parametrize("frames", [1, 3])
def test_robots_see_what_the_vector_environment_shows(map_file, frames):
    """The same actions from the same states lead to the same inputs, rewards and ends."""
    wanted = config(map_file, policy={"hidden": [4], "inputs": PARTS, "frames": frames})
    learner = Learner(wanted)
    env = make_training_env(wanted.environment, PARTS, wanted.seed)
    env.reset(seed=0)
    streams = env.unwrapped._batch.state.key
    robots = rollout.begin(learner._task, 8, jax.random.key(3))
    env.unwrapped._batch.seed(np.asarray(robots.state.key), np.ones(8, bool))
    seen, _ = env.reset()
    assert not np.array_equal(streams, robots.state.key)
    np.testing.assert_allclose(robots.inputs[:, -1], seen, atol=1e-5)
    _, record = rollout.act(learner._task, learner._network, robots, 70)
    stack = np.zeros((8, frames, seen.shape[1]), np.float32)
    stack[:, -1] = seen
    begun = np.zeros(8, bool)
    for t in range(70):
        np.testing.assert_allclose(record.inputs[t], stack.reshape(8, -1), atol=2e-4)
        seen, reward, terminated, truncated, _ = env.step(np.clip(np.asarray(record.action[t]), -1.0, 1.0))
        np.testing.assert_array_equal(begun, record.begun[t])
        np.testing.assert_allclose(reward[~begun], record.reward[t][~begun], atol=1e-4)
        np.testing.assert_array_equal(terminated, record.terminated[t])
        np.testing.assert_array_equal(truncated, record.truncated[t])
        stack = np.concatenate([np.where(begun[:, None, None], 0.0, stack[:, 1:]), seen[:, None]], axis=1)
        begun = terminated | truncated
    assert np.asarray(record.truncated).any() and np.asarray(record.begun).any()


def test_features_are_the_same_in_both_libraries():
    rng = np.random.default_rng(0)
    shapes = {"scan": (6, 64), "goal": (6, 3), "pose": (6, 3), "pose_std": (6, 3), "commands": (6, 4, 3)}
    shown = {name: np.abs(rng.normal(size=shape)).astype(np.float32) for name, shape in shapes.items()}
    shown["scan"][0, :5] = 0.0
    np.testing.assert_allclose(features(shown, PARTS), features(shown, PARTS, jnp), atol=1e-5)


def test_a_program_is_compiled_once(map_file):
    learner = Learner(config(map_file))
    learner.update(1e-3)
    heard: list[str] = []
    monitoring.register_event_duration_secs_listener(lambda event, duration, **_: heard.append(event))
    learner.update(1e-3)
    learner.update(5e-4)
    assert not [event for event in heard if "backend_compile" in event]


@pytest.mark.slow
def test_it_learns_to_reach_goals(map_file, tmp_path):
    """In an open room of few goals 150 updates suffice."""
    algorithm = {"name": "ppo_jax", "n_steps": 32, "batch_size": 512, "learning_rate": 1e-3}
    where = {"map": str(map_file), "num_envs": 64, "pool": 256, "goals": 8, "max_episode_steps": 100}
    wanted = config(map_file, algorithm=algorithm, environment=where, steps=64 * 32 * 150, policy={"hidden": [64]})
    run_training(wanted, tmp_path / "run")
    rows = read_progress(tmp_path / "run" / "progress.jsonl")
    assert rows[-1]["success"] > 0.9, rows[-1]


def test_a_training_resumes_where_it_was(map_file, tmp_path):
    """The policy file acts as the network; networks, optimiser, key and steps are restored to the bit."""
    path = run_training(config(map_file), tmp_path / "run")
    policy = policy_file.load(path)
    assert policy.spec.trained["algorithm"] == "ppo_jax" and policy.spec.trained["steps"] == 512
    rows = read_progress(tmp_path / "run" / "progress.jsonl")
    assert rows[-1]["steps"] == 512 and rows[-1]["seconds"] >= rows[-1]["preparing"] > 0.0
    learner = Learner(config(map_file))
    learner.restore(tmp_path / "run" / "checkpoint.npz")
    x = np.random.default_rng(0).normal(size=(5, 4)).astype(np.float32)
    mean = np.asarray(learner._network.mean(jnp.asarray(x)))
    np.testing.assert_allclose(policy(x), commands(np.clip(mean, -1.0, 1.0))[:, :3], atol=1e-5)
    learner.save(tmp_path / "again.npz", 1.0)
    one, other = (np.load(p) for p in (tmp_path / "run" / "checkpoint.npz", tmp_path / "again.npz"))
    assert all(np.array_equal(one[name], other[name]) for name in one.files if name != "seconds")
    before = {file: file.read_bytes() for file in (tmp_path / "run").iterdir()}
    run_training(config(map_file), tmp_path / "run", resume=True)  # at its end already
    assert {file: file.read_bytes() for file in (tmp_path / "run").iterdir()} == before
    libraries = json.loads((tmp_path / "run" / "training.json").read_text())["libraries"]
    assert "torch" not in libraries


@pytest.mark.slow
def test_a_diverged_training_keeps_what_was_finite(map_file, tmp_path, monkeypatch):
    for name in ("ROW_SECONDS", "CHECKPOINT_SECONDS"):
        monkeypatch.setattr(run_module, name, 0.0)
    algorithm = {"name": "ppo_jax", "n_steps": 16, "batch_size": 64, "n_epochs": 2, "learning_rate": 10.0}
    wanted = config(map_file, algorithm=algorithm, steps=128 * 30)
    with pytest.raises(InputError, match=r"learning_rate: expected less than 10, .* the training diverged at step \d"):
        run_training(wanted, tmp_path)
    steps = policy_file.load(tmp_path / "policy.npz").spec.trained["steps"]  # which refuses what is not finite
    assert 0 < steps <= read_progress(tmp_path / "progress.jsonl")[-1]["steps"] < wanted.steps
    learner = Learner(wanted)
    learner.restore(tmp_path / "checkpoint.npz")
    assert learner.steps == steps


def test_a_training_that_diverges_in_its_last_update_keeps_nothing_of_it(map_file, tmp_path, monkeypatch):
    """Its statistics are of the network before, and finite."""
    improve = Learner.update

    def diverge(learner, rate):
        improve(learner, rate)
        learner._network = jax.tree.map(lambda array: jnp.nan * array, learner._network)

    monkeypatch.setattr(Learner, "update", diverge)
    with pytest.raises(InputError, match="the training diverged at step 128"):
        run_training(config(map_file, steps=128), tmp_path)
    assert not list(tmp_path.glob("*.npz"))


def test_a_damaged_checkpoint_is_refused(map_file, tmp_path):
    learner = Learner(config(map_file))
    learner.save(tmp_path / "c.npz", 1.0)
    stored = dict(np.load(tmp_path / "c.npz"))
    for name, value in (("leaf0", stored["leaf0"][:1]), ("steps", np.int64(-4)), ("leaf1", stored["leaf1"] + np.nan)):
        np.savez(tmp_path / "bad.npz", **(stored | {name: value}))
        with pytest.raises(InputError, match="a checkpoint of this training"):
            learner.restore(tmp_path / "bad.npz")


def test_batches_are_equal_and_the_world_is_the_models(map_file):
    algorithm = {"name": "ppo_jax", "n_steps": 16, "batch_size": 100}
    with pytest.raises(ValueError, match="a batch_size that divides num_envs x n_steps, 128"):
        config(map_file, algorithm=algorithm)
