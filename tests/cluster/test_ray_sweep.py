"""Test sweeps on a Ray cluster of two nodes: rows of one process, killed workers, nodes and drivers, other versions."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from tests.helpers.box_rooms import two_rooms
from tests.helpers.paths import CHECKOUT
from vssm_gym.envs.scenes.scene import save_scene
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.log import FILE, episode_key, read_rows
from vssm_gym.eval.sweep.config import load_config
from vssm_gym.eval.sweep.runner import run_sweep

pytest.importorskip("ray")
from tests.helpers.sweeps.ray_nodes import Nodes, two_nodes

pytestmark = pytest.mark.slow

LONG = "scenes: rooms.json\nagents: random\ntasks: 24\n"
START = (
    "import sys; from pathlib import Path\n"
    "from vssm_gym.eval.sweep.config import load_config\n"
    "from vssm_gym.eval.sweep.runner import run_sweep\n"
    "run_sweep(load_config(Path(sys.argv[1])), Path(sys.argv[2]), resume=True, ray=sys.argv[3])\n"
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("ray")
    save_scene(two_rooms(), path / "rooms.json")
    (path / "long.yaml").write_text(LONG)
    return path


@pytest.fixture(scope="module")
def alone(folder):
    """Return the rows of the long sweep in one process."""
    return untimed(run_sweep(load_config(folder / "long.yaml"), folder / "alone", workers=1))


def untimed(log):
    """Return the rows by their identity, without what a clock measured; raise where one is doubled."""
    return {episode_key(row): {k: v for k, v in row.items() if k != "latency"} for row in read_rows(log)}


def start(folder, out, nodes: Nodes):
    return subprocess.Popen(
        [sys.executable, "-c", START, folder / "long.yaml", out, nodes.address],
        env=os.environ | {"PYTHONPATH": str(CHECKOUT)},
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def wait_for_rows(out, n, process=None):
    deadline = time.monotonic() + 300
    while not (out / FILE).is_file() or (out / FILE).read_bytes().count(b"\n") < n:
        assert time.monotonic() < deadline and (process is None or process.poll() is None)
        time.sleep(0.02)


@pytest.mark.parametrize(
    "text",
    [
        "scenes: rooms.json\nagents: [oracle, policy:reactive]\ntasks: 2\nvoxel: 0.1\n",
        "env: vssm_gym/Explore-v0\nscenes: [rooms.json, procedural:3:small]\nagents: frontier_nearest\ntasks: 1\n"
        "seeds: [0, 1]\nexplore: {steps: 25}\n",
        "env: vssm_gym/LidarMaze-v0\nscenes: serpentine-v1\nagents: dist_bug\nrobot: disc\nphysics: none\ntasks: 2\n",
    ],
    ids=["map", "explore", "maze"],
)
def test_rows_and_maps_are_those_of_one_process(folder, nodes, tmp_path, text):
    (folder / "some.yaml").write_text(text)
    config = load_config(folder / "some.yaml")
    here = run_sweep(config, tmp_path / "here", workers=1)
    heard = []
    there = run_sweep(config, tmp_path / "there", ray=nodes.address, on_progress=lambda *event: heard.append(event))
    assert untimed(there) == untimed(here) != {}
    explored = [sorted(path.name for path in (out / "explored").glob("*")) for out in (here.parent, there.parent)]
    assert explored[0] == explored[1] and bool(explored[0]) == ("Explore" in text)
    assert [event for event in heard if event[0] == "episodes"][-1][1:] == (len(untimed(here)),) * 2
    assert nodes.files() == []  # what travelled is gone


def test_a_killed_worker_loses_nothing(folder, nodes, alone, tmp_path):
    """Ray repeats its episode; four workers are killed while the sweep runs."""
    killed = set()

    def kill():
        wait_for_rows(tmp_path, 4)
        while len(killed) < 4 and (tmp_path / FILE).read_bytes().count(b"\n") < 18:
            killed.update(nodes.kill_workers(but=killed))
            time.sleep(3.0)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    rows = untimed(run_sweep(load_config(folder / "long.yaml"), tmp_path, ray=nodes.address))
    killer.join()
    assert killed
    assert rows == alone


def test_a_killed_driver_resumes_to_the_same_rows(folder, nodes, alone, tmp_path):
    process = start(folder, tmp_path, nodes)
    wait_for_rows(tmp_path, 4, process)
    process.kill()
    process.wait()
    kept = read_rows(tmp_path / FILE)
    assert 4 <= len(kept) < 24
    log = run_sweep(load_config(folder / "long.yaml"), tmp_path, resume=True, ray=nodes.address)
    assert read_rows(log)[: len(kept)] == kept
    assert untimed(log) == alone


def test_ctrl_c_keeps_the_episodes_that_have_begun(folder, nodes, alone, tmp_path):
    """The two that run then end and are kept; a sweep without a cluster runs the others."""
    process = start(folder, tmp_path, nodes)
    wait_for_rows(tmp_path, 4, process)
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(timeout=120) != 0
    kept = read_rows(tmp_path / FILE)
    assert 4 <= len(kept) < 24
    log = run_sweep(load_config(folder / "long.yaml"), tmp_path, resume=True, workers=1)
    assert read_rows(log)[: len(kept)] == kept
    assert untimed(log) == alone


def test_an_error_of_an_episode_is_shown_as_it_is(folder, nodes, tmp_path, monkeypatch):
    """A scene that is another one than the sweep's is refused by the machine that finds it."""
    monkeypatch.setattr("vssm_gym.eval.sweep.ray_pool._check_scene", None)  # of this process: the nodes' is intact
    from vssm_gym.eval.sweep import runner

    made = runner.jobs_of
    changed = lambda *arguments: [
        runner.worker.Job(job.episode, None, None, job.task_file, "0" * 16, job.config_hash, job.version)
        for job in made(*arguments)
    ]
    monkeypatch.setattr(runner, "jobs_of", changed)
    with pytest.raises(InputError, match=r"--ray: scene rooms: expected content 0{16} on every machine; found"):
        run_sweep(load_config(folder / "long.yaml"), tmp_path / "out", ray=nodes.address)
    assert not (tmp_path / "out" / FILE).exists() or read_rows(tmp_path / "out" / FILE) == []


@pytest.mark.parametrize("name", ["vssm_gym", "jax"])
def test_nodes_with_other_versions_are_refused(folder, nodes, tmp_path, monkeypatch, name):
    from vssm_gym.cluster import ray_cluster

    here = ray_cluster.installed() | {name: "9.9"}
    monkeypatch.setattr(ray_cluster, "installed", lambda: here)
    with pytest.raises(InputError, match=rf"--ray: machine .+: expected {name} 9\.9, as on the machine of the command"):
        run_sweep(load_config(folder / "long.yaml"), tmp_path / "out", ray=nodes.address)
    assert not (tmp_path / "out").exists()


def test_a_killed_node_loses_nothing(folder, alone, tmp_path):
    """The other node runs the rest; the driver is on the one that lives."""
    with two_nodes() as nodes:
        killer = threading.Thread(target=lambda: (wait_for_rows(tmp_path, 6), nodes.kill(1)), daemon=True)
        killer.start()
        rows = untimed(run_sweep(load_config(folder / "long.yaml"), tmp_path, ray=nodes.address))
        killer.join()
        assert nodes.processes[1].poll() is not None
    assert rows == alone
