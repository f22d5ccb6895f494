"""Test the committed configurations of trainings: each is valid, and those that are compared differ in one thing."""

import re
from pathlib import Path

import pytest
import yaml

from tests.helpers.paths import CHECKOUT
from vssm_gym.training.config import load_training

CONFIGS = CHECKOUT / "eval" / "configs"


@pytest.mark.parametrize("path", [*CONFIGS.glob("ppo_*.yaml"), *CONFIGS.glob("bc_*.yaml")], ids=lambda path: path.stem)
def test_the_committed_configurations_are_valid(path, tmp_path):
    text = path.read_text()
    imagined = "WorldModelNav" in text
    if "transition:" in text:  # what `train-dynamics` makes lies where the comments write it
        (tmp_path / "worn.npz").touch()
        path = tmp_path / path.name
        path.write_text(text.replace("../../out/rl/", ""))
    found = load_training(path, map_file=Path("oak.npz") if imagined else None, seed=3)
    assert found.seed == 3 and found.policy.hidden == (128, 128)
    assert found.minutes == {"ppo_oak_few": None, "ppo_pointnav": 10.0, "ppo_reactive": 10.0}.get(path.stem, 12.0)


def test_compared_trainings_differ_in_the_compared_setting_only():
    """Cloning and PPO share tasks and errors; the short training in the map has the settings of that in MuJoCo."""
    stored = {name: yaml.safe_load((CONFIGS / f"{name}.yaml").read_text()) for name in
              ("ppo_oak", "bc_oak", "ppo_oak_simulated", "ppo_oak_few")}  # fmt: skip
    ppo, cloned, simulated, few = stored.values()
    for name in ("goals", "pool", "noise", "pose_std", "max_episode_steps"):
        assert cloned["environment"][name] == ppo["environment"][name]
    for name in ("noise", "pose_std", "max_episode_steps", "num_envs", "contact_cost"):
        assert simulated["environment"][name] == few["environment"][name]
    assert simulated["algorithm"] == few["algorithm"]
    assert ppo["policy"] == cloned["policy"] == simulated["policy"] == few["policy"]


def test_what_the_worn_robots_policies_are_trained_in_differs_in_the_motion_only():
    stored = [yaml.safe_load((CONFIGS / f"ppo_{motion}_motion.yaml").read_text()) for motion in ("learned", "nominal")]
    assert [one["environment"].pop("transition", None) for one in stored] == ["../../out/rl/worn.npz", None]
    assert [one["environment"].pop("noise", None) for one in stored] == [None, "none"]
    assert [one.pop("name") for one in stored] == ["learned-motion", "nominal-motion"]
    assert stored[0] == stored[1]
    agents = yaml.safe_load((CONFIGS / "rl_worn.yaml").read_text())["agents"]
    made = {
        f"policy:../../out/rl/{motion}-motion-{s}/policy.npz" for motion in ("learned", "nominal") for s in range(3)
    }
    assert agents[0] == "astar" and set(agents[1:]) == made


def test_the_comparison_names_the_files_of_the_trainings():
    """One policy file for each of three seeds of each training, under the names that its comments give."""
    text = (CONFIGS / "rl.yaml").read_text()
    agents = yaml.safe_load(text)["agents"]
    made = re.findall(r"train (\S+)\.yaml.*--out (\S+)-\$s", text)
    assert agents[0] == "astar" and len(made) == 4
    assert set(agents[1:]) == {f"policy:../../{out}-{s}/policy.npz" for _, out in made for s in range(3)}
    assert all((CONFIGS.parents[1] / f"{config}.yaml").is_file() for config, _ in made)
