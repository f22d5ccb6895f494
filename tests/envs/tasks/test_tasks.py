"""Test tasks: their definition, seeds, disjoint splits, and files that are read unchanged or refused."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import shapely

from tests.helpers.box_rooms import furniture, two_rooms
from vssm_gym.envs.physics import FloorWorld
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.scene import Door, built_in_scenes, load_scene
from vssm_gym.envs.tasks import navigation as tasks_module
from vssm_gym.envs.tasks.navigation import (
    START_SLACK,
    Split,
    TaskSampler,
    TaskSet,
    freeze,
    load,
    make_tasks,
    save,
    task_set,
)
from vssm_gym.errors import InputError

ROBOT = HolonomicRobot()
SLOW = pytest.mark.slow
SOFA = furniture("sofa", (1.2, 2.0, 0.3), (0.8, 1.6, 0.6))


def check_definition(tasks: TaskSet, sampler: TaskSampler) -> None:
    """Assert that tasks are free with a margin, apart, long enough, and of this scene."""
    starts, goals = np.array([t.start for t in tasks.tasks]), np.array([t.goal for t in tasks.tasks])
    geodesic = np.array([t.geodesic for t in tasks.tasks])
    border = sampler.space.region.boundary
    for positions in (starts[:, :2], goals):
        assert sampler.space.contains(positions).all()
        assert np.all(shapely.distance(border, shapely.points(positions)) >= 0.019)
    away = np.linalg.norm(starts[:, :2] - goals, axis=1)
    assert np.all(away > 0.6) and np.all(geodesic >= 1.0) and np.all(geodesic >= away - 0.4 - 1e-6)
    assert np.all(np.abs(starts[:, 2]) <= np.pi + 1e-4) and len(np.unique(starts, axis=0)) == len(starts)
    assert [t.id for t in tasks.tasks] == list(range(len(starts)))
    for task in tasks.tasks:
        sampler.validate(task)


def test_tasks_obey_their_definition() -> None:
    apartment = two_rooms(pieces=(SOFA,))
    tasks = make_tasks(apartment, ROBOT, 40, "test")
    check_definition(tasks, TaskSampler(apartment, ROBOT))
    assert tasks.hash == tasks.content_hash() and tasks.scene_hash == apartment.content_hash()


def test_streams() -> None:
    """Same seed same tasks; a longer set begins with the shorter; splits and seeds share nothing."""
    apartment = two_rooms()
    first, again = make_tasks(apartment, ROBOT, 5, "test"), make_tasks(apartment, ROBOT, 5, "test")
    assert first == again and make_tasks(apartment, ROBOT, 12, "test").tasks[:5] == first.tasks
    others = [make_tasks(apartment, ROBOT, 12, "train"), make_tasks(apartment, ROBOT, 12, "test", seed=1)]
    places = {place for t in first.tasks for place in (t.start[:2], t.goal)}
    for other in others:
        assert places.isdisjoint(place for t in other.tasks for place in (t.start[:2], t.goal))
        assert other.hash != first.hash


def test_goals_stay_in_the_connected_part() -> None:
    """Behind a closed door there are no tasks: all are in one room."""
    apartment = two_rooms(openness=0.0, leaves=1)
    tasks = make_tasks(apartment, ROBOT, 20, "train")
    assert len({t.start[0] > 3.0 for t in tasks.tasks} | {t.goal[0] > 3.0 for t in tasks.tasks}) == 1


def test_file_round_trip(tmp_path: Path) -> None:
    apartment = two_rooms()
    tasks = make_tasks(apartment, ROBOT, 4, "test")
    path = tmp_path / "tasks.json"
    save(tasks, path)
    assert load(path, apartment) == tasks == load(path)
    assert [p.name for p in tmp_path.iterdir()] == ["tasks.json"]
    assert len(path.read_text().splitlines()) < 30  # one task a line


def test_damaged_files_are_refused(tmp_path: Path) -> None:
    apartment = two_rooms()
    path = tmp_path / "tasks.json"
    save(make_tasks(apartment, ROBOT, 3, "test"), path)
    text = path.read_text()
    data = json.loads(text)

    def refused(content: str, field: str, of: object = apartment) -> None:
        path.write_text(content)
        with pytest.raises(InputError, match=r"tasks\.json") as error:
            load(path, of)  # type: ignore[arg-type]
        assert error.value.field == field

    refused(text[: len(text) // 2], "line 13")
    refused(json.dumps(data | {"format": 2}), "format")
    refused(json.dumps({k: v for k, v in data.items() if k != "scene_hash"}), "scene_hash")
    refused(json.dumps(data | {"split": "dev"}), "split")
    moved = json.loads(text)
    moved["tasks"][1]["goal"][0] += 0.001
    refused(json.dumps(moved), "hash")
    moved["tasks"][1]["goal"] = [1.0]
    refused(json.dumps(moved), "tasks[1].goal[1]")
    refused(text.replace('"geodesic": ', '"geodesic": NaN, "x": '), "content")
    refused(text, "scene_hash", two_rooms(pieces=(SOFA,)))
    with pytest.raises(InputError, match="readable task file"):
        load(tmp_path / "none.json", apartment)


def test_frozen_file_counts_only_for_its_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    apartment = two_rooms()
    monkeypatch.setattr(tasks_module, "FROZEN", tmp_path)
    paths = freeze(apartment, ROBOT, n=6, folder=tmp_path)
    assert [p.name for p in paths] == ["two_rooms-train.json", "two_rooms-test.json"]
    made = make_tasks(apartment, ROBOT, 4, "test")
    calls = []

    def remember(*args: object) -> TaskSet:
        calls.append(args)
        return made

    monkeypatch.setattr(tasks_module, "make_tasks", remember)
    assert task_set(apartment, ROBOT, "test", 4) == made and calls == []  # from the file, and the same
    task_set(apartment, ROBOT, "test", 7)  # more than there are
    task_set(two_rooms(pieces=(SOFA,)), ROBOT, "test", 4)  # another scene of that name
    task_set(apartment, HolonomicRobot(height=0.6), "test", 4)  # another robot
    assert len(calls) == 3


VENUES = ("arena", "depot", "dock", "garage", "hall", "paddock")  # they have no rooms to go between
HOMES = [scene for scene in built_in_scenes() if scene not in VENUES]


@pytest.mark.parametrize("scene", HOMES)
@pytest.mark.parametrize("split", ["train", "test"])
def test_built_in_scenes_are_frozen(scene: str, split: Split) -> None:
    """If this fails the scene changed: `tasks.freeze(load_scene(name), HolonomicRobot())` writes the files again."""
    apartment = load_scene(scene)
    frozen = load(tasks_module.FROZEN / f"{scene}-{split}.json", apartment)
    assert len(frozen.tasks) == 200 and frozen.split == split
    # The same machine-independent draws: positions are equal, geodesics up to rounding of the geometry library.
    for task, again in zip(frozen.tasks[:4], make_tasks(apartment, ROBOT, 4, split).tasks, strict=True):
        assert task.start == again.start and task.goal == again.goal
        assert task.geodesic == pytest.approx(again.geodesic, abs=2e-6)


@pytest.mark.parametrize("scene", [scene if scene == "oak" else pytest.param(scene, marks=SLOW) for scene in HOMES])
@pytest.mark.parametrize("split", ["train", "test"])
def test_frozen_tasks_keep_the_definition(scene: str, split: Split) -> None:
    apartment = load_scene(scene)
    check_definition(load(tasks_module.FROZEN / f"{scene}-{split}.json", apartment), TaskSampler(apartment, ROBOT))


def test_impossible_tasks_name_the_field() -> None:
    sampler = TaskSampler(two_rooms(pieces=(SOFA,)), ROBOT)
    good = sampler.task((0.4, 2.0, 0.0), (4.5, 2.0), task_id=3)
    assert good.geodesic > 4.1 - 0.4 and good.scene == "two_rooms"
    for start, goal, message in (
        ((0.4, 2.0, 0.0), (1.2, 2.0), r"task 3 of two_rooms: goal: .* it would collide with sofa"),
        ((0.4, 2.0, 0.0), (3.0, 1.0), r"goal: .* it would collide with wall 4"),
        ((1.2, 2.0, 0.0), (0.4, 2.0), r"start: .* it would collide with sofa"),
        ((0.4, 2.0, 0.0), (9.0, 9.0), r"goal: .* off the floor"),
        ((0.4, 2.0, 0.0), (float("nan"), 1.0), r"task: goal\[0\]: expected a finite number"),
        ((0.4, 2.0), (1.0, 1.0), r"task: start\[2\]"),
    ):
        with pytest.raises(InputError, match=message):
            sampler.task(start, goal, task_id=3)
    with pytest.raises(InputError, match="geodesic"):
        sampler.validate(good.model_copy(update={"geodesic": 1.0}))
    with pytest.raises(InputError, match="scene: expected 'two_rooms'"):
        sampler.validate(good.model_copy(update={"scene": "oak"}))
    closed = TaskSampler(two_rooms(openness=0.0, leaves=1), ROBOT)
    with pytest.raises(InputError, match="goal: expected a position that the robot can reach"):
        closed.task((1.0, 1.0, 0.0), (5.0, 1.0))
    with pytest.raises(InputError, match=r"start: .* it would collide with wall 3"):
        sampler.task((0.115, 1.0, 0.0), (0.5, 3.5))


@pytest.mark.parametrize("thickness", [0.1, 0.12])
def test_a_task_may_start_where_contacts_left_the_robot(thickness: float) -> None:
    """Pressed against a wall, and into the recess of a closed outer door whose leaf is flush with the outside."""
    flat = two_rooms()
    walls = tuple(wall.model_copy(update={"thickness": thickness}) for wall in flat.walls)
    front_door = Door(
        wall=3, offset=1.5, width=0.9, height=2.0, openness=0.0, leaves=1, swing="back", rooms=("west", None)
    )
    flat = flat.model_copy(update={"walls": walls, "doors": (*flat.doors, front_door)})
    world, sampler = FloorWorld(flat, ROBOT), TaskSampler(flat, ROBOT)
    for y, obstacle in ((1.0, "wall 3"), (2.0, "door 1")):
        world.reset(np.array([0.4, y, np.pi]))
        for _ in range(5):
            world.drive(world.pose() - [0.1, 0.0, 0.0])
        assert world.contacts()[0].startswith(obstacle)
        x = world.pose()[0]
        assert not sampler.space.contains(np.array([x, y]))
        task = sampler.task((x, y, 0.0), (2.5, y))
        sampler.validate(task)
        assert task.geodesic == pytest.approx(2.5 - x - 0.4, abs=START_SLACK)  # straight away from the wall


def test_bad_requests() -> None:
    with pytest.raises(InputError, match="split"):
        make_tasks(two_rooms(), ROBOT, 1, "dev")  # type: ignore[arg-type]
    crowded = two_rooms(  # all that is left is a nook of 0.3 x 0.55 m
        openness=0.0,
        leaves=1,
        pieces=(
            furniture("a", (1.25, 2.0, 0.3), (2.4, 3.9, 0.6)),
            furniture("b", (2.7, 1.6, 0.3), (0.5, 3.2, 0.6)),
            furniture("c", (4.5, 2.0, 0.3), (2.9, 3.9, 0.6)),
        ),
    )
    with pytest.raises(InputError, match="m of path apart"):
        TaskSampler(crowded, ROBOT).draw(np.random.default_rng(0))


@pytest.mark.parametrize("house", ["house_0", "house_1", "house_987654321"])
def test_published_houses(house: str, shared_data: Path) -> None:
    """Tasks and a whole set of checks on ProcTHOR houses; house_0 says itself that a room may be out of reach."""
    apartment = load_scene(shared_data / "procthor" / "houses" / f"{house}.json")
    sampler = TaskSampler(apartment, ROBOT)
    check_definition(make_tasks(apartment, ROBOT, 10, "test"), sampler)
    assert any("not navigable" in note for note in apartment.notes) == (house == "house_0")
    cut_off = sampler.space.cut_off_rooms()  # with doors and furniture as imported, our small robot gets everywhere
    assert cut_off == []
    # A robot too wide for the doors does not: the rooms it cannot enter are named.
    wide = sampler.space.widened(0.45)
    assert wide.cut_off_rooms()
    with pytest.raises(InputError, match=re.escape(wide.cut_off_rooms()[0])):
        wide.check_connected()
