"""Test entries: every form of a reference, which tracks it enters, and one error for each that is wrong."""

import re
import sys

import pytest

from tests.helpers.sweeps.benchmark_suites import write_agents, write_suite
from vssm_gym.agents import registry
from vssm_gym.errors import InputError
from vssm_gym.eval.benchmark.entries import find_entries, find_entry
from vssm_gym.eval.benchmark.suite import read_suite, suite_file

SLAM = """
class Still:
    name = "strangers_still"

    def begin(self, camera, seed): ...
    def track(self, time, rgb, depth): ...
    def finish(self): ...
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return a folder of a stranger; what is registered and imported from it is forgotten afterwards."""
    monkeypatch.setattr(registry, "AGENTS", dict(registry.AGENTS))
    monkeypatch.setattr(sys, "path", list(sys.path))
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if name.startswith("strangers_"):
            del sys.modules[name]


def test_a_class_in_a_file_outside_the_package(folder):
    entry = find_entry(f"{write_agents(folder)}:Straight")
    assert (entry.kind, entry.label) == ("agent", "strangers_straight")
    assert entry.make().name == "strangers_straight"
    assert len(entry.code) == 16
    assert sys.path[-1] == str(folder)  # so that workers, which are told the path, find it after all others


def test_a_class_of_a_module_and_of_a_package_beside_the_working_folder(folder, monkeypatch):
    (folder / "strangers_package").mkdir()
    (folder / "strangers_package" / "__init__.py").write_text("")
    (folder / "strangers_package" / "still.py").write_text(SLAM)
    monkeypatch.chdir(folder)
    entry = find_entry("strangers_package.still:Still")
    assert (entry.kind, entry.label) == ("slam", "strangers_still")
    assert entry.tracks(read_suite(suite_file("small"))) == ("slam",)


@pytest.mark.parametrize(("group", "kind"), [("vssm_gym.agents", "agent"), ("vssm_gym.slam", "slam")])
def test_an_entry_point_of_an_installed_distribution(folder, monkeypatch, group, kind):
    write_agents(folder)
    (folder / "strangers_slam.py").write_text(SLAM)
    info = folder / "strangers-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: strangers\nVersion: 1.0\n")
    target = {"agent": "strangers_agents:Straight", "slam": "strangers_slam:Still"}[kind]
    (info / "entry_points.txt").write_text(f"[{group}]\nbrave = {target}\n[vssm_gym.predictors]\nwrong = {target}\n")
    monkeypatch.syspath_prepend(folder)
    assert find_entry("brave").kind == kind
    with pytest.raises(
        InputError, match=r"entry: wrong: expected a class with the methods .*predictor: begin, observe"
    ):
        find_entry("wrong")
    with pytest.raises(InputError, match=r"found 'brav' \(did you mean 'brave'\?\)"):
        find_entry("brav")


@pytest.mark.parametrize(
    ("reference", "label", "tracks"),
    [
        ("astar", "astar", ("navigation",)),
        ("astar+theta_star", "astar+theta_star", ("navigation",)),
        ("slam_nav", "slam_nav", ("navigation", "mapping")),
        ("random", "random", ("navigation", "mapping", "exploration")),
        ("vi_mpc", "vi_mpc", ("car",)),
        ("frontier_gain", "frontier_gain", ("exploration",)),
        ("prism", "prism", ("slam",)),
        ("vssm_lm", "vssm_lm", ("prediction",)),
    ],
)
def test_what_comes_with_the_package_enters_what_it_is_for(reference, label, tracks):
    entry = find_entry(reference)
    assert (entry.label, entry.code) == (label, None)
    assert entry.tracks(read_suite(suite_file("small"))) == tracks


def test_a_policy_is_an_agent_that_needs_a_map():
    entry = find_entry("policy:oak")
    assert re.fullmatch(r"imagined@[0-9a-f]{8}", entry.label)
    assert find_entry(entry.reference.removeprefix("policy:")).label == entry.label  # by its file
    assert entry.tracks(read_suite(suite_file("small"))) == ("navigation",)


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        ("astr", r"found 'astr' \(did you mean 'astar'\?\)"),
        ("nowhere.py:Agent", r"entry: nowhere\.py:Agent: expected a Python file; there is none at"),
        ("strangers_agents.py:Strait", r"a class of .*\(did you mean 'Straight'\?\); it has Straight, Crashing"),
        ("strangers_agents.py:np", "expected a class; found module"),
        ("strangers_nothing:Agent", "ModuleNotFoundError: No module named 'strangers_nothing'"),
        ("strangers_broken.py:Agent", "ValueError: broken at import"),
        ("strangers_wrong.py:Leaving", "SystemExit: 3"),
        (
            "strangers_wrong.py:Plain",
            r"the methods of what it enters as \(agent: reset, act; slam: begin, track, finish;",
        ),
        ("strangers_wrong.py:Nameless", "the class attribute name, a printable text; found None"),
        ("strangers_wrong.py:Unmade", "RuntimeError: no weights"),
        (
            "strangers_wrong.py:Peeking",
            r"agent Peeking: needs_pose: expected False, as its class has it, .*; found True",
        ),
        ("strangers_wrong.py:Taken", r"register_agent: name: expected one that no other agent has; found 'astar'"),
        ("random.py:Agent", "expected a file whose name no other module has; 'random' is another's"),
        ("two words.py:Agent", "a file whose name is a word of Python"),
        ("missing.npz", "missing.npz"),
    ],
)
def test_a_wrong_reference_is_one_clear_error(folder, monkeypatch, reference, message):
    write_agents(folder)
    (folder / "strangers_broken.py").write_text("raise ValueError('broken at import')\n")
    (folder / "strangers_wrong.py").write_text(
        "import sys\nfrom strangers_agents import Straight\n"
        "class Plain: name = 'plain'\n"
        "class Leaving(Straight):\n    def __init__(self): sys.exit(3)\n"
        "class Nameless:\n    def begin(self): ...\n    def observe(self): ...\n    def predict(self): ...\n"
        "class Unmade(Straight):\n    name = 'unmade'\n    def __init__(self): raise RuntimeError('no weights')\n"
        "class Peeking(Straight):\n    name = 'peeking'\n    def __init__(self): self.needs_pose = True\n"
        "class Taken(Straight): name = 'astar'\n"
    )
    for name in ("random.py", "two words.py"):
        (folder / name).write_text("class Agent: ...\n")
    monkeypatch.chdir(folder)
    with pytest.raises(InputError, match=message) as raised:
        find_entry(reference)
    assert "\n" not in str(raised.value)


def test_entries_that_no_track_is_for_and_twins(folder):
    suite = read_suite(write_suite(folder))
    reference = f"{write_agents(folder)}:Straight"
    assert find_entries((reference,), suite)[0].tracks(suite) == ("mapping",)
    with pytest.raises(InputError, match="entries with names that differ; two are called 'strangers_straight'"):
        find_entries((reference, reference), suite)
    with pytest.raises(InputError, match=r"found 'astar', an agent with robot 'holonomic' .*, which needs a map"):
        find_entries(("astar",), suite)
    with pytest.raises(InputError, match="found 'prism', a SLAM method"):
        find_entries(("prism",), suite)
    with pytest.raises(InputError, match="entry: expected at least one"):
        find_entries((), suite)
