"""Test the SLAM track on a short walk: the true poses have no error, and faults are worth standing still."""

import os
import sys
import time
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool

import numpy as np
import pytest

from tests.helpers.box_rooms import furniture, two_rooms
from vssm_gym.data.sequences import load_sequence
from vssm_gym.envs.scenes.scene import save_scene
from vssm_gym.errors import InputError
from vssm_gym.eval.benchmark import units
from vssm_gym.eval.benchmark.slam import run as slam_run
from vssm_gym.eval.benchmark.slam.contract import SlamMethod
from vssm_gym.eval.benchmark.slam.methods import SLAM_METHODS, StandingStill
from vssm_gym.eval.benchmark.slam.run import SlamUnit, ensure_recording, run_recording, standing_still
from vssm_gym.eval.benchmark.suite import Recording, given_seed
from vssm_gym.eval.sweep.rounds import SIGNAL_SECONDS
from vssm_gym.eval.sweep.supervision import DEAD, processor_seconds

METHODS = """
import os
import numpy as np
from vssm_gym.eval.benchmark.slam.methods import StandingStill

class Dying(StandingStill):
    name = "strangers_dying"
    def track(self, time, rgb, depth):
        os._exit(3)
"""


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """Return the definition of a short walk and its folder."""
    folder = tmp_path_factory.mktemp("walk")
    box = furniture("box", (1.0, 1.0, 0.5), (0.4, 0.4, 1.0))
    save_scene(two_rooms(pieces=(box,)), folder / "rooms.json")
    walk = Recording(scene=str(folder / "rooms.json"), motion="handheld", length=1.0)
    return walk, ensure_recording(walk, folder / "recordings")


def scored(monkeypatch, walk, method):
    """Run a method on the walk."""
    entry = type("Found", (), {"make": lambda self: method})()
    monkeypatch.setattr(slam_run, "find_entry", lambda reference: entry)
    return run_recording(SlamUnit("mine", "mine", *walk, seconds=5.0))


class Knowing(StandingStill):
    """State the true poses in the frame of the first camera, some of them only in the end."""

    def __init__(self, folder, late=False, change=None):
        truth = load_sequence(folder).true_poses()
        self.poses, self.late = np.linalg.inv(truth[0]) @ truth, late
        self.change = change or (lambda pose: pose)

    def begin(self, camera, seed):
        assert (camera.width, camera.height) == (160, 120)
        self.seen = 0

    def track(self, time, rgb, depth):
        assert time == pytest.approx(0.1 * self.seen)
        assert (rgb.dtype, rgb.shape[:2]) == (np.uint8, depth.shape)
        assert 0.0 < np.median(depth) < 8.0
        self.seen += 1
        return np.eye(4) if self.late else self.change(self.poses[self.seen - 1])

    def finish(self):
        return self.poses if self.late else None


def moved(pose, metres):
    """Return a pose far along x."""
    found = np.array(pose)
    found[0, 3] = metres
    return found


class Odd:
    """Raise where it is read."""

    def __array__(self, *_, **__):
        raise RuntimeError("no array")


def test_true_poses_have_no_error_whenever_they_are_stated(monkeypatch, walk):
    for late in (False, True):
        row = scored(monkeypatch, walk, Knowing(walk[1], late))
        assert row["score"] < 1e-6
        assert row["success"]
        assert row["fault"] is None
        assert (row["measured"]["ate_online"] > 0.05) == late
        assert row["measured"]["images"] > 10
    units.UnitRow(entry="mine", unit="walk", version="1", **row)


def test_standing_still_is_the_worst(monkeypatch, walk):
    row = scored(monkeypatch, walk, SLAM_METHODS["standing_still"]())
    assert row["score"] == pytest.approx(standing_still(SlamUnit("mine", "mine", *walk, seconds=5.0)))
    truth = load_sequence(walk[1]).true_poses()[:, :3, 3]
    assert row["score"] == pytest.approx(np.sqrt(np.mean(np.sum((truth - truth.mean(0)) ** 2, -1))), rel=0.1)
    wild = np.random.default_rng(0)
    far = lambda pose: np.block([[np.eye(3), 50.0 * wild.normal(size=(3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])
    assert scored(monkeypatch, walk, Knowing(walk[1], change=far))["score"] == pytest.approx(row["score"])


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        (lambda pose: pose[:3], "track was expected to return a rigid pose (4, 4)"),
        (lambda pose: pose * np.nan, "track was expected to return a rigid pose (4, 4)"),
        (lambda pose: np.diag([2.0, 2.0, 2.0, 1.0]), "track was expected to return a rigid pose (4, 4)"),
        (lambda pose: [[1.0], [1.0, 2.0]], "track was expected to return a rigid pose (4, 4)"),
        (lambda pose: np.full((4, 4), "x"), "track was expected to return a rigid pose (4, 4)"),
        (lambda pose: moved(pose, 1e307), "track was expected to return a rigid pose (4, 4)"),
        (lambda pose: Odd(), "RuntimeError: no array"),
        (lambda pose: 1 / 0, "ZeroDivisionError: division by zero"),
    ],
)
def test_what_is_no_pose_is_a_fault(monkeypatch, walk, wrong, reason):
    row = scored(monkeypatch, walk, Knowing(walk[1], change=wrong))
    assert row["fault"].startswith(reason)
    assert not row["success"]
    assert row["score"] == pytest.approx(standing_still(SlamUnit("mine", "mine", *walk, seconds=5.0)))


def test_a_finish_with_too_few_poses_is_a_fault(monkeypatch, walk):
    method = Knowing(walk[1], late=True)
    method.poses = method.poses[:-1]
    assert "finish was expected to return None or rigid poses" in scored(monkeypatch, walk, method)["fault"]


def test_a_method_gets_another_seed_than_the_truth(monkeypatch, walk):
    method, seeds = Knowing(walk[1]), []
    begin = method.begin
    method.begin = lambda camera, seed: seeds.append(seed) or begin(camera, seed)
    scored(monkeypatch, walk, method)
    assert seeds == [given_seed(walk[0].seed)]
    assert given_seed(0) != given_seed(1)
    assert {given_seed(seed) for seed in range(10)}.isdisjoint(range(10))


def test_what_cannot_be_made_in_the_worker_is_a_fault(monkeypatch, walk):
    entry = type("Found", (), {"make": lambda self: 1 / 0})()
    monkeypatch.setattr(slam_run, "find_entry", lambda reference: entry)
    row = run_recording(SlamUnit("mine", "mine", *walk, seconds=5.0))
    assert row["fault"].startswith("ZeroDivisionError: division by zero (test_slam_run.py, line ")


def broken(unit):
    """Raise, as code does that an entry has patched."""
    raise LookupError("patched")


class Broken:
    """Be a pool whose process has died."""

    _processes = None

    def submit(self, run, unit):
        future = Future()
        future.set_exception(BrokenProcessPool())
        return future

    def shutdown(self, **_):
        """End."""


def test_a_signal_that_ends_the_process_first_is_no_fault(tmp_path, monkeypatch):
    def interrupted(seconds):
        assert seconds == SIGNAL_SECONDS
        raise KeyboardInterrupt

    unit = SlamUnit("mine", "mine", Recording(scene="oak", motion="handheld", length=1.0), tmp_path, seconds=5.0)
    run = lambda: units.run_units([unit], broken, lambda _: 1.0, tmp_path / "slam")
    monkeypatch.setattr(units, "_pool", Broken)
    monkeypatch.setattr(time, "sleep", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run()
    assert (tmp_path / "slam" / units.ROWS).read_bytes() == b""
    monkeypatch.setattr(time, "sleep", lambda seconds: None)
    [row] = units.read_rows(run(), units.UnitRow)
    assert row["fault"] == DEAD


def score(unit):
    """Score a unit by its number, and say which process did."""
    measured = {"process": float(os.getpid())}
    return {
        "score": float(unit.entry),
        "success": True,
        "fault": None,
        "p95": None,
        "measured": measured,
        "content": None,
    }


@pytest.mark.slow
def test_processes_share_the_units(tmp_path):
    recording = Recording(scene="oak", motion="handheld", length=1.0)
    runs = [SlamUnit(str(k), "mine", recording, tmp_path, seconds=5.0) for k in range(6)]
    rows = units.read_rows(units.run_units(runs, score, lambda _: 9.0, tmp_path / "slam", 2), units.UnitRow)
    assert sorted((row["entry"], row["score"]) for row in rows) == [(str(k), float(k)) for k in range(6)]
    assert len({row["measured"]["process"] for row in rows}) == 2


class Mortal:
    """Be a pool whose process dies after its first unit."""

    _processes = None

    def __init__(self):
        self.used = False

    def submit(self, run, unit):
        if self.used:
            raise BrokenProcessPool
        self.used, future = True, Future()
        future.set_result(run(unit))
        return future

    def shutdown(self, **_):
        """End."""


def test_a_process_that_dies_between_two_units_costs_neither(tmp_path, monkeypatch):
    monkeypatch.setattr(units, "_pool", Mortal)
    recording = Recording(scene="oak", motion="handheld", length=1.0)
    runs = [SlamUnit(str(k), "mine", recording, tmp_path, seconds=5.0) for k in (1, 2)]
    rows = units.read_rows(units.run_units(runs, score, lambda _: 9.0, tmp_path / "slam"), units.UnitRow)
    assert [(row["entry"], row["fault"]) for row in rows] == [("1", None), ("2", None)]


def test_what_has_ended_is_kept_where_another_unit_ends_the_run(tmp_path, monkeypatch):
    class Refusing(Mortal):
        """Be a pool whose first unit is refused."""

        def submit(self, run, unit):
            future = Future()
            future.set_exception(InputError("walk", "images", "a recording")) if unit.entry == "1" else None
            return future if future.done() else super().submit(run, unit)

    monkeypatch.setattr(units, "_pool", Refusing)
    recording = Recording(scene="oak", motion="handheld", length=1.0)
    runs = [SlamUnit(str(k), "mine", recording, tmp_path, seconds=5.0) for k in range(1, 9)]
    with pytest.raises(InputError, match="walk: images"):
        units.run_units(runs, score, lambda _: 9.0, tmp_path / "slam", workers=len(runs))
    rows = units.read_rows(tmp_path / "slam" / units.ROWS, units.UnitRow)
    assert {row["entry"] for row in rows} == set("2345678")


def leave(*_):
    """End the process, as one does that cannot import its program."""
    os._exit(1)


def test_a_process_that_cannot_start_is_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr(units.worker, "initialise", leave)
    unit = SlamUnit("mine", "mine", Recording(scene="oak", motion="handheld", length=1.0), tmp_path, seconds=5.0)
    with pytest.raises(InputError, match="benchmark: workers: expected processes that can start"):
        units.run_units([unit], score, lambda _: 9.0, tmp_path / "slam")


@pytest.mark.slow
def test_any_other_error_of_a_run_is_a_row(walk, tmp_path):
    unit, before = SlamUnit("mine", "mine", *walk, seconds=5.0), processor_seconds()
    own = time.process_time()
    [row] = units.read_rows(units.run_units([unit], broken, standing_still, tmp_path / "slam"), units.UnitRow)
    assert processor_seconds() - before - (time.process_time() - own) > 0.1  # its process has been counted
    assert row["fault"].startswith("LookupError: patched")
    assert row["score"] == pytest.approx(standing_still(unit))


def test_the_methods_of_the_package_fit_the_contract():
    assert all(isinstance(make(), SlamMethod) for make in SLAM_METHODS.values())


@pytest.mark.slow
def test_prism_follows_the_walk_and_a_process_that_dies_costs_its_run(walk, tmp_path, monkeypatch):
    (tmp_path / "strangers_dying.py").write_text(METHODS)
    monkeypatch.setattr(sys, "path", list(sys.path))
    names = ("prism", f"{tmp_path / 'strangers_dying.py'}:Dying", "standing_still")
    runs = [SlamUnit(name.rpartition(":")[2], name, *walk, seconds=100.0) for name in names]
    path = units.run_units(runs, run_recording, standing_still, tmp_path / "slam")
    rows = {row["entry"]: row for row in units.read_rows(path, units.UnitRow)}
    assert rows["prism"]["score"] < 0.03
    assert rows["Dying"]["fault"] == "its process has died, or did not return"
    assert rows["Dying"]["score"] == pytest.approx(rows["standing_still"]["score"])
    assert rows["standing_still"]["fault"] is None  # in a new process
    assert units.run_units(runs, run_recording, standing_still, tmp_path / "slam").read_bytes() == path.read_bytes()
