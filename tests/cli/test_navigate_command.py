"""Test ``vssm-gym navigate``: a run with its video, picture, row and map, and what is refused before anything runs."""

import json
from dataclasses import replace
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
from PIL import Image

from tests.helpers.box_rooms import two_rooms
from vssm_gym.agents import registry
from vssm_gym.agents.base import Decision
from vssm_gym.agents.registry import make_agent
from vssm_gym.agents.shared.mapping import MapAtObservedPose
from vssm_gym.agents.shared.own_map import OwnMap, OwnMapConfig
from vssm_gym.cli import demo as demo_module
from vssm_gym.cli import navigate as navigate_module
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.scene import load_scene, save_scene
from vssm_gym.envs.tasks.navigation import task_set
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.row import checked
from vssm_gym.eval.protocols import pointnav
from vssm_gym.eval.sweep.config import SweepConfig, expand
from vssm_gym.eval.video import navigator_run
from vssm_gym.eval.video.navigator_recording import region_95
from vssm_gym.eval.video.plans import CroppedPlan
from vssm_gym.planning.occupancy_grid import FREE, OCCUPIED, UNKNOWN
from vssm_gym.viz.pictures import REGION_95

FILES = {"navigate.json", "run.mp4", "run.png", "run.json"}
THERE = ("--start", "1.0,2.0", "--goal", "5.0,2.0")  # from the west through the door to the east


class Mapping:
    """Map at the observed pose, and drive straight at the goal: the door is between them."""

    name, robot, task, needs_pose, needs_map = "mapping_test_agent", "holonomic", "pointgoal", True, False

    def reset(self, context, observation, seed):
        self._own = OwnMap(context, MapAtObservedPose(), OwnMapConfig(voxel=0.1, extent=16.0), observation)
        self._command = None

    @property
    def map(self):
        return self._own.map

    @property
    def plan(self):
        return self._own.plan()

    def act(self, observation):
        if self._command is not None:
            self._own.take(self._command, observation)
        pose, goal = observation["pose"].astype(float), observation["goal"]
        ahead = goal - pose[:2]
        self._command = np.array([0.0, np.arctan2(ahead[1], ahead[0]) - pose[2], 0.16], np.float32)
        arrived = np.hypot(*ahead) < 0.3
        covariance = np.diag([0.02, 0.05, 0.01]) ** 2
        return Decision(
            np.array([*self._command, float(arrived)], np.float32),
            pose,
            "driving $\n\x1b[2J",  # no text of an agent's may change a picture
            plan=np.stack([pose[:2], goal]),
            covariance=covariance,
        )


@pytest.fixture(scope="module")
def rooms(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "rooms.json"
    save_scene(two_rooms(), path)
    return path


@pytest.mark.slow
def test_a_run_writes_its_video_picture_row_and_map(vssm, rooms, tmp_path, monkeypatch):
    pytest.importorskip("imageio_ffmpeg", reason="videos need the extra vssm-gym[viz]")
    monkeypatch.setitem(registry.AGENTS, Mapping.name, Mapping)
    out = tmp_path / "seen"
    asked = ("navigate", "--scene", rooms, "--out", out, "--agent", Mapping.name, "--noise", "none")
    code, printed, _ = vssm(*asked, *THERE)
    assert (code, {path.name for path in out.iterdir()}) == (0, FILES | {"map.npz"})
    assert printed.startswith("arrived after ")
    row = json.loads((out / "run.json").read_text())
    assert checked(row) == row  # as a sweep writes it
    assert row["success"] and row["goal"] == [5.0, 2.0] and row["in_95"] == 1.0
    assert np.asarray(Image.open(out / "run.png").convert("RGB")).std() > 5.0
    with imageio.get_reader(out / "run.mp4") as video:
        frames = [np.asarray(frame) for frame in video]
    assert frames[0].shape == (720, 1280, 3)
    assert len(frames) >= row["steps"]  # one a step
    free = [(frame[100:600, 500:1200] > 250).all(axis=2).mean() for frame in (frames[0], frames[-1])]
    assert free[1] > 1.2 * free[0]  # the belief has grown
    assert not list(tmp_path.glob(".*"))
    code, _, err = vssm(*asked, *THERE)
    assert (code, err.count("\n")) == (2, 1) and "never overwritten" in err
    (out / "run.mp4").unlink()  # as of a run that was killed in its video
    for other, field in (
        (("--start", "1.0,2.0", "--goal", "5.0,2.5"), "goal"),
        (("--start", "1.0,2.5", "--goal", "5.0,2.0"), "start"),
        ((*THERE, "--steps", "400"), "steps"),
        ((*THERE, "--seed", "1"), "config_hash"),
    ):
        code, _, err = vssm(*asked, *other)
        assert (code, err.count("\n")) == (2, 1) and f"navigate.json: {field}: expected " in err
    assert vssm(*asked, *THERE)[0] == 0
    again = json.loads((out / "run.json").read_text())
    assert {**again, "latency": 0} == {**row, "latency": 0}
    assert vssm("map", "export", out / "map.npz", "--out", tmp_path / "exported")[0] == 0


@pytest.mark.parametrize("number", [0, 2])
def test_the_row_is_that_of_a_sweep_of_the_task(rooms, tmp_path, number):
    """A task of the sweep, driven by goal and default start or by its number, gives the sweep's row."""
    apartment = load_scene(str(rooms))
    goal = None if number else task_set(apartment, HolonomicRobot(), "test", 1).tasks[0].goal
    drive = navigator_run.Drive(str(rooms), goal, "random", noise="mid", seed=3, task=number)
    row = navigator_run.navigate(navigator_run.prepare(drive), tmp_path / "run", video=False)
    assert {path.name for path in (tmp_path / "run").iterdir()} == FILES - {"run.mp4"}
    config = SweepConfig(scenes=(str(rooms),), agents=("random",), noise=("mid",), tasks=(number,), seeds=(3,))
    (episode,) = expand(config)
    pointnav.write_tasks(apartment, number + 1, tmp_path / "tasks.json")
    swept = pointnav.run(episode, make_agent("random"), tmp_path / "tasks.json", None)
    swept = episode.identity(apartment.content_hash()) | swept
    for name in ("geodesic", "spl", "soft_spl"):  # files of tasks round the geodesic to a micrometre
        assert row.pop(name) == pytest.approx(swept.pop(name), abs=1e-6)
    timed = {"latency", "version", "processor", "config_hash", "map_hash"}
    assert {k: v for k, v in row.items() if k not in timed} == {k: v for k, v in swept.items() if k not in timed}
    with pytest.raises(InputError, match="never overwritten"):
        navigator_run.navigate(navigator_run.prepare(drive), tmp_path / "run", video=False)


def test_a_test_task_gives_start_and_goal_where_none_is_given(rooms):
    tasks = task_set(load_scene(str(rooms)), HolonomicRobot(), "test", 4).tasks
    for number, task in enumerate(tasks):
        drive = navigator_run.Drive(str(rooms), None, "random", task=number)
        prepared = navigator_run.prepare(drive)
        assert (prepared.task.start, prepared.task.goal) == (task.start, task.goal)
        goal = tasks[0].goal if number else tasks[1].goal
        assert navigator_run.prepare(replace(drive, goal=goal)).task.start == task.start


@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_an_image_is_a_goal_of_which_nothing_is_judged(rooms, tmp_path, monkeypatch, ending):
    """The agent sees the given image, whatever the stand-in's goal shows, and the row claims nothing about the goal."""
    image = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)
    image[:, 80:] = 255, 0, 255
    Image.fromarray(image).save(tmp_path / f"goal.{ending}")
    given = np.asarray(Image.open(tmp_path / f"goal.{ending}"))
    seen = []

    class Looking(registry.AGENTS["random"]):
        name = "looking_test_agent"

        def act(self, observation):
            seen.append(observation["goal_rgb"])
            return super().act(observation)

    monkeypatch.setitem(registry.AGENTS, Looking.name, Looking)
    to = navigate_module.parse_goal(str(tmp_path / f"goal.{ending}"))
    drive = navigator_run.Drive(str(rooms), to, Looking.name, steps=5)
    row = navigator_run.navigate(navigator_run.prepare(drive), tmp_path / "run", video=False)
    assert all(np.array_equal(one, given) for one in seen) and len(seen) == 5
    judged = ("success", "spl", "soft_spl", "geodesic", "distance_to_goal", "failure", "goal")
    assert all(row[field] is None for field in judged)
    assert row["steps"] == 5 and row["path_length"] > 0.0
    assert navigate_module.summary(row).startswith("success is not judged, ")
    shown = np.asarray(Image.open(tmp_path / "run/run.png").convert("RGB")).astype(int)
    lowest = shown[int(0.75 * len(shown)) :]
    assert (np.abs(lowest - (255, 0, 255)).max(axis=-1) < 30).mean() > 0.05  # the goal's image lies at the bottom


def test_an_agent_with_an_image_for_its_goal_is_judged_where_the_place_is_given(rooms, monkeypatch):
    class ToImage(registry.AGENTS["random"]):
        name, task = "image_test_agent", "imagegoal"

    monkeypatch.setitem(registry.AGENTS, ToImage.name, ToImage)
    prepared = navigator_run.prepare(navigator_run.Drive(str(rooms), (5.0, 2.0), ToImage.name, (1.0, 2.0, 0.0)))
    assert prepared.episode.condition.env == navigator_run.IMAGENAV
    assert (prepared.image, prepared.task.goal) == (None, (5.0, 2.0))


@pytest.mark.parametrize(
    ("options", "agent"),
    [
        (("--goal", "5,2"), "slam_nav"),
        (("--goal", "5,2", "--map", "oak"), "astar"),
        (("--goal", __file__, "--map", "oak"), "astar_image"),
        (("--goal", __file__), "slam_image"),
        (("--goal", "5,2", "--map", "oak", "--agent", "oracle"), "oracle"),
        (("--goal", "-5.5,-2", "--start", "-1,-2"), "slam_nav"),  # no options, though they begin so
        (("--task", "3"), "slam_nav"),
    ],
)
def test_the_agent_follows_from_map_and_goal(vssm, tmp_path, monkeypatch, options, agent):
    pytest.importorskip("imageio_ffmpeg", reason="videos need the extra vssm-gym[viz]")

    def prepare(drive):
        raise InputError("seen", "agent", drive.agent)

    monkeypatch.setattr(navigator_run, "prepare", prepare)
    code, _, err = vssm("navigate", "--scene", "oak", "--out", tmp_path / "new", *options)
    assert (code, err) == (2, f"error: seen: agent: expected {agent}\n")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--agent", "nobody"), "navigate: agent: expected one of astar, "),
        (("--agent", "mi_explorer"), "found 'mi_explorer', whose robot is 'holonomic' and whose task is 'explore'"),
        (("--agent", "astar+nothing", "--map", "oak"), "nothing"),
        (("--agent", "astar"), "navigate: map: expected a map of `vssm-gym map build`, or one that comes with"),
        (("--map", "oak"), "navigate: map: expected none with random, an agent that is given no map; found oak"),
        (("--agent", "astar", "--map", "nowhere.npz"), "nowhere.npz: file: expected an existing map file"),
        (("--scene", "nowhere"), "navigate: scene: expected a built-in scene"),
        (("--scene", "oka"), "found 'oka' (did you mean 'oak'?)"),
        (("--noise", "loud"), "navigate: noise: expected one of none, low, "),
        (("--sensor-noise", "loud"), "navigate: sensor_noise: expected one of none, "),
        (("--steps", "0"), "navigate: steps: expected at least 1, found 0"),
        (("--seed", "-1"), "navigate: seed: expected at least 0, found -1"),
        (
            ("--goal", "5"),
            "navigate: goal: expected numbers x,y in metres, or the file of an image; there is no file '5'",
        ),
        (("--goal", "5,2,0"), "navigate: goal: expected numbers x,y"),
        (("--goal", "no/picture.png"), "there is no file 'no/picture.png'"),
        (
            ("--goal", "90,90"),
            "navigate: goal: expected a position where the robot fits; at (90.00, 90.00) that is off",
        ),
        (("--task", "-1"), "navigate: task: expected at least 0, found -1"),
        (("--task", "200"), "navigate: task: expected less than 200; found 200"),
        (("--goal", "1,2.3"), "navigate: goal: expected a place that is not reached already at the start"),
        (("--goal", "3,3"), "goal: expected a position where the robot fits; at (3.00, 3.00) it would collide with"),
        (("--goal", "nan,2"), "goal[0]: expected a finite number"),
        (("--start", "1"), "navigate: start: expected numbers x,y or x,y,heading in metres and radians, not '1'"),
        (("--start", "1,2,inf"), "start[2]: expected a finite number"),
        (("--start", "50,50"), "start: expected a position where the robot fits; at (50.00, 50.00) that is off"),
    ],
)
def test_bad_arguments_are_refused_in_one_line(vssm, rooms, tmp_path, options, said):
    pytest.importorskip("imageio_ffmpeg", reason="videos need the extra vssm-gym[viz]")
    usual = {"--scene": rooms, "--out": tmp_path / "new", "--start": "1,2", "--goal": "5,2", "--agent": "random"}
    arguments = usual | dict(zip(options[::2], options[1::2], strict=True))
    code, out, err = vssm("navigate", *(word for pair in arguments.items() for word in pair))
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert said in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("image", "said"),
    [
        (np.zeros((60, 160, 3), np.uint8), "size: expected 160x120 pixels, as of the robot's camera; found 160x60"),
        (np.zeros((120, 160), np.uint16), "pixels: expected 8 bits a colour channel"),
        (None, "pixels: expected a readable image"),
    ],
)
def test_other_images_than_the_cameras_are_refused(rooms, tmp_path, image, said):
    path = tmp_path / "goal.png"
    path.write_text("no image") if image is None else Image.fromarray(image).save(path)
    with pytest.raises(InputError, match=said):
        navigator_run.prepare(navigator_run.Drive(str(rooms), path, "random"))


@pytest.mark.parametrize("heading", [0.0, 0.7, -2.9])
def test_the_region_holds_95_percent_of_errors_in_the_body_frame(heading):
    """Errors forward and left, turned by the heading, are inside the outline in 95 % of the draws."""
    estimate, factor = np.array([2.0, -1.0, heading]), np.array([[0.3, 0.0, 0.0], [0.1, 0.05, 0.0], [0.0, 0.0, 0.02]])
    outline = region_95(estimate, factor @ factor.T)
    c, s = np.cos(heading), np.sin(heading)
    R_body_world = np.array([[c, s], [-s, c]])
    metric = np.linalg.inv((factor @ factor.T)[:2, :2])
    away = (outline - estimate[:2]) @ R_body_world.T
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", away, metric, away), REGION_95**2, rtol=1e-9)
    draws = np.random.default_rng(0).normal(size=(20_000, 3)) @ factor.T
    share = (np.einsum("ni,ij,nj->n", draws[:, :2], metric, draws[:, :2]) <= REGION_95**2).mean()
    assert share == pytest.approx(0.95, abs=0.006)


def test_a_close_up_shows_the_cells_of_the_plan_at_their_places():
    cells = np.array([[FREE, OCCUPIED], [UNKNOWN, FREE], [OCCUPIED, FREE]], np.int8)
    plan = CroppedPlan(cells, np.array([1.0, 2.0]), 0.5)
    close = plan.around(np.array([1.5, 2.25]), 1.0, 4)  # centres of cells: x 0.75, 1.25, ...; y 1.5, 2.0, ...
    x, y = 1.5 + np.array([-0.75, -0.25, 0.25, 0.75]), 2.25 + np.array([-0.75, -0.25, 0.25, 0.75])
    for i, j in np.ndindex(4, 4):
        cell = np.floor((np.array([x[i], y[j]]) - plan.bounds[0]) / plan.resolution).astype(int)
        inside = bool(((cell >= 0) & (cell < cells.shape)).all())
        assert close[i, j] == (cells[tuple(cell)] if inside else UNKNOWN)


def test_the_demo_shows_one_run_once_and_does_without_a_video(tmp_path, monkeypatch, capsys):
    def none(command):
        raise InputError(command, "video", "a writer of videos")

    monkeypatch.setattr("vssm_gym.eval.video.writer.check_writer", none)
    monkeypatch.setattr(demo_module, "AGENT", "random")  # it needs no map
    for _ in range(2):
        demo_module.show_run(tmp_path)
        printed = capsys.readouterr()
        assert printed.out.splitlines() == [str(tmp_path / "navigate/run.png")]
        assert "no video of the run: demo: video: expected a writer of videos\n" in printed.err
        files = {path: path.stat().st_mtime_ns for path in (tmp_path / "navigate").iterdir()}
        assert {path.name for path in files} == FILES - {"run.mp4"}
    demo_module.show_run(tmp_path)
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "navigate").iterdir()} == files


@pytest.mark.parametrize(
    ("scene", "goal", "said"),
    [
        ("elm", (3.0, 3.0), "is it a map of this scene?"),
        ("moss", (6.5, 1.5), "places where the robot fits in this scene: is it a map of this scene?"),
        ("oak", (2.36, 5.36), None),
    ],
)
def test_a_map_of_another_scene_is_noticed(scene, goal, said):
    """The robot would look for itself in it for 65 steps, and its user for the reason for longer."""
    notice = navigator_run.prepare(navigator_run.Drive(scene, goal, "astar", map=Path("oak"))).notice
    assert notice is None if said is None else said in notice
