"""Test the seven mazes and their tasks: connected, different, frozen; an invalid maze is refused with the reason."""

import numpy as np
import pytest
import shapely

from tests.helpers.box_rooms import furniture, two_rooms
from vssm_gym.envs.physics.planar import clearance, scan
from vssm_gym.envs.scenes.scene import Apartment, save_scene
from vssm_gym.envs.tasks.maze_objectives import TILES, MazeCoverage
from vssm_gym.envs.tasks.mazes import FOLDER, GRID_SIDE, MAZES, ROBOT, grid_tasks, load_maze
from vssm_gym.envs.tasks.navigation import SUCCESS, load
from vssm_gym.errors import InputError

# Closed loops of free space, each around a solid that is not connected to the border, distinguish mazes best.
LOOPS = {
    "pillars-v1": 11,
    "rings-v1": 4,
    "rooms-v1": 1,
    "serpentine-v1": 0,
    "slanted-v1": 9,
    "spiral-v1": 0,
    "tree-v1": 0,
}
RADIUS = SUCCESS * ROBOT.body_length


def changed(**fields) -> Apartment:
    """Return the rooms maze with other fields."""
    return load_maze("rooms-v1").apartment.model_copy(update={"name": "mine", **fields})


def test_success_is_within_a_twentieth_of_the_maze():
    assert pytest.approx(0.05) == RADIUS


def test_seven_mazes_are_built_in():
    assert len(MAZES) == 7 and sorted(MAZES) == sorted(path.stem for path in FOLDER.glob("*.json"))
    assert len({load_maze(name).apartment.content_hash() for name in MAZES}) == 7
    assert set(LOOPS) == set(MAZES)


@pytest.mark.parametrize("name", MAZES)
def test_a_maze_is_one_connected_part_of_the_unit_square(name):
    maze = load_maze(name)
    assert (
        maze.name == name and maze.space.region.bounds >= (0.0, 0.0, 0.0, 0.0) and max(maze.space.region.bounds) <= 1.0
    )
    [region] = maze.space.region.geoms
    assert len(region.interiors) == LOOPS[name]
    # Passages are wide or closed: a robot a quarter larger reaches as much.
    wider = maze.space.widened(0.25 * ROBOT.radius)
    assert len(wider.region.geoms) == 1


@pytest.mark.parametrize("name", MAZES)
def test_no_ray_leaves_a_maze(name):
    maze = load_maze(name)
    positions = maze.space.sample(np.random.default_rng(0), 200)
    ranges = scan(np.column_stack([positions, np.zeros(200)]), maze.rectangles, 64)
    assert (ranges > 0.99 * ROBOT.radius).all() and (ranges <= np.sqrt(2.0)).all()


@pytest.mark.parametrize("name", MAZES)
def test_its_tasks_are_all_pairs_of_the_grid_and_frozen(name):
    maze = load_maze(name)
    frozen = load(FOLDER / "tasks" / f"{name}.json", maze.apartment)  # checks both hashes
    assert maze.tasks == frozen and frozen.split == ("train" if name == "pillars-v1" else "test")
    pairs = {(task.start[:2], task.goal) for task in frozen.tasks}
    centres = {(0.1 + 0.2 * i, 0.1 + 0.2 * j) for i in range(GRID_SIDE) for j in range(GRID_SIDE)}
    assert len(pairs) == len(frozen.tasks) == 600
    assert {(round(x, 1), round(y, 1)) for x, y in centres} == {place for pair in pairs for place in pair}
    for task in frozen.tasks:
        away = np.hypot(*(np.array(task.goal) - task.start[:2]))
        assert np.isfinite(task.geodesic) and task.geodesic >= away - RADIUS - 1e-6
        assert clearance(*task.start[:2], maze.rectangles) > 2.0 * ROBOT.radius


@pytest.mark.parametrize("name", MAZES)
def test_frozen_geodesics_are_those_of_today(name):
    sampler = load_maze(name).sampler
    for task in load_maze(name).tasks.tasks[::30]:
        made = sampler.task(task.start, task.goal, task.id)
        assert made.geodesic == pytest.approx(task.geodesic, abs=2e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", MAZES)
def test_frozen_tasks_are_those_made_today(name):
    maze = load_maze(name)
    again = grid_tasks(maze)
    for task, made in zip(maze.tasks.tasks, again.tasks, strict=True):
        assert made.geodesic == pytest.approx(task.geodesic, abs=2e-6)
        assert made.model_copy(update={"geodesic": task.geodesic}) == task


def test_paths_are_long_in_the_serpentine_and_short_between_pillars():
    assert max(task.geodesic for task in load_maze("serpentine-v1").tasks.tasks) > 3.5
    assert max(task.geodesic for task in load_maze("pillars-v1").tasks.tasks) < 1.2


def test_a_custom_maze(tmp_path):
    blocked = changed(furniture=(furniture("crate", (0.1, 0.1, 0.05), (0.06, 0.06, 0.1)),))
    path = tmp_path / "mine.json"
    save_scene(blocked, path)
    for spec in (path, str(path), blocked):
        maze = load_maze(spec)
        assert maze.apartment == blocked
    assert len(maze.tasks.tasks) == 24 * 23  # the position in the crate is none
    assert maze.tasks.split == "test" and all(task.scene == "mine" for task in maze.tasks.tasks)
    assert (0.1, 0.1) not in {task.goal for task in maze.tasks.tasks}


def walls_without(index: int) -> tuple:
    walls = load_maze("rooms-v1").apartment.walls
    return walls[:index] + walls[index + 1 :]


@pytest.mark.parametrize(
    ("spec", "field", "expected"),
    [
        ("no such maze", "scene", "spiral-v1"),
        ("oak", "scene", "spiral-v1"),
        (3, "scene", "an Apartment"),
        (None, "scene", "a maze's name"),
        (two_rooms(), "rooms", "x from 0 to 6, y from 0 to 4"),
        (changed(walls=walls_without(2)), "walls", "border of the floor"),
        (changed(furniture=(furniture("bar", (0.8, 0.18, 0.05), (0.06, 0.14, 0.1)),)), "walls", "connected"),
        (changed(furniture=(furniture("sill", (0.5, 0.1, 0.02), (0.02, 0.1, 0.04)),)), "furniture", "'sill' does not"),
        (changed(furniture=(furniture("beam", (0.5, 0.1, 0.09), (0.02, 0.1, 0.04)),)), "furniture", "'beam' does not"),
        (changed(furniture=(furniture("rock", (0.5, 0.5, 0.05), (0.99, 0.99, 0.1)),)), "rooms", "no position is free"),
    ],
)
def test_an_invalid_maze_is_refused(spec, field, expected):
    with pytest.raises(InputError) as error:
        load_maze(spec)
    assert error.value.field == field and expected in str(error.value)


def test_a_grid_without_two_free_positions_has_no_tasks():
    bars = tuple(furniture(f"bar {i}", (0.1 + 0.2 * i, 0.52, 0.05), (0.1, 0.92, 0.1)) for i in range(GRID_SIDE))
    border = load_maze("rooms-v1").apartment.walls[:4]
    maze = load_maze(changed(walls=border, furniture=bars))
    with pytest.raises(InputError, match="two free positions"):
        maze.tasks  # noqa: B018


@pytest.mark.parametrize("name", MAZES)
def test_tiles_count_where_half_of_them_is_free(name):
    maze = load_maze(name)
    tiles = MazeCoverage(maze.space)
    assert 0.7 * TILES**2 < tiles.counted.sum() <= TILES**2
    share = shapely.area(maze.space.region.intersection(shapely.box(0.3, 0.5, 0.4, 0.6))) / 0.01
    assert tiles.counted[3, 5] == (share >= 0.5)
