"""Test the command line: fast help, one line for bad input, and the commands that are quick enough to run here."""

import errno
import json
import os
import pickle
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.box_rooms import two_rooms
from vssm_gym.cli import doctor as doctor_module
from vssm_gym.cli import main as main_module
from vssm_gym.cli.train import _evaluation
from vssm_gym.compilation_cache import cache_folder
from vssm_gym.envs.scenes.scene import load_scene, save_scene
from vssm_gym.errors import InputError, OutputError
from vssm_gym.training.config import load_training

HEAVY = ["jax", "mujoco", "numba", "matplotlib", "scipy", "shapely", "embreex", "jinja2"]


def words(commands: dict, before: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """Return every complete command as a tuple of its words."""
    found = []
    for name, target in commands.items():
        found += words(target, (*before, name)) if isinstance(target, dict) else [(*before, name)]
    return found


def test_help_names_every_command(vssm):
    code, out, _ = vssm("--help")
    assert code == 0
    for command in main_module.COMMANDS:
        assert f" {command} " in out


def test_no_arguments_means_help(vssm):
    assert vssm()[:2] == vssm("--help")[:2]


@pytest.mark.parametrize("command", words(main_module.COMMANDS), ids=" ".join)
def test_every_command_and_option_has_a_description(vssm, command):
    """Every command and every option has a description; without one its line of the help would be empty."""
    code, out, _ = vssm(*command, "--help")
    assert code == 0
    assert f"usage: vssm-gym {' '.join(command)}" in " ".join(out.split())


def test_help_imports_no_heavy_library():
    """Help imports no heavy library, which keeps it fast on any machine."""
    code = (
        "import sys\nsys.argv = ['vssm-gym', '--help']\nfrom vssm_gym.cli.main import main\n"
        f"try:\n    main()\nfinally:\n    print(sorted(set({HEAVY}) & sys.modules.keys()), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"


@pytest.mark.parametrize("arguments", [("swep",), ("doctor", "--no-such-option"), ("map",), ("evaluate-trajectory",)])
def test_wrong_usage_exits_with_2(vssm, arguments):
    code, _, err = vssm(*arguments)
    assert code == 2
    assert "Traceback" not in err


def test_bad_input_is_one_line(vssm, monkeypatch):
    def refuse() -> None:
        """Refuse."""
        raise InputError("walk.txt", "line 3", "eight numbers")

    monkeypatch.setattr(doctor_module, "doctor", refuse)
    assert vssm("doctor") == (2, "", "error: walk.txt: line 3: expected eight numbers\n")


def test_bad_input_to_a_grouped_command_is_one_line_too(vssm, tmp_path):
    code, _, err = vssm("map", "build", str(tmp_path / "nowhere"), "--out", str(tmp_path / "map.npz"))
    assert code == 2
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert "nowhere" in err
    assert list(tmp_path.iterdir()) == []


def test_an_error_of_the_program_itself_keeps_its_traceback(vssm, monkeypatch):
    """A ValueError that is no InputError is a bug, and must not pass for a wrong option."""

    def broken() -> None:
        """Break."""
        raise ValueError("a bug")

    monkeypatch.setattr(doctor_module, "doctor", broken)
    with pytest.raises(ValueError, match="a bug"):
        vssm("doctor")


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (OutputError("out/map.npz", "No space left on device"), "out/map.npz: could not be written: No space left"),
        (OSError(errno.ENOSPC, "No space left on device", "out/map.npz"), "out/map.npz: No space left on device"),
        (OSError(errno.EDQUOT, "Disk quota exceeded"), "Disk quota exceeded"),
        (PermissionError(errno.EACCES, "Permission denied", "/out"), "/out: Permission denied"),
        (OSError(errno.EROFS, "Read-only file system", "/out"), "/out: Read-only file system"),
    ],
)
def test_what_cannot_be_written_is_one_line_and_1(vssm, monkeypatch, error, line):
    def full() -> None:
        """Meet a full disk."""
        raise pickle.loads(pickle.dumps(error))  # as a worker's error crosses to the parent

    monkeypatch.setattr(doctor_module, "doctor", full)
    code, out, err = vssm("doctor")
    assert (code, out, err.count("\n")) == (main_module.FAILED, "", 1)
    assert err.startswith(f"error: {line}")


def test_another_error_of_the_system_keeps_its_traceback(vssm, monkeypatch):
    def broken() -> None:
        """Break."""
        raise ProcessLookupError(errno.ESRCH, "No such process")

    monkeypatch.setattr(doctor_module, "doctor", broken)
    with pytest.raises(ProcessLookupError):
        vssm("doctor")


def test_a_full_disk_behind_stdout_is_one_line(tmp_path):
    """/dev/full takes nothing: neither the print nor the flush at exit shows a traceback."""
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full")
    program = (
        "import sys\nfrom vssm_gym.cli import doctor, main\n"
        "doctor.doctor = lambda: print('findings')\nsys.argv = ['vssm-gym', 'doctor']\nsys.exit(main.main())"
    )
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-c", program], stdout=full, stderr=subprocess.PIPE, text=True, timeout=60, check=False
        )
    assert (done.returncode, done.stderr) == (main_module.FAILED, "error: No space left on device\n")


def test_ctrl_c_is_one_line_and_130(vssm, monkeypatch):
    def interrupted() -> None:
        """Be interrupted."""
        raise KeyboardInterrupt

    monkeypatch.setattr(doctor_module, "doctor", interrupted)
    code, _, err = vssm("doctor")
    assert code == 130
    assert err.startswith("interrupted")
    assert err.count("\n") == 1


def test_an_interrupted_program_does_not_wait_for_what_python_collects_at_its_end():
    """XLA's threads may never end; buffers are written, and what is registered for the exit is called."""
    program = """
import atexit, sys, time
from vssm_gym.cli import doctor, main

class Endless:
    def __del__(self):
        time.sleep(60)

def interrupted() -> None:
    "Be interrupted."
    raise KeyboardInterrupt

endless, doctor.doctor, sys.argv[1:] = Endless(), interrupted, ["doctor"]
atexit.register(print, "at the exit")
main.program()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=50)
    assert (done.returncode, done.stdout) == (130, "at the exit\n")
    assert done.stderr.startswith("interrupted")


def test_a_closed_pipe_is_no_error(tmp_path):
    """``vssm-gym doctor | head -1``: the pipe closes while the command still writes."""
    code = "import sys; sys.argv = ['x', '--help']; from vssm_gym.cli.main import main; sys.exit(main())"
    quick = "import vssm_gym.cli.doctor as d\nd.doctor = lambda: print('x' * 1000000)\n"
    program = quick + code.replace("--help", "doctor")
    process = subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    process.stdout.read(1)
    process.stdout.close()
    _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (0, "")


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["benchmark", "--help"], ["map", "build", "--help"]])
def test_help_into_a_closed_pipe_is_no_error(arguments):
    """``vssm-gym benchmark --help | head -0``: the pipe is closed before the help is printed."""
    program = f"import sys; sys.argv[1:] = {arguments}; from vssm_gym.cli.main import main; sys.exit(main())"
    reader, writer = os.pipe()
    os.close(reader)
    try:
        done = subprocess.run(
            [sys.executable, "-c", program], stdout=writer, stderr=subprocess.PIPE, text=True, timeout=60, check=False
        )
    finally:
        os.close(writer)
    assert (done.returncode, done.stderr) == (0, "")


def test_record_and_sweep_print_a_scenes_warnings(vssm, tmp_path):
    """Warnings come before anything runs: here both commands then refuse another argument and write nothing."""
    flat = two_rooms(openness=0.0, leaves=1).model_copy(update={"notes": ("Rooms are not navigable.",)})
    save_scene(flat, tmp_path / "shut.json")
    (tmp_path / "sweep.yaml").write_text("scenes: [oak, shut.json]\nagents: random\ntasks: 1\n")
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "file").touch()
    for arguments in (
        ("record", "--scene", str(tmp_path / "shut.json"), "--out", str(tmp_path / "taken")),
        ("sweep", str(tmp_path / "sweep.yaml"), "--out", str(tmp_path / "none"), "--workers", "0"),
    ):
        code, out, err = vssm(*arguments)
        warning, *_, error = err.splitlines()
        assert warning.startswith("warning: shut: Rooms are not navigable; cut off from the rest: ")
        assert (code, out, error.split(":")[0]) == (main_module.BAD_INPUT, "", "error")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("record --scene oak --out {0}/file/r1", "r1: folder: expected a folder or the name of a new one"),
        ("record --scene oak --out {0}/new --seed -1", "record: seed: expected at least 0, found -1"),
        ("record --scene oak --out {0}/new --metres 5", "record: metres: expected none with --motion survey"),
        (
            "record --scene oak --out {0}/new --motion handheld --noise low",
            "record: noise: expected none with --motion handheld",
        ),
        ("record --scene oak --out {0}/new --robot wornn", "record: robot: expected one of 'holonomic', 'worn'"),
        ("record --scene oak --out {0}/new --size big", "record: size: expected WIDTHxHEIGHT in pixels"),
        ("record --scene oak --out {0}/new --size 4x3", "CameraConfig: width: expected 8 to 4096 pixels"),
        ("record --scene oak --out {0}/new --sensor-noise loud", "one of none, kinect, stereo"),
        ("map build {0} --out {0}", "file: expected the name of a file to write; it is a folder"),
        ("map build {0} --out {0}/map.npz", "map.npz: file: expected a new file: this one is never overwritten"),
        ("map build {0} --out {0}/map.txt", "map.txt: file: expected a name that ends in .npz"),
        ("scene generate --out {0}/home.json", "home.png: file: expected a new file: this one is never overwritten"),
        ("report {0}/demo --out {0}/demo/episodes.jsonl", "episodes.jsonl: file: expected a name that ends in .html"),
        ("evaluate-trajectory {0}/x.json {0}/file --json {0}/x.json", "x.json: file: expected another file than the"),
        ("demo --out {0}", "folder: expected a new or empty folder, or that of a sweep, which has a sweep.json"),
        ("map build {0} --out {0}/new/map.npz", "folder: expected a folder that exists"),
        ("evaluate-trajectory {0}/file {0}/file --json {0}/new/x.json", "folder: expected a folder that exists"),
        ("bench speed --out {0}/new --seed -1", "bench: seed: expected at least 0, found -1"),
        ("bench tracker --out {0}/new --workers 0", "bench: workers: expected at least 1, found 0"),
        ("bench drift --out {0}/new --trials 0", "bench: trials: expected at least 1, found 0"),
        ("bench slam --out {0}/new", "bench: LOG: expected a TUM folder after `bench slam`"),
        ("bench speed {0} --out {0}/new", "bench: LOG: expected a TUM folder after `bench slam`"),
        ("bench slam {0}/gone --out {0}/new", "gone: folder: expected an existing sequence folder"),
        ("bench --out {0}/file", "file: folder: expected a folder or the name of a new one"),
        ("slam {0} --out {0}/file/x", "x: folder: expected a folder or the name of a new one"),
        ("demo --out {0}/demo --workers 0", "sweep: workers: expected at least 1, found 0"),
    ],
)
def test_unusable_outputs_are_refused_before_the_work_starts(vssm, tmp_path, arguments, message):
    """Nothing is written."""
    (tmp_path / "file").write_text("years of work")
    (tmp_path / "demo").mkdir()
    for name in ("demo/sweep.json", "demo/episodes.jsonl", "map.npz", "home.png", "x.json"):
        (tmp_path / name).write_text("{}")
    before = sorted(tmp_path.rglob("*"))
    code, out, err = vssm(*(word.format(tmp_path) for word in arguments.split()))
    assert (code, out) == (main_module.BAD_INPUT, "")
    assert err.startswith("error: ")
    assert message in err
    assert err.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_bad_input_survives_a_process_boundary():
    error = InputError(Path("walk.txt"), "line 3", "eight numbers")
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is InputError
    assert str(again) == str(error) == "walk.txt: line 3: expected eight numbers"
    assert (again.source, again.field, again.expected) == (error.source, error.field, error.expected)


def test_slam_loads_no_simulator():
    code = "import sys, vssm_gym.slam.output; print(sorted({'mujoco', 'embreex'} & sys.modules.keys()))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_version(vssm):
    assert vssm("--version")[:2] == (0, f"vssm-gym {__import__('vssm_gym').__version__}\n")


def test_the_cache_folder_follows_the_xdg_standard(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "vssm_gym"


@pytest.mark.parametrize(
    ("where", "told"),
    [
        ({"id": "vssm_gym/PointNavGPS-v0", "scene": "fern"}, "--scene fern --out DIR"),
        ({"id": "vssm_gym/PointNav-v0", "scene": "my house.json"}, "--scene 'my house.json' --out DIR"),
        ({"map": "oak"}, "--scene oak --map oak --out DIR"),
        ({"map": "{0}/den.npz"}, "--scene SCENE --map .*den\\.npz --out DIR"),
    ],
)
def test_train_names_the_evaluation_where_it_was_trained(tmp_path, where, told):
    where = {name: value.format(tmp_path) for name, value in where.items()}
    (tmp_path / "den.npz").touch()
    inputs = ["scan", "goal"]
    file = tmp_path / "t.yaml"
    content = {"name": "x", "environment": where, "policy": {"inputs": inputs}, "algorithm": {"name": "ppo"}}
    file.write_text(json.dumps(content | {"steps": 1}))
    assert re.fullmatch(f"vssm-gym evaluate p.npz {told}", _evaluation(Path("p.npz"), load_training(file)))


# evaluate-trajectory


def circle(n: int = 50) -> np.ndarray:
    """Return ``(n, 4, 4)`` poses on a rising circle of 1 m radius."""
    angle = np.linspace(0, 2 * np.pi, n)
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, 3] = np.stack([np.cos(angle), np.sin(angle), 0.1 * angle], axis=1)
    return T


def write(path, T: np.ndarray) -> str:
    lines = [f"{i * 0.1:.6f} {t[0]:.9f} {t[1]:.9f} {t[2]:.9f} 0 0 0 1" for i, t in enumerate(T[:, :3, 3])]
    path.write_text("\n".join(lines) + "\n")
    return str(path)


def test_evaluate_trajectory_ignores_the_frame_and_reports_the_scale(vssm, tmp_path):
    truth = circle()
    moved = np.array(truth)
    moved[:, :3, 3] = 0.5 * (truth[:, :3, 3] + [3.0, -2.0, 1.0])
    est, true = write(tmp_path / "est.txt", moved), write(tmp_path / "true.txt", truth)

    code, out, _ = vssm("evaluate-trajectory", est, true, "--json", str(tmp_path / "rigid.json"))
    rigid = json.loads((tmp_path / "rigid.json").read_text())
    assert code == 0
    assert "alignment SE(3)" in out
    assert "50 pairs" in out
    # Half the size about its centre: each position is off by half its distance from the mean position.
    p = truth[:, :3, 3]
    expected = np.sqrt(np.mean(np.sum((0.5 * (p - p.mean(axis=0))) ** 2, axis=1)))
    assert rigid["ate_translation_se3"]["rmse"] == pytest.approx(expected, abs=1e-6)
    assert f"{expected:.5f}" in out

    code, out, _ = vssm("evaluate-trajectory", est, true, "--align", "sim3", "--json", str(tmp_path / "similar.json"))
    similar = json.loads((tmp_path / "similar.json").read_text())
    assert "Sim(3) with scale 2.0000" in out
    assert similar["scale"] == pytest.approx(2.0, abs=1e-6)
    assert similar["ate_translation_sim3"]["rmse"] == pytest.approx(0.0, abs=1e-6)
    assert similar["rpe_translation_1"]["rmse"] == pytest.approx(0.0, abs=1e-6)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["est.txt", "rigid.json", "similar.json", "true.txt"]

    code, out, _ = vssm("evaluate-trajectory", est, true, "--align", "first", "--json", str(tmp_path / "first.json"))
    drift = json.loads((tmp_path / "first.json").read_text())
    assert "alignment of the first pose" in out
    # Half the size about its start.
    expected = np.sqrt(np.mean(np.sum((0.5 * (p - p[0])) ** 2, axis=1)))
    assert drift["ate_translation_first"]["rmse"] == pytest.approx(expected, abs=1e-6)
    assert f"{expected:.6f}" in out
    assert "scale" not in drift


@pytest.mark.parametrize(
    ("name", "truth", "options", "entry"),
    [
        ("fr2_desk_ORB", "fr2_desk_groundtruth.txt", [], "ape_trans_se3"),
        ("freiburg1_xyz-rgbdslam", "freiburg1_xyz-groundtruth.txt", [], "ape_trans_se3"),
        ("V102", "V102_groundtruth.csv", [], "ape_trans_se3"),
        ("fr2_desk_ORB_kf_mono", "fr2_desk_groundtruth.txt", ["--align", "sim3"], "ape_trans_sim3"),
    ],
)
def test_evaluate_trajectory_gives_the_known_values(vssm, shared_data, tmp_path, name, truth, options, entry):
    folder, out = shared_data / "trajectories", tmp_path / "out.json"
    known = json.loads((folder / "reference_values.json").read_text())["results"][name]
    code, _, _ = vssm(
        "evaluate-trajectory", str(folder / f"{name}.txt"), str(folder / truth), *options, "--json", str(out)
    )
    result = json.loads(out.read_text())
    assert code == 0
    assert result["pairs"] == known["n_pairs"]
    alignment = entry.rpartition("_")[2]
    assert result[f"ate_translation_{alignment}"]["rmse"] == pytest.approx(known[entry]["rmse"], rel=1e-5)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (None, "est.txt"),
        ("", "est.txt"),
        ("0.0 1 2 3\n", "est.txt"),
        ("0.0 nan 0 0 0 0 0 1\n" * 3, "est.txt"),
        ("90.0 0 0 0 0 0 0 1\n91.0 1 0 0 0 0 0 1\n92.0 1 1 0 0 0 0 1\n", "within 0.01 s"),
    ],
    ids=["missing", "empty", "short", "nan", "no common stamp"],
)
def test_evaluate_trajectory_refuses_unusable_files(vssm, tmp_path, content, complaint):
    true = write(tmp_path / "true.txt", circle())
    if content is not None:
        (tmp_path / "est.txt").write_text(content)
    code, _, err = vssm("evaluate-trajectory", str(tmp_path / "est.txt"), true, "--json", str(tmp_path / "out.json"))
    assert code == 2
    assert err.startswith("error: ")
    assert complaint in err
    assert not (tmp_path / "out.json").exists()


def test_scene_import_writes_scene_and_picture(vssm, tmp_path):
    left = [[0, 3], [0, 0], [4, 0], [4, 1]]
    plan = {"verts": [*left, [4.1, 1], [4.1, 0], [7, 0], [7, 3], [4.1, 3], [4.1, 2], [4, 2], [4, 3]]}
    (tmp_path / "plan.json").write_text(json.dumps(plan))
    code, out, _ = vssm("scene", "import", str(tmp_path / "plan.json"), "--out", str(tmp_path / "flat.json"))
    assert code == 0
    assert "plan: 2 rooms, 1 door, 0 windows" in out
    assert "note: the file has no doors" in out
    assert load_scene(tmp_path / "flat.json").content_hash() == load_scene(tmp_path / "plan.json").content_hash()
    assert (tmp_path / "flat.png").read_bytes()[:4] == b"\x89PNG"


def test_scene_import_furnishes_a_plan_by_a_seed(vssm, tmp_path):
    plan = {"verts": [[0, 0], [4, 0], [4, 3], [0, 3]], "room_category": {"Bedroom": [[0, 0, 4, 3]]}}
    (tmp_path / "plan.json").write_text(json.dumps(plan))
    hashes = set()
    for name in ("a", "b"):
        code, out, _ = vssm(
            *("scene", "import", str(tmp_path / "plan.json"), "--furnish", "4", "--out", str(tmp_path / f"{name}.json"))
        )
        assert code == 0 and "plan-furnished-4: 1 room" in out
        hashes.add(load_scene(tmp_path / f"{name}.json").content_hash())
    assert len(hashes) == 1
    assert "bed" in {piece.category for piece in load_scene(tmp_path / "a.json").furniture}


def test_scene_preview_draws_a_built_in_scene(vssm, tmp_path):
    code, out, _ = vssm("scene", "preview", "oak", "--out", str(tmp_path / "oak.png"), "--height", "240")
    assert code == 0
    assert "oak: 5 rooms" in out
    assert (tmp_path / "oak.png").read_bytes()[:4] == b"\x89PNG"


def test_scene_preview_draws_a_maze(vssm, tmp_path):
    code, out, _ = vssm("scene", "preview", "spiral-v1", "--out", str(tmp_path / "maze.png"), "--height", "240")
    assert code == 0
    assert "spiral-v1: 1 room" in out and "a robot 0.025 m across" in out
    assert (tmp_path / "maze.png").read_bytes()[:4] == b"\x89PNG"


def test_scene_import_of_a_map_asks_for_its_yaml(vssm, tmp_path):
    (tmp_path / "map.pgm").write_bytes(b"P5 1 1 255 .")
    code, _, err = vssm("scene", "import", str(tmp_path / "map.pgm"), "--out", str(tmp_path / "flat.json"))
    assert code == 2
    assert "the YAML of the ROS map that names map.pgm as its image" in err and err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("scene", "preview", "oak", "--out", "oak.json"), "a name that ends in .png"),
        (("scene", "preview", "oak", "--out", "oak.png", "--height", "9"), "120 to 4320 pixels"),
        (("scene", "import", "no-such-file.xml", "--out", "flat.json"), "the path of an existing file"),
        (("scene", "import", "oak", "--out", "flat.txt"), "a name that ends in .json"),
        (("scene", "import", "oak", "--furnish", "1", "--out", "flat.json"), "a plan without furniture"),
    ],
)
def test_scene_commands_report_errors_in_one_line(vssm, tmp_path, monkeypatch, arguments, complaint):
    monkeypatch.chdir(tmp_path)
    code, _, err = vssm(*arguments)
    assert code == 2
    assert complaint in err and err.count("\n") == 1
    assert not list(tmp_path.iterdir())


# early errors


def test_an_early_error_stands_alone_on_stderr(vssm, tmp_path):
    """A display of progress that shows nothing prints nothing, not even an empty line before the message."""
    (tmp_path / "empty").mkdir()
    (tmp_path / "c.yaml").write_text("name: x\n")
    for command in (
        f"map build {tmp_path / 'empty'} --out {tmp_path / 'map.npz'}",
        f"bench slam {tmp_path / 'empty'} --out {tmp_path / 'bench'}",
        f"record --scene {tmp_path / 'none.json'} --out {tmp_path / 'r'} --motion flight --flight loop",
        f"slam {tmp_path / 'empty'} --out {tmp_path / 's'}",
        f"train {tmp_path / 'c.yaml'} --out {tmp_path / 't'}",
    ):
        code, out, err = vssm(*command.split())
        assert (code, out) == (main_module.BAD_INPUT, ""), command
        assert err.startswith("error: "), command
        assert err.count("\n") == 1, command
