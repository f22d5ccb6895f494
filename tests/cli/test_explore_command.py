"""Test ``vssm-gym explore``: a run with its video, pictures and map, and what is refused before anything runs."""

import importlib
import json

import imageio.v2 as imageio
import numpy as np
import pytest
from PIL import Image

from vssm_gym.agents.base import Decision
from vssm_gym.agents.exploration.mi_explorer import Tour
from vssm_gym.eval.protocols.episode import StepRecord
from vssm_gym.eval.video.explorer_recording import EVERY, Recording
from vssm_gym.eval.video.pictures import plan_image
from vssm_gym.eval.video.plans import CroppedPlan
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.occupancy_grid import FREE, OCCUPIED, UNKNOWN

STEPS = 41


@pytest.mark.slow
def test_a_run_writes_its_video_pictures_and_map(vssm, tmp_path):
    pytest.importorskip("imageio_ffmpeg", reason="videos need the extra vssm-gym[viz]")
    out = tmp_path / "seen"
    asked = ("explore", "--scene", "procedural:10000:small", "--out", out, "--start", 3, "--steps", STEPS)
    code, printed, _ = vssm(*asked)
    assert code == 0
    assert {path.name for path in out.iterdir()} == {
        "explore.json", "run.mp4", "candidates.png", "run.png", "mesh.png", "map.npz", "run.json",
    }  # fmt: skip
    for name in ("candidates.png", "run.png", "mesh.png"):
        assert str(out / name) in printed
        assert np.asarray(Image.open(out / name).convert("RGB")).std() > 5.0, name
    with imageio.get_reader(out / "run.mp4") as video:
        frames = [np.asarray(frame) for frame in video]
    assert frames[0].shape == (720, 1280, 3)
    assert len(frames) >= STEPS // EVERY
    assert np.abs(frames[0].astype(int) - frames[-1]).mean() > 1.0  # it moves
    row = json.loads((out / "run.json").read_text())
    assert (row["agent"], row["task"], row["steps"], row["scene"]) == (
        "mi_explorer", 3, STEPS, "procedural-10000-small",
    )  # fmt: skip
    assert 0.0 < row["coverage"] <= 1.0
    assert row["curve"]["entropy"][-1] < 0.0
    assert not list(tmp_path.glob(".*"))
    code, _, err = vssm(*asked)
    assert (code, err.count("\n")) == (2, 1)
    assert "never overwritten" in err
    assert vssm("map", "export", out / "map.npz", "--out", tmp_path / "exported")[0] == 0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--agent", "astar"), "explore: agent: expected one of frontier_gain, "),
        (("--agent", "frontier_looking"), "expected 'frontier_gain_scan', the present name of that agent; found "),
        (("--agent", "nobody"), "mi_explorer"),
        (("--scene", "nowhere"), "explore: scene: expected a built-in scene"),
        (("--noise", "loud"), "explore: noise: expected one of none, low, "),
        (("--start", "100"), "explore: start: expected at most 99, found 100"),
        (("--start", "-1"), "explore: start: "),
        (("--steps", "0"), "explore: steps: expected at least 1, found 0"),
        (("--seed", "-1"), "explore: seed: "),
    ],
)
def test_bad_arguments_are_refused_in_one_line(vssm, tmp_path, options, said):
    code, out, err = vssm("explore", "--scene", "fern", "--out", tmp_path / "new", *options)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert said in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_without_a_writer_of_videos_the_run_has_all_but_its_video(vssm, tmp_path, monkeypatch):
    known, out = importlib.import_module, tmp_path / "new"

    def missing(name, *more):
        if name == "imageio_ffmpeg":
            raise ImportError("No module named 'imageio_ffmpeg'")
        return known(name, *more)

    monkeypatch.setattr("vssm_gym.eval.video.writer.importlib.import_module", missing)
    asked = ("explore", "--scene", "procedural:10000:small", "--agent", "random_walk", "--out", out, "--steps", 2)
    code, printed, err = vssm(*asked)
    assert code == 0 and str(out / "mesh.png") in printed and "run.mp4" not in printed
    assert "no video of the run: explore: video: expected imageio-ffmpeg" in err
    assert "pip install -c constraints.txt '.[viz]'" in err
    assert {path.name for path in out.iterdir()} == {"explore.json", "run.png", "mesh.png", "map.npz", "run.json"}
    code, _, err = vssm(*asked)
    assert code == 2 and "never overwritten" in err


def test_a_plan_keeps_its_place_in_a_larger_picture():
    cells = np.array([[FREE, OCCUPIED, UNKNOWN], [FREE, FREE, OCCUPIED]], np.int8)
    plan = CroppedPlan(cells, np.array([1.05, 2.05]), 0.1)
    np.testing.assert_allclose(plan.bounds, [[1.0, 2.0], [1.2, 2.3]])
    image = plan_image(plan, np.array([[0.8, 1.9], [1.3, 2.4]]))
    assert image.shape == (5, 5, 3)  # rows are y, upwards
    free, occupied = (image == 255).all(axis=2), (image < 100).all(axis=2)
    assert sorted(map(tuple, np.argwhere(free).tolist())) == [(1, 2), (1, 3), (2, 3)]
    assert sorted(map(tuple, np.argwhere(occupied).tolist())) == [(2, 2), (3, 3)]


class Tourist:
    """Explore with an empty map and a given tour."""

    def __init__(self):
        self.map = VoxelMap.prior(np.zeros(3), 0.1, (16, 16, 16))
        self.tour = None


def watched(choices):
    """Return a recording with these coverages and numbers of candidate places at each step (0: no choice)."""
    agent = Tourist()
    recording = Recording(agent)
    for i, (coverage, places) in enumerate(choices):
        if places:
            agent.tour = Tour(np.zeros((places, 2)), np.ones(places), 0)
        stop = float(i == len(choices) - 1)
        decision = Decision(np.array([0.0, 0.0, 0.1, stop], np.float32), None, "")
        info = {"coverage": coverage, "path_length": 0.1 * i}
        seen = {"rgb": np.zeros((3, 4, 3), np.uint8)}
        recording(StepRecord(i, 0.2 * i, np.array([0.1 * i, 0.0, 0.0]), seen, info, decision))
    return recording


@pytest.mark.parametrize(
    ("choices", "step"),
    [
        ([(0.1, 6), (0.3, 6), (0.35, 0), (0.5, 5), (0.6, 6), (0.7, 0)], 4),  # seen by the next moment
        ([(0.1, 3), (0.3, 0), (0.5, 2), (0.6, 0), (0.7, 0)], 0),  # never so many: the one among most
        ([(0.1, 0), (0.3, 0), (0.5, 0)], None),
    ],
)
def test_the_choice_shown_is_an_early_one_among_several(choices, step):
    recording = watched(choices)
    choice = recording.choice()
    assert (None if choice is None else round(choice.seconds / 0.2)) == step
    assert len(recording.track.path) == len(choices)
    assert recording.moments[-1].tour is None  # it has stopped
    if choice is not None:
        assert len(recording.track.until(choice.seconds)) == step + 1
