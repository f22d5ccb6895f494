"""Test videos of a policy's simulated and imagined runs: recording, drawing, and the command's option."""

import importlib
import json
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pytest

from tests.helpers.box_rooms import furniture, two_rooms
from tests.helpers.imagined_room import room, task
from tests.helpers.straight_policy import straight
from vssm_gym.agents.policy import policy_file
from vssm_gym.envs.scenes.scene import save_scene
from vssm_gym.eval.video.plans import CroppedPlan
from vssm_gym.eval.video.writer import HOLD, VIDEO_RATE
from vssm_gym.geometry.scan import BEAMS
from vssm_gym.planning.occupancy_grid import FREE, OCCUPIED, UNKNOWN
from vssm_gym.training.imagined_episodes import ImaginedStep, imagine
from vssm_gym.training.recording import PolicyMoment, PolicyRun, PolicyRuns, ray_ends, true_plan
from vssm_gym.training.video import Sheet, write_video

TABLE = furniture("table", (1.0, 3.0, 0.3), (0.6, 0.5, 0.6))


def run(n: int, success: bool, plan: CroppedPlan) -> PolicyRun:
    """Return a run along x for n moments, from (1, 1)."""
    moments = tuple(
        PolicyMoment(
            0.2 * i,
            np.array([1.0 + 0.1 * i, 1.0, 0.0]),
            np.array([1.0 + 0.1 * i, 1.05, 0.0]),
            np.array([[4.0, 1.0], [4.0, 2.0]]),
            np.full((120, 160, 3), 10 * i, np.uint8),
            1,
            "driving",
        )
        for i in range(n)
    )
    return PolicyRun(moments, plan, success, "arrived" if success else "time out: 3.00 m from the goal")


@pytest.fixture(scope="module")
def rooms(tmp_path_factory) -> Path:
    """Write a scene whose first task, drawn by the scene's name, leads straight ahead."""
    path = tmp_path_factory.mktemp("scene") / "rooms.json"
    save_scene(two_rooms(pieces=(TABLE,)).model_copy(update={"name": "flat"}), path)
    return path


@pytest.fixture(scope="module")
def both(rooms) -> PolicyRuns:
    plan = true_plan(str(rooms))
    real, imagined = run(4, True, plan), run(7, False, plan)
    return PolicyRuns("straight@0", "rooms", task((1.0, 1.0, 0.0), (2.0, 1.0)), 0.4, real, imagined)


# what is recorded


def test_rays_end_at_the_scans_readings():
    """At (1, 2) facing north, the first ray is 63/64 m to the left for each metre ahead, the last one to the right."""
    scan = np.zeros(BEAMS, np.float32)
    scan[[0, 63]] = 2.0, 1.0
    ends = ray_ends(np.array([1.0, 2.0, np.pi / 2.0]), scan, np.pi / 2.0)
    np.testing.assert_allclose(ends, [[1.0 - 2.0 * 63.0 / 64.0, 4.0], [1.0 + 63.0 / 64.0, 3.0]], atol=1e-6)
    assert ray_ends(np.zeros(3), np.zeros(BEAMS, np.float32), 1.5).shape == (0, 2)


@pytest.mark.parametrize(
    ("xy", "kind"),
    [
        ((1.5, 1.5), FREE),
        ((3.0, 1.95), FREE),  # the door
        ((3.0, 0.5), OCCUPIED),  # the wall between the rooms
        ((1.0, 3.0), OCCUPIED),  # the table
        ((-0.09, 2.0), UNKNOWN),  # behind the outer wall
    ],
)
def test_the_true_plan_is_the_scene(rooms, xy, kind):
    plan = true_plan(str(rooms))
    i, j = np.rint((np.array(xy) - plan.origin) / plan.resolution).astype(int)
    assert plan.cells[i, j] == kind
    low, high = plan.bounds
    assert (low < 0.0).all() and high[0] > 6.0 and high[1] > 4.0


@pytest.mark.slow
def test_a_task_alone_is_imagined_as_among_all(tmp_path):
    """Number 1 of three with seed 7 equals the only one with seed 8; the callback gets its every step."""
    room().save(tmp_path / "room.npz")
    tasks = [task((0.5, 0.5, 0.0), (1.5, 2.5)), task((1.0, 1.2, 0.0), (3.0, 1.2)), task((4.5, 2.5, 3.0), (3.2, 1.0))]
    for one in tasks:
        object.__setattr__(one, "geodesic", 1.6)
    rows = imagine(straight(), tmp_path / "room.npz", tasks, "low", 7)
    steps: list[ImaginedStep] = []
    (row,) = imagine(straight(), tmp_path / "room.npz", [tasks[1]], "low", 8, steps.append)
    assert row == pytest.approx(rows[1], rel=1e-5)
    assert row["success"]
    assert [step.number for step in steps] == list(range(row["steps"]))
    np.testing.assert_allclose(steps[0].planar[0], tasks[1].start, atol=1e-6)
    np.testing.assert_allclose(steps[0].observation["pose"][0], tasks[1].start, atol=1e-6)
    assert [bool(step.stop[0]) for step in steps] == [False] * (len(steps) - 1) + [True]
    assert np.hypot(*(steps[-1].planar[0, :2] - tasks[1].goal)) < 0.4
    assert steps[0].observation["scan"].shape == (1, BEAMS)


# how it is drawn


def test_the_run_that_ends_first_is_held(both):
    sheet = Sheet(both)
    assert len(both) == 7
    frames = [sheet.draw(i).astype(int) for i in range(len(both))]
    assert frames[0].shape == (720, 1280, 3)
    left, right = ([frame[:, half] for frame in frames] for half in (slice(0, 640), slice(640, None)))
    assert all((left[i] != left[i + 1]).any() for i in range(3))
    assert all((left[3] == later).all() for later in left[4:])
    assert all((right[i] != right[i + 1]).any() for i in range(6))
    np.testing.assert_array_equal(sheet.draw(0), frames[0])  # nothing is left of later frames


def test_a_video_has_a_frame_a_step_and_holds_the_last(both, tmp_path):
    pytest.importorskip("imageio_ffmpeg", reason="videos need the extra vssm-gym[viz]")
    reported: list[tuple[str, int, int]] = []
    write_video(tmp_path / "task.mp4", both, lambda *how: reported.append(how))
    assert reported[-1] == ("video", 7, 7)
    assert [path.name for path in tmp_path.iterdir()] == ["task.mp4"]
    with imageio.get_reader(tmp_path / "task.mp4") as video:
        frames = [np.asarray(frame) for frame in video]
    assert len(frames) == 7 + round(HOLD * VIDEO_RATE)
    assert frames[0].shape == (720, 1280, 3)


def test_a_video_that_fails_leaves_nothing(both, tmp_path, monkeypatch):
    pytest.importorskip("imageio_ffmpeg", reason="videos need the extra vssm-gym[viz]")

    def fail(*how: Any) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "task.mp4", both, fail)
    assert not list(tmp_path.iterdir())


# the option


@pytest.mark.parametrize("number", [-1, 3])
def test_a_task_that_is_not_evaluated_has_no_video(vssm, tmp_path, number):
    policy_file.save(tmp_path / "policy.npz", straight())
    asked = ("evaluate", tmp_path / "policy.npz", "--out", tmp_path / "out", "--tasks", 3, "--video", number)
    code, out, err = vssm(*asked)
    assert (code, out, err) == (2, "", f"error: evaluate: video: expected a task from 0 to 2; found {number}\n")
    assert not (tmp_path / "out").exists()


def test_without_a_writer_of_videos_nothing_runs(vssm, tmp_path, monkeypatch):
    known = importlib.import_module

    def missing(name, *more):
        if name == "imageio_ffmpeg":
            raise ImportError("No module named 'imageio_ffmpeg'")
        return known(name, *more)

    policy_file.save(tmp_path / "policy.npz", straight())
    monkeypatch.setattr("vssm_gym.eval.video.writer.importlib.import_module", missing)
    code, _, err = vssm("evaluate", tmp_path / "policy.npz", "--out", tmp_path / "out", "--video", 0)
    assert (code, err.count("\n")) == (2, 1)
    assert "pip install -c constraints.txt '.[viz]'" in err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_an_evaluation_with_a_video(vssm, rooms, tmp_path):
    """A recording, its map, an evaluation and its video are made by the commands."""
    pytest.importorskip("imageio_ffmpeg", reason="videos need the extra vssm-gym[viz]")
    policy_file.save(tmp_path / "policy.npz", straight())
    out = tmp_path / "out"
    asked = ("evaluate", tmp_path / "policy.npz", "--out", out, "--scene", rooms, "--tasks", 1, "--workers", 1)
    code, printed, _ = vssm(*asked, "--video", 0)
    assert code == 0
    assert printed.splitlines()[-1] == f"next: vssm-gym report {out}"
    assert f"video: {out / 'task-0.mp4'}" in printed
    (real,) = [json.loads(line) for line in (out / "episodes.jsonl").read_text().splitlines()]
    assert real["success"]
    with imageio.get_reader(out / "task-0.mp4") as video:
        frames = video.count_frames() - round(HOLD * VIDEO_RATE)
    assert real["steps"] <= frames < real["steps"] + 10  # the same episode over again, and what was imagined
