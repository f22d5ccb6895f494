"""Test the configuration of a training: what is wrong is one line, paths start at its file, and hashes at content."""

import pytest

from tests.helpers.training.configurations import written
from vssm_gym.errors import InputError
from vssm_gym.training.config import load_training, training_hash
from vssm_gym.training.train import run_training

BASE = "name: a\nsteps: 10\nalgorithm: {name: ppo}\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("- 1\n", "file: expected fields name, environment"),
        (BASE, "environment: expected this field"),
        (BASE + "environment: {}\n", r"environment.map: expected a map file"),
        (BASE + "environment: {id: vssm_gym/PointNav-v0}\n", "environment.scene: expected a scene"),
        (BASE + "environment: {map: m.npz, scene: oak}\n", "no 'scene'"),
        (BASE + "environment: {map: m.npz, end_on: stop}\n", "no 'end_on': training sets it"),
        (BASE + "environment: {map: m.npz, num_envs: 0}\n", "environment.num_envs"),
        (BASE + "environment: {map: m.npz, transition: a.npz, noise: low}\n", "no 'noise' beside 'transition'"),
        (BASE + "environment: {map: m.npz, transition: no.npz}\n", "environment.transition: expected a file"),
        (BASE + "environment: {id: vssm_gym/PointNav-v0, scene: oak, transition: a.npz}\n", "no 'transition'"),
        (BASE + "environment: {map: m.npz}\nfoo: 1\n", "foo: expected one of the fields name"),
        (BASE + "environment: {map: m.npz}\npolicy: {inputs: [scan]}\n", "'goal' among the inputs"),
        (BASE.replace("ppo", "dqn") + "environment: {map: m.npz}\n", "algorithm: expected"),
        (BASE.replace("{name: ppo}", "{name: ppo, tau: 1}") + "environment: {map: m.npz}\n", "algorithm.tau"),
        (BASE.replace("ppo", "bc") + "environment: {id: vssm_gym/PointNav-v0, scene: oak}\n", "the expert plans"),
        (
            BASE + "environment: {id: vssm_gym/PointNavGPS-v0, scene: oak}\n",
            "policy.inputs: expected scan, goal and commands",
        ),
        (
            BASE + "environment: {id: vssm_gym/PointNavGPS-v0, scene: oak, images: []}\n",
            "no 'images': training sets it",
        ),
    ],
)
def test_a_bad_configuration_is_one_clear_line(tmp_path, text, message):
    with pytest.raises(InputError, match=message) as error:
        load_training(written(tmp_path, text))
    assert "\n" not in str(error.value)


def test_paths_start_at_the_file_and_hashes_at_the_content(tmp_path):
    path = written(tmp_path, BASE + "environment: {map: maps/oak.npz, noise: mid}\n")
    found, other = load_training(path), load_training(path, map_file=tmp_path / "other.npz")
    assert found.environment.map == str(tmp_path / "maps" / "oak.npz") != other.environment.map
    assert found.environment.keywords == {"noise": "mid"}
    assert training_hash(found, "a") == training_hash(other, "a") != training_hash(found, "b")
    assert training_hash(found, "a") != training_hash(load_training(path, seed=1), "a")
    hashes = [training_hash(found, "a")]
    path = written(tmp_path, BASE + "environment: {map: maps/oak.npz, transition: drive.npz}\n")
    for content in (b"a", b"b"):
        (tmp_path / "drive.npz").write_bytes(content)
        hashes.append(training_hash(load_training(path), "a"))
    assert len(set(hashes)) == 3


def test_a_missing_map_is_refused_before_anything_is_written(tmp_path):
    pytest.importorskip("stable_baselines3", reason="needs the extra vssm-gym[rl]")
    wanted = load_training(written(tmp_path, BASE + "environment: {map: none.npz}\n"))
    with pytest.raises(InputError, match=r"none.npz: file: expected an existing map file"):
        run_training(wanted, tmp_path / "out")
    assert not (tmp_path / "out").exists()
