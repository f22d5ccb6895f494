"""Test sweeps with real worker processes: interrupted anywhere and resumed, every episode has exactly one row."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

import vssm_gym as vg
from tests.chaos.disks import largest_file
from tests.helpers.box_rooms import two_rooms
from vssm_gym.cli.main import main
from vssm_gym.envs.scenes.scene import save_scene
from vssm_gym.errors import InputError, OutputError
from vssm_gym.eval.episodes.log import FILE, EpisodeLog, episode_key, read_rows
from vssm_gym.eval.episodes.manifest import MANIFEST
from vssm_gym.eval.report.page import write_report
from vssm_gym.eval.sweep import worker
from vssm_gym.eval.sweep.config import expand, load_config
from vssm_gym.eval.sweep.manifest import config_hash
from vssm_gym.eval.sweep.pools import LocalPool
from vssm_gym.eval.sweep.runner import SHARED, _batches, _run, run_sweep
from vssm_gym.maps.map_file import map_hash
from vssm_gym.slam.map_building import ensure_map
from vssm_gym.version import package_version

TIMED = ("latency",)  # the only fields that may differ between two runs of one episode


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Write a scene of two rooms and a sweep of the random agent over six episodes in it."""
    path = tmp_path_factory.mktemp("sweep")
    save_scene(two_rooms(), path / "rooms.json")
    (path / "sweep.yaml").write_text("scenes: rooms.json\nagents: random\nnoise: mid\ntasks: 3\nseeds: [0, 1]\n")
    return path


@pytest.fixture(scope="module")
def finished(folder):
    """Run the whole sweep once without interruption."""
    heard = []
    log = run_sweep(
        load_config(folder / "sweep.yaml"), folder / "whole", workers=1, on_progress=lambda *event: heard.append(event)
    )
    return log, heard


def untimed(rows):
    return {episode_key(row): {k: v for k, v in row.items() if k not in TIMED} for row in rows}


def test_a_sweep_writes_every_episode_once_with_its_configuration(folder, finished):
    log, heard = finished
    rows = read_rows(log)
    assert sorted((row["task"], row["seed"]) for row in rows) == [(t, s) for t in range(3) for s in range(2)]
    manifest = json.loads((folder / "whole" / MANIFEST).read_text())
    for row in rows:
        assert (row["scene"], row["agent"], row["noise"], row["robot"]) == ("rooms", "random", "mid", "holonomic")
        assert row["config_hash"] == manifest["config_hash"]
        assert row["version"] == manifest["version"] == package_version()
        assert row["map_hash"] is None
        assert row["success"] == (row["failure"] is None)
        assert {"spl", "soft_spl", "steps", "collisions", "path_length", "geodesic", "distance_to_goal"} <= row.keys()
        assert row["location_error_mean"] is row["nees"] is row["in_95"] is None  # the random agent keeps no estimate
    assert heard == [("episodes", n, 6) for n in range(7)]
    assert not (folder / "whole" / "maps").exists()  # the random agent needs none


@pytest.mark.slow
def test_a_sweep_cut_in_the_middle_of_a_line_resumes_to_the_same_rows(folder, finished, tmp_path):
    """A kill leaves four whole lines and a half one; no row is then lost, doubled or changed."""
    lines = finished[0].read_bytes().splitlines(keepends=True)
    (tmp_path / FILE).write_bytes(b"".join(lines[:4]) + lines[4][: len(lines[4]) // 2])
    (tmp_path / MANIFEST).write_bytes((folder / "whole" / MANIFEST).read_bytes())
    log = run_sweep(load_config(folder / "sweep.yaml"), tmp_path, resume=True, workers=2)
    assert log.read_bytes().startswith(b"".join(lines[:4]))
    assert untimed(read_rows(log)) == untimed(read_rows(finished[0]))


def test_only_scenes_without_a_map_share_workers():
    """Every job is handed out once, in order; a scene with a map has workers of its own, before the next is learned."""
    scenes = [[SimpleNamespace(scene=k, map_file=None)] * 2 for k in range(SHARED + 3)]
    assert [len(jobs) for jobs in _batches(scenes)] == [2 * SHARED, 6]
    assert [job.scene for jobs in _batches(scenes) for job in jobs] == [k for k in range(SHARED + 3) for _ in range(2)]
    mixed = [[SimpleNamespace(scene=k, map_file=Path("map.npz") if k == 1 else None)] for k in range(3)]
    assert [[job.scene for job in jobs] for jobs in _batches(mixed)] == [[0], [1], [2]]
    learned = []

    def learning():
        for k in range(3):
            learned.append(k)
            yield [SimpleNamespace(scene=k, map_file=None), SimpleNamespace(scene=k, map_file=Path("map.npz"))]

    for k, jobs in enumerate(_batches(learning())):
        assert [job.scene for job in jobs] == [k, k] and learned == list(range(k + 1))


def test_a_finished_sweep_resumes_to_itself(folder, finished):
    before = finished[0].read_bytes()
    run_sweep(load_config(folder / "sweep.yaml"), folder / "whole", resume=True)
    assert finished[0].read_bytes() == before


def test_a_folder_with_episodes_is_refused_without_resume(folder, finished):
    with pytest.raises(InputError, match=r"a folder without a sweep; it holds episodes\.jsonl \(--resume"):
        run_sweep(load_config(folder / "sweep.yaml"), folder / "whole")


@pytest.mark.parametrize("change", ["noise: low", "seeds: [0, 2]", "tasks: 4"])
def test_another_configuration_cannot_continue_it(folder, finished, change):
    before = finished[0].read_bytes()
    name = change.split(":")[0]
    lines = [line for line in (folder / "sweep.yaml").read_text().splitlines() if not line.startswith(name)]
    other = folder / "other.yaml"
    other.write_text("\n".join([*lines, change]) + "\n")
    with pytest.raises(InputError, match=r"sweep\.json: config_hash: expected .*another sweep"):
        run_sweep(load_config(other), folder / "whole", resume=True)
    with pytest.raises(InputError, match="config_hash"):
        run_sweep(load_config(folder / "sweep.yaml"), folder / "whole", resume=True, seed=1)
    assert finished[0].read_bytes() == before


def test_a_scene_that_changed_cannot_continue_it(folder, finished, tmp_path):
    save_scene(two_rooms(openness=0.9), tmp_path / "rooms.json")
    (tmp_path / "sweep.yaml").write_text((folder / "sweep.yaml").read_text())
    with pytest.raises(InputError, match="config_hash"):
        run_sweep(load_config(tmp_path / "sweep.yaml"), folder / "whole", resume=True)


def test_rooms_that_are_cut_off_are_reported(tmp_path, capfd):
    """A closed door between the two rooms: tasks stay in one of them, and manifest and report say so, output once."""
    save_scene(two_rooms(openness=0.0, leaves=1), tmp_path / "shut.json")
    (tmp_path / "sweep.yaml").write_text("scenes: shut.json\nagents: random\ntasks: 1\n")
    vg.run_sweep(load_config(tmp_path / "sweep.yaml"), str(tmp_path / "out"), workers=1)
    said = capfd.readouterr()
    assert said.err.count("cut off") == 1 and "Warning" not in said.err
    assert "progress: running episodes: 1 of 1" in said.err
    assert re.search(r"random +1 ", said.out)
    vg.run_sweep(load_config(tmp_path / "sweep.yaml"), tmp_path / "out", resume=True, quiet=True)
    assert capfd.readouterr() == ("", "")
    notice = json.loads((tmp_path / "out" / MANIFEST).read_text())["notices"]["shut"]
    assert re.match("cut off from the rest: (west|east); only the largest", notice)
    assert f"shut: {notice}" in write_report(tmp_path / "out").read_text()


def test_the_hash_depends_on_the_content_not_on_the_path(folder):
    config = load_config(folder / "sweep.yaml")
    elsewhere = config.model_copy(update={"scenes": ("/elsewhere/rooms.json",)})
    hashes = {config.scenes[0]: "abc", "/elsewhere/rooms.json": "abc"}
    assert config_hash(config, hashes, 0) == config_hash(elsewhere, hashes, 0)
    assert config_hash(config, hashes, 0) != config_hash(config, hashes | {config.scenes[0]: "abd"}, 0)


@pytest.mark.parametrize(
    ("out", "options", "message"),
    [
        ("none", {"workers": 0}, "sweep: workers: expected at least 1, found 0"),
        ("none", {"seed": -1}, "sweep: seed: expected at least 0, found -1"),
        ("file", {}, "file: folder: expected a folder or the name of a new one"),
        ("file/x", {}, "x: folder: expected a folder or the name of a new one; .*file is a file"),
        ("", {}, "folder: expected a new or empty folder, or that of a sweep, .*it holds file"),
        ("", {"resume": True}, "folder: expected a new or empty folder, or that of a sweep, .*it holds file"),
    ],
)
def test_unusable_settings_and_folders_are_refused_and_nothing_is_changed(folder, tmp_path, out, options, message):
    (tmp_path / "file").write_text("years of work")
    with pytest.raises(InputError, match=message):
        run_sweep(load_config(folder / "sweep.yaml"), tmp_path / out, **options)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_the_demo_clears_no_other_sweep_away(folder, finished, tmp_path, monkeypatch, capsys):
    """It once removed the episodes, maps and recordings of any folder with a sweep.json."""
    out = tmp_path / "out"
    shutil.copytree(folder / "whole", out)
    (out / "maps").mkdir()
    (out / "maps" / "rooms.npz").write_text("a map")
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    for options in ([], ["--resume"], ["--seed", "3"]):
        monkeypatch.setattr(sys, "argv", ["vssm-gym", "demo", "--out", str(out), *options])
        assert main() == 2
        (error,) = capsys.readouterr().err.splitlines()
        assert "config_hash" in error and "choose another folder, or delete it yourself" in error
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


@pytest.mark.slow
def test_a_sweep_that_runs_keeps_its_folder(folder, tmp_path):
    """A second one on the same folder is refused before it writes anything, whatever it is."""
    config = load_config(folder / "sweep.yaml")

    def meanwhile(stage, done, total):
        if done == 2:
            rows = (tmp_path / FILE).read_bytes()
            for options in ({"resume": True}, {}, {"seed": 1}):
                with pytest.raises(InputError, match="no other run writing to it"):
                    run_sweep(config, tmp_path, **options)
            assert (tmp_path / FILE).read_bytes() == rows

    run_sweep(config, tmp_path, workers=1, on_progress=meanwhile)
    assert len(read_rows(tmp_path / FILE)) == 6


@pytest.mark.slow
def test_an_interrupted_sweep_keeps_the_episodes_that_have_begun(folder, finished, tmp_path):
    """It says how many of them it waits for, writes each, and its resumption runs the others."""
    heard = []

    def interrupt(*event):
        heard.append(event)
        if event[:2] == ("episodes", 1):
            raise KeyboardInterrupt

    config = load_config(folder / "sweep.yaml")
    with pytest.raises(KeyboardInterrupt):
        run_sweep(config, tmp_path, workers=1, on_progress=interrupt)
    ending = [event[1:] for event in heard if event[0] == "ending"]
    assert ending == [(done, len(ending) - 1) for done in range(len(ending))]
    kept = read_rows(tmp_path / FILE)
    assert len(ending) == len(kept) < 6
    rows = read_rows(run_sweep(config, tmp_path, resume=True, workers=1))
    assert rows[: len(kept)] == kept
    assert untimed(rows) == untimed(read_rows(finished[0]))


@pytest.mark.slow
def test_a_full_disk_ends_a_sweep_with_its_rows_and_resume_ends_it(folder, finished, tmp_path):
    size = len(b"".join(finished[0].read_bytes().splitlines(keepends=True)[:3])) + 10
    config = load_config(folder / "sweep.yaml")
    message = r"episodes\.jsonl: could not be written: File too large"
    with largest_file(size), pytest.raises(OutputError, match=message):
        run_sweep(config, tmp_path, workers=1)
    kept = read_rows(tmp_path / FILE)
    assert 1 <= len(kept) < 6
    run_sweep(config, tmp_path, resume=True, workers=1)
    assert read_rows(tmp_path / FILE)[: len(kept)] == kept
    assert untimed(read_rows(tmp_path / FILE)) == untimed(read_rows(finished[0]))


def test_bad_input_that_a_worker_finds_is_shown_as_it_is(folder, tmp_path):
    """The error of the worker process is raised in the parent, not as a worker that died."""
    episode = next(expand(load_config(folder / "sweep.yaml")))
    job = worker.Job(episode, None, None, tmp_path / "tasks.json", "scene", "hash", "version")
    with EpisodeLog(tmp_path / FILE) as log, pytest.raises(InputError, match=r"tasks\.json: file: expected a readable"):
        _run([job], log, LocalPool, 1, None)


def test_the_parent_keeps_its_own_threads():
    before = dict(os.environ)
    with worker.single_threaded_children():
        assert os.environ["NUMBA_NUM_THREADS"] == "1"
        assert "--xla_cpu_multi_thread_eigen=false" in os.environ["XLA_FLAGS"]
    assert dict(os.environ) == before


def start(folder, out, stderr=None):
    """Start a sweep, long enough to be interrupted, in a process group of its own."""
    (folder / "long.yaml").write_text("scenes: rooms.json\nagents: random\ntasks: 60\n")
    code = (
        "import sys; from pathlib import Path\n"
        "from vssm_gym.eval.sweep.config import load_config\n"
        "from vssm_gym.eval.sweep.runner import run_sweep\n"
        "if __name__ == '__main__': run_sweep(load_config(Path(sys.argv[1])), Path(sys.argv[2]), resume=True)\n"
    )
    script = folder / "start.py"
    script.write_text(code)
    return subprocess.Popen(
        [sys.executable, script, folder / "long.yaml", out],
        start_new_session=True,
        # A suite that runs in the background of a shell inherits an ignored Ctrl-C; a terminal's child does not.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        stderr=stderr,
    )


def wait_for_rows(out, n):
    deadline = time.monotonic() + 300
    while not (out / FILE).is_file() or (out / FILE).read_bytes().count(b"\n") < n:
        assert time.monotonic() < deadline
        time.sleep(0.02)


def children(pid):
    found = subprocess.run(["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True, check=False)
    return [int(word) for word in found.stdout.split()]


def alive(pid):
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except FileNotFoundError:
        return False


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for left-over processes in /proc")
def test_a_killed_sweep_leaves_no_process_and_resumes_to_every_episode_once(folder, tmp_path):
    process = start(folder, tmp_path)
    wait_for_rows(tmp_path, 5)
    workers = children(process.pid)
    process.kill()
    process.wait()
    deadline = time.monotonic() + 60
    while any(alive(pid) for pid in workers):
        assert time.monotonic() < deadline, "workers outlive the sweep"
        time.sleep(0.1)
    kept = read_rows(tmp_path / FILE)
    assert 5 <= len(kept) < 60
    log = run_sweep(load_config(folder / "long.yaml"), tmp_path, resume=True)
    rows = read_rows(log)
    assert rows[: len(kept)] == kept
    assert sorted(row["task"] for row in rows) == list(range(60))


@pytest.mark.slow
def test_ctrl_c_keeps_finished_episodes(folder, tmp_path):
    process = start(folder, tmp_path)
    wait_for_rows(tmp_path, 5)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to the workers too
    assert process.wait(timeout=120) != 0
    data = (tmp_path / FILE).read_bytes()
    assert data.endswith(b"\n")
    assert 5 <= len(read_rows(tmp_path / FILE)) < 60


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="finds the worker in /proc")
def test_a_worker_that_is_killed_ends_the_sweep_with_one_clear_error(folder, tmp_path):
    process = start(folder, tmp_path, stderr=subprocess.PIPE)
    wait_for_rows(tmp_path, 5)
    workers = [pid for pid in children(process.pid) if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    os.kill(workers[0], signal.SIGKILL)
    error = process.communicate(timeout=120)[1].decode()
    assert "WorkerDiedError: sweep: workers: expected worker processes that live to the end" in error
    assert f"{len(read_rows(tmp_path / FILE))} of 60 episodes are kept (--resume" in error


@pytest.mark.slow
def test_agents_in_a_learned_map_end_to_end(folder, tmp_path):
    """A scene is recorded and mapped once; a planner runs with and without images; a report is written."""
    (folder / "agents.yaml").write_text("scenes: rooms.json\nagents: [oracle, dead_reckoning]\ntasks: 3\nvoxel: 0.1\n")
    log = run_sweep(load_config(folder / "agents.yaml"), tmp_path)
    rows = read_rows(log)
    assert len(rows) == 6
    assert all(row["success"] for row in rows if row["agent"] == "oracle")
    for row in rows:  # the oracle's pose is observed
        kept = row["agent"] == "dead_reckoning"
        assert all((row[name] is not None) == kept for name in ("location_error_mean", "nees", "in_95"))
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert all({"location_error_mean", "nees", "in_95"} <= line.keys() for line in lines)
    learned = map_hash(tmp_path / "maps" / "rooms.npz")
    assert {(row["agent"], row["map_hash"]) for row in rows} == {("oracle", learned), ("dead_reckoning", learned)}
    stamp = (tmp_path / "maps" / "rooms.npz").stat().st_mtime_ns
    scene = load_config(folder / "agents.yaml").scenes[0]
    again = ensure_map(scene, tmp_path, voxel=0.1, seed=0)
    assert again.stat().st_mtime_ns == stamp
    page = write_report(tmp_path).read_text()
    assert "rooms" in page and "NEES / dim" in page and "inside 95 %" in page
