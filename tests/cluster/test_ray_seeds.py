"""Test trainings of several seeds on a Ray cluster: the policies of a command alone, a killed worker, refusals."""

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.paths import CHECKOUT
from vssm_gym.errors import InputError
from vssm_gym.eval.sweep.worker import one_thread
from vssm_gym.training import cluster_seeds
from vssm_gym.training.config import load_training
from vssm_gym.training.run import read_progress

for library in ("ray", "torch", "stable_baselines3"):
    pytest.importorskip(library)

pytestmark = pytest.mark.slow

SEEDS = (0, 3)
STEPS = 1024  # of all robots: some seconds, far less than the time to a first checkpoint
TRAINING = (
    "name: tiny\nenvironment: {id: vssm_gym/WorldModelNav-v0, map: oak, num_envs: 16, max_episode_steps: 30,\n"
    "  goals: 4, pool: 64}\npolicy: {inputs: [scan, goal], hidden: [8]}\n"
    f"algorithm: {{name: ppo, n_steps: 16, batch_size: 64, n_epochs: 1}}\nsteps: {STEPS}\n"
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("seeds")
    (path / "train.yaml").write_text(TRAINING)
    return path


@pytest.fixture(scope="module")
def alone(folder):
    """Train the seeds by the command, one after the other, with one thread."""
    code = "import sys; from vssm_gym.cli.main import program; program()"
    words = ["train", folder / "train.yaml", "--out", folder / "alone", "--seeds", ",".join(map(str, SEEDS))]
    environment = os.environ | one_thread() | {"PYTHONPATH": str(CHECKOUT)}
    subprocess.run([sys.executable, "-c", code, *map(str, words)], check=True, env=environment, capture_output=True)
    return [weights(folder / "alone" / f"seed-{seed}" / "policy.npz") for seed in SEEDS]


def weights(policy: Path) -> dict[str, np.ndarray]:
    """Return the network of a policy; the header has seconds."""
    with np.load(policy) as stored:
        return {name: stored[name] for name in stored.files if name != "header"}


def assert_equal(policies: list[Path], alone: list[dict[str, np.ndarray]]) -> None:
    assert len(policies) == len(alone)
    for policy, expected in zip(policies, alone, strict=True):
        found = weights(policy)
        assert found.keys() == expected.keys() and len(found) > 1
        assert all(np.array_equal(found[name], expected[name]) for name in found)


def test_policies_are_those_of_the_command_alone(folder, nodes, alone):
    heard = []
    config, out = load_training(folder / "train.yaml"), folder / "cluster"
    policies = cluster_seeds.train_on_cluster(
        config, SEEDS, out, nodes.address, on_update=lambda *update: heard.append(update)
    )
    assert policies == [out / f"seed-{seed}" / "policy.npz" for seed in SEEDS]
    assert_equal(policies, alone)
    assert not np.array_equal(*(one[min(one)] for one in alone)) or alone[0].keys() != alone[1].keys()
    assert heard[-1] == (1.0, len(SEEDS) * STEPS, len(SEEDS))
    assert sorted(path.name for path in out.iterdir()) == [f"seed-{seed}" for seed in SEEDS]
    with pytest.raises(InputError, match=r"seed-0: folder: expected a folder without a training; it holds checkpoint"):
        cluster_seeds.train_on_cluster(config, SEEDS, out, nodes.address)
    again = cluster_seeds.train_on_cluster(config, SEEDS, out, nodes.address, resume=True)
    assert_equal(again, alone)


def test_a_killed_worker_is_replaced(folder, nodes, alone):
    """Both trainings lose their processes after they have begun, before a checkpoint: Ray begins them again."""
    out, killed = folder / "killed", set()

    def kill():
        deadline = time.monotonic() + 300
        while len(killed) < 2 and time.monotonic() < deadline:
            if all((out / f"seed-{seed}" / "training.json").is_file() for seed in SEEDS):
                killed.update(nodes.kill_workers())
            time.sleep(0.2)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    policies = cluster_seeds.train_on_cluster(load_training(folder / "train.yaml"), SEEDS, out, nodes.address)
    killer.join()
    assert len(killed) == 2
    assert_equal(policies, alone)
    assert all([row["steps"] for row in read_progress(p.with_name("progress.jsonl"))][-1] == STEPS for p in policies)


def test_a_folder_that_a_machine_does_not_see_is_refused(folder, nodes, monkeypatch):
    monkeypatch.setattr(cluster_seeds, "_sees", lambda file, word: False)
    with pytest.raises(InputError, match=r"apart: folder: expected a folder that all machines of the cluster share"):
        cluster_seeds.train_on_cluster(load_training(folder / "train.yaml"), SEEDS, folder / "apart", nodes.address)
    assert not (folder / "apart").exists()
