"""Test what is refused before Ray is asked, and that machines with other versions are."""

import socket
import sys

import pytest

from vssm_gym.cli.main import main
from vssm_gym.cluster.address import check_address
from vssm_gym.cluster.installed import ALSO, CODE, check_same, installed
from vssm_gym.errors import InputError


@pytest.mark.parametrize(
    "address", ["", "here", "10.0.0.1", "10.0.0.1:", ":6379", "a b:1", "head:0", "head:65536", "local"]
)
def test_what_is_no_address_is_refused(address):
    with pytest.raises(
        InputError, match=r"--ray: address: expected auto or HOST:PORT, as `ray start --head` prints it"
    ):
        check_address(address)


def test_the_client_mode_is_refused_by_name():
    with pytest.raises(InputError, match=r"Ray's client mode \(ray://\) is not supported"):
        check_address("ray://127.0.0.1:10001")


def test_a_head_that_does_not_answer_is_refused_and_one_that_does_passes():
    with socket.socket() as head:
        head.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{head.getsockname()[1]}"
        with pytest.raises(InputError, match=r"the head of a running cluster; 127\.0\.0\.1:\d+ does not answer"):
            check_address(address)
        head.listen()
        check_address(address)


def test_every_difference_between_machines_is_refused_by_its_name():
    here = installed()
    assert {"vssm_gym", CODE, "Python", "jax", "mujoco", "numpy", *ALSO} <= here.keys()
    check_same(here, dict(here), "two")
    for name in here:
        with pytest.raises(InputError, match=r"machine two: expected .*; found other: install the same") as caught:
            check_same(here, here | {name: "other"}, "two")
        assert caught.value.expected.startswith(f"{name} {here[name]}, as on the machine of the command")
        with pytest.raises(InputError, match="found none"):
            check_same(here, {key: value for key, value in here.items() if key != name}, "two")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--ray", "auto"], "train: ray: expected --seeds as well"),
        (["--seeds", "0,1", "--seed", "2"], "train: seed: expected either --seed or --seeds"),
        (["--seeds", "0,x"], "train: seeds: expected whole numbers with commas between them"),
        (["--seeds", "0,0"], "train: seeds: expected values that differ"),
        (["--seeds", "0,-1"], "train: seeds: expected at least 0, found -1"),
        (["--seeds", "0", "--ray", "nowhere"], "--ray: address: expected auto or HOST:PORT"),
    ],
)
def test_trainings_refuse_what_does_not_fit_together(tmp_path, monkeypatch, capsys, words, message):
    (tmp_path / "train.yaml").write_text(
        "name: tiny\nenvironment: {id: vssm_gym/PointNav-v0, scene: oak}\npolicy: {inputs: [goal]}\n"
        "algorithm: {name: ppo}\nsteps: 10\n"
    )
    out = tmp_path / "out"
    monkeypatch.setattr(sys, "argv", ["vssm-gym", "train", str(tmp_path / "train.yaml"), "--out", str(out), *words])
    assert main() == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {message}") and not out.exists()


def test_a_sweep_refuses_an_address_before_it_makes_a_folder(tmp_path, monkeypatch, capsys):
    (tmp_path / "sweep.yaml").write_text("scenes: oak\nagents: random\ntasks: 1\n")
    words = [str(tmp_path / "sweep.yaml"), "--out", str(tmp_path / "out"), "--ray", "ray://head:10001"]
    monkeypatch.setattr(sys, "argv", ["vssm-gym", "sweep", *words])
    assert main() == 2
    assert "error: --ray: address: expected auto or HOST:PORT" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
