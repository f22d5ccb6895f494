"""Test policies beside the rows that they drove: all of them are committed, and rows are run again by these files."""

import pytest

from tests.helpers.box_rooms import two_rooms
from tests.helpers.paths import BASELINES
from tests.helpers.straight_policy import straight
from tests.helpers.sweeps.finished_sweep import altered
from vssm_gym.agents.policy import policy_file
from vssm_gym.agents.policy.policy_file import agent_label
from vssm_gym.cli.sweeps.reproduce import reproduce
from vssm_gym.envs.scenes.scene import save_scene
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.log import FILE, read_rows
from vssm_gym.eval.metrics.training_runs import training_name
from vssm_gym.eval.reproduction.sweep_rows import POLICY_FOLDER, policies_of
from vssm_gym.eval.sweep.config import SweepConfig
from vssm_gym.eval.sweep.runner import run_sweep

POLICY_BYTES = 200_000  # of a committed file
WITH_POLICIES = [folder for folder in sorted(BASELINES.iterdir()) if (folder / POLICY_FOLDER).is_dir()]


def check_policies(folder):
    """Assert that a sweep's folder holds the policies that drove its rows, all of them and no other, in small files."""
    drove = {row["agent"] for row in read_rows(folder / FILE) if training_name(row["agent"]) is not None}
    assert policies_of(folder).keys() == drove
    assert all(path.stat().st_size <= POLICY_BYTES for path in (folder / POLICY_FOLDER).iterdir())


@pytest.mark.parametrize("folder", WITH_POLICIES, ids=lambda folder: folder.name)
def test_committed_policies_are_those_of_the_rows(folder):
    check_policies(folder)


def test_the_check_of_committed_policies_finds_a_missing_and_a_foreign_one(sweep, tmp_path):
    file = tmp_path / "straight.npz"
    policy_file.save(file, straight())
    copy = altered(sweep, tmp_path, agent=policy_file.label(file))
    (copy / POLICY_FOLDER).mkdir()
    with pytest.raises(AssertionError):
        check_policies(copy)
    (copy / POLICY_FOLDER / "any-name.npz").write_bytes(file.read_bytes())
    check_policies(copy)
    policy_file.save(copy / POLICY_FOLDER / "other.npz", straight(step=0.5))
    with pytest.raises(AssertionError):
        check_policies(copy)


def test_policies_of_the_package_are_found(sweep, tmp_path):
    """Without a file in the folder; such a policy does not drive the disc of a maze, which is said next."""
    with pytest.raises(InputError, match=r"agents: expected one of .*; found 'policy:.*oak\.npz'"):
        reproduce(altered(sweep, tmp_path, agent=agent_label("policy:oak")), tmp_path / "again", workers=1)


@pytest.mark.slow
def test_the_rows_of_a_policy_are_run_by_its_file_in_the_folder(tmp_path, capsys):
    save_scene(two_rooms(), tmp_path / "rooms.json")
    policy_file.save(tmp_path / "straight.npz", straight())
    scene, agent = str(tmp_path / "rooms.json"), f"policy:{tmp_path / 'straight.npz'}"
    config = SweepConfig(scenes=(scene,), agents=(agent,), tasks=(0, 1))
    run_sweep(config, tmp_path / "out", workers=1)
    (tmp_path / "straight.npz").unlink()
    with pytest.raises(InputError, match=r"config\.agents: expected .* straight@\w+ is none"):
        reproduce(tmp_path / "out", tmp_path / "without", episodes=1, scenes=(scene,), workers=1)
    (tmp_path / "out" / POLICY_FOLDER).mkdir()
    policy_file.save(tmp_path / "out" / POLICY_FOLDER / "straight-0.npz", straight())
    reproduce(tmp_path / "out", tmp_path / "again", scenes=(scene,), workers=1)
    assert "2 of 2 rows have the same outcome" in capsys.readouterr().out
