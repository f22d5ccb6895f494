"""Test sweeps with agents of a program: their code, the program that workers import, and errors inside them."""

import importlib
import inspect
import subprocess
import sys
import textwrap
import types

import numpy as np
import pytest

from tests.helpers.box_rooms import two_rooms
from vssm_gym.agents import registry
from vssm_gym.agents.base import AGENT_ROBOTS, AGENT_TASKS, ANY_TASK, Decision, decide
from vssm_gym.envs.registration import ENVIRONMENTS
from vssm_gym.envs.scenes.scene import save_scene
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.log import FILE, read_rows
from vssm_gym.eval.sweep import runner, worker
from vssm_gym.eval.sweep.config import load_config
from vssm_gym.eval.sweep.own_agents import check_importable, code_hash, code_hashes, own_agents
from vssm_gym.eval.sweep.runner import run_sweep


class Halting:
    """Stop at once."""

    name, robot, task, needs_pose, needs_map = "halting", "holonomic", "pointgoal", False, False

    def reset(self, context, observation, seed):
        """Keep nothing."""

    def act(self, observation):
        """Stop."""
        return Decision(np.array([0.0, 0.0, 0.0, 1.0], np.float32), None, "stop")


@pytest.fixture
def known(monkeypatch):
    """Register agents for one test only."""
    monkeypatch.setattr(registry, "AGENTS", dict(registry.AGENTS))
    return registry.register_agent


@pytest.fixture
def config(tmp_path):
    """Write a sweep of the own agent and return its file."""
    save_scene(two_rooms(), tmp_path / "rooms.json")
    path = tmp_path / "sweep.yaml"
    path.write_text("scenes: rooms.json\nagents: [halting, random]\ntasks: 2\n")
    return path


# registration


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"robot": None}, "agent Wrong: robot: expected the class attributes name, .*; robot missing"),
        ({"task": "pointnav"}, "agent Wrong: task: expected one of pointgoal, .*; its task is 'pointnav'"),
        ({"robot": "drone"}, "agent Wrong: robot: expected one of holonomic, .*; its robot is 'drone'"),
        ({"needs_map": 1}, "agent Wrong: needs_map: expected True or False; found 1"),
        ({"act": 3}, "agent Wrong: act: expected a method; found 3"),
        ({"name": "policy:mine"}, "agent Wrong: name: expected a printable name without"),
        ({"__init__": lambda self, gain: None}, "agent Wrong: __init__: expected no argument .*; gain has none"),
    ],
)
def test_a_class_that_is_no_agent_is_refused_when_it_is_registered(known, changed, message):
    fields = {name: value for name, value in vars(Halting).items() if not name.startswith("__")}
    fields |= {"name": "wrong"} | changed
    wrong = type("Wrong", (), {name: value for name, value in fields.items() if value is not None})
    with pytest.raises(InputError, match=message):
        known(wrong)
    assert "wrong" not in registry.AGENTS


def test_an_object_in_place_of_the_class_is_refused(known):
    with pytest.raises(InputError, match="expected the class of an agent; found Halting"):
        known(Halting())


def test_agents_may_be_for_every_robot_and_task_of_an_environment_that_is_swept():
    swept = [spec for spec in ENVIRONMENTS.values() if spec.protocol]
    assert {spec.robot for spec in swept} == set(AGENT_ROBOTS)
    assert {spec.task for spec in swept} | {ANY_TASK} == set(AGENT_TASKS)


def test_a_sweep_of_an_agent_that_is_not_registered_says_where_it_is_known(config):
    with pytest.raises(InputError, match=r"found 'halting' \(an agent of your own is known to the program"):
        load_config(config)


def test_a_sweep_of_an_agent_for_another_environment_says_what_it_is_for(config):
    config.write_text("scenes: rooms.json\nagents: dwa\ntasks: 2\n")
    with pytest.raises(InputError, match=r"found 'dwa', whose robot is 'car' .*; vssm_gym/PointNav-v0 is 'holonomic'"):
        load_config(config)


# code


def finish(jobs, log, *_):
    """Write the rows of jobs in place of the workers."""
    for job in jobs:
        signed = {"config_hash": job.config_hash, "map_hash": None}
        measured = {"success": False, "failure": "timeout", "path_length": 0.0}
        log.append(job.episode.identity(job.scene_hash) | signed | measured)


def test_rows_of_other_code_are_not_continued(known, config, tmp_path, monkeypatch):
    program = tmp_path / "own_program.py"
    source = textwrap.dedent(inspect.getsource(Halting)).replace("Halting", "Own").replace("halting", "own")
    program.write_text(f"import numpy as np\nfrom vssm_gym.agents.base import Decision\n\n{source}")
    config.write_text(config.read_text().replace("halting", "own"))
    monkeypatch.syspath_prepend(tmp_path)
    own = importlib.import_module("own_program")
    known(own.Own)
    monkeypatch.setattr(runner, "_run", finish)
    out = str(tmp_path / "out")  # a text as well as a path
    log = run_sweep(load_config(str(config)), out)
    before = log.read_bytes()
    assert len(read_rows(log)) == 4
    run_sweep(load_config(config), out, resume=True)
    with pytest.raises(InputError, match=r"--resume continues it, resume=True in a program; or choose another folder"):
        run_sweep(load_config(config), out)
    program.write_text(program.read_text().replace('None, "stop"', 'None, "arrived"'))
    known(importlib.reload(own).Own)
    with pytest.raises(InputError, match=r"sweep\.json: agent_code: expected .*own.*another sweep"):
        run_sweep(load_config(config), out, resume=True)
    assert log.read_bytes() == before
    other = run_sweep(load_config(config), tmp_path / "other")
    assert read_rows(other)[0]["config_hash"] != read_rows(log)[0]["config_hash"]  # so that no merge joins them


def test_a_hash_of_code_covers_what_is_beside_it(tmp_path, monkeypatch):
    (tmp_path / "own_class.py").write_text("import own_help\n\nclass Own: ...\n")
    (tmp_path / "own_help.py").write_text("STEP = 1\n")
    (tmp_path / "own_parts").mkdir()
    (tmp_path / "own_parts" / "__init__.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    kind = importlib.import_module("own_class").Own
    found = [code_hash(kind)]
    assert code_hash(kind) == found[0]
    for name in ("own_help.py", "own_class.py", "own_parts/__init__.py"):
        (tmp_path / name).write_text((tmp_path / name).read_text() + "MORE = 2\n")
        found.append(code_hash(kind))
    assert len(set(found)) == 4


def test_a_hash_of_an_installed_class_covers_its_distribution(tmp_path, monkeypatch):
    (tmp_path / "own_installed.py").write_text("class Own: ...\n")
    info = tmp_path / "own_installed-1.0.dist-info"
    info.mkdir()
    (info / "top_level.txt").write_text("own_installed\n")
    monkeypatch.syspath_prepend(tmp_path)
    kind, found = importlib.import_module("own_installed").Own, []
    for version, digest in (("1.0", "aa"), ("1.1", "aa"), ("1.1", "bb")):
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: own-installed\nVersion: {version}\n")
        (info / "RECORD").write_text(f"own_installed.py,sha256={digest},10\n")
        found.append(code_hash(kind))
        (tmp_path / "unrelated.py").write_text(version)
        assert code_hash(kind) == found[-1]
    assert len(set(found)) == 3


def test_a_sweep_of_built_in_agents_states_no_code(known):
    known(Halting)
    assert own_agents(["random", "astar+theta_star", "halting"]) == {"halting": Halting}
    assert code_hashes({"halting": type("Typed", (), {"__module__": "builtins"})}) == {}  # nothing to read


# programs that workers import


def test_a_program_without_a_file_is_refused(known, monkeypatch):
    known(Halting)
    stdin, prompt = types.ModuleType("__main__"), types.ModuleType("__main__")
    stdin.__file__ = "<stdin>"
    monkeypatch.setitem(sys.modules, "__main__", stdin)
    with pytest.raises(InputError, match=r"program: expected a program in a file, .*found <stdin>"):
        check_importable({})
    monkeypatch.setitem(sys.modules, "__main__", prompt)
    check_importable({"halting": Halting})  # a notebook that imports its agent from a file
    shown = type("Shown", (Halting,), {"__module__": "__main__"})
    with pytest.raises(InputError, match=r"agent shown: class: .*notebook.*write it into a \.py file"):
        check_importable({"shown": shown})


def test_a_class_inside_a_function_is_refused():
    class Inner(Halting):
        """Hidden from workers."""

    with pytest.raises(InputError, match="a class at the top level of a file"):
        check_importable({"inner": Inner})


PROGRAM = """
import sys
import numpy as np
import vssm_gym as vg

@vg.register_agent
class Halting:
    name, robot, task, needs_pose, needs_map = "halting", "holonomic", "pointgoal", False, False

    def reset(self, context, observation, seed):
        pass

    def act(self, observation):
        raise ArithmeticError("no answer")

if __name__ == "__main__" or sys.argv[2] == "unguarded":
    vg.run_sweep(vg.load_config(sys.argv[1]), sys.argv[2])
"""


@pytest.mark.slow
@pytest.mark.parametrize("out", ["guarded", "unguarded"])
def test_a_program_whose_agent_fails_or_that_lacks_the_guard(config, tmp_path, out):
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    command = [sys.executable, str(program), str(config), out]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert not (tmp_path / out / FILE).exists() or not read_rows(tmp_path / out / FILE)
    if out == "unguarded":
        assert 'start the sweep below if __name__ == "__main__":' in done.stderr
        assert done.stderr.count("Traceback") == 1  # no worker prints one
    else:
        assert done.stderr.count("in act\n") == 1
        line = "RuntimeError: agent halting, scene rooms, task 0, noise low, seed 0: ArithmeticError: no answer"
        assert done.stderr.splitlines().count(line) == 2  # the worker's traceback, and the program's


# decisions


def test_what_is_no_decision_is_refused():
    agent = Halting()
    assert decide(agent, {}).status == "stop"
    agent.act = lambda observation: np.zeros(4)
    with pytest.raises(InputError, match="agent halting: act: expected a Decision as its result; found ndarray"):
        decide(agent, {})


def test_a_worker_knows_the_agents_of_its_program(known, monkeypatch):
    monkeypatch.setattr(worker.signal, "signal", lambda *_: None)
    started = types.SimpleNamespace(set=lambda: heard.append(True))
    heard = []
    worker.initialise(started, (Halting,))
    assert heard and registry.AGENTS["halting"] is Halting
