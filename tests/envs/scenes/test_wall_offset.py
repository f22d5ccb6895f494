"""Test mazes with another corridor width: ranges by hand, gaps, names and tasks, and offsets that cut them apart."""

import numpy as np
import pytest

from vssm_gym.data.traversals import traverse
from vssm_gym.envs.lidar_maze import LidarMazeEnv
from vssm_gym.envs.physics.planar import scan
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.scenes.wall_offset import with_wall_offset
from vssm_gym.envs.tasks.mazes import MAZES, load_maze
from vssm_gym.errors import InputError

MIDDLE = np.array([[0.1, 0.5, 0.0]])  # of serpentine's first corridor, facing across it


@pytest.mark.parametrize("offset", [0.02, 0.03, -0.004])
def test_a_corridor_is_narrower_by_twice_the_offset(offset: float) -> None:
    before, after = (scan(MIDDLE, load_maze("serpentine-v1", d).rectangles, 4)[0] for d in (0.0, offset))
    np.testing.assert_allclose(after[[0, 2]], before[[0, 2]] - offset, atol=1e-9)
    assert before[0] + before[2] == pytest.approx(0.2 - 0.01 - 0.006)


def test_gaps_narrow_with_the_corridors_and_joints_stay_closed() -> None:
    """In serpentine the first wall ends 0.17 below the border's surface; rays along a wall meet no new gap."""
    above = np.array([[0.2, 0.9, -0.5 * np.pi]])
    before, after, wider = (scan(above, load_maze("serpentine-v1", d).rectangles, 1)[0, 0] for d in (0.0, 0.02, -0.004))
    assert after == pytest.approx(before - 0.02) and wider == pytest.approx(before)
    assert len(load_maze("rooms-v1", -0.008).space.region.geoms) == 1


@pytest.mark.parametrize("name", MAZES)
def test_every_maze_stands_a_little_more_and_a_little_less(name: str) -> None:
    for offset in (0.01, -0.003):
        maze = load_maze(name, offset)
        assert maze.name == f"{name}{1e3 * offset:+g}mm"
        assert maze.space.region.area != pytest.approx(load_maze(name).space.region.area)


def test_tasks_are_made_anew_and_the_maze_itself_stays() -> None:
    before = load_maze("spiral-v1")
    maze = load_maze("spiral-v1", 0.02)
    assert maze.tasks.scene == "spiral-v1+20mm" and maze.tasks.scene_hash != before.apartment.content_hash()
    assert all(maze.space.contains(np.array(task.goal)) for task in maze.tasks.tasks)
    assert maze.tasks.tasks[0].geodesic != before.tasks.tasks[0].geodesic
    assert load_maze("spiral-v1", 0.0).apartment == before.apartment
    assert load_maze("pillars-v1", 0.01).tasks.split == "train"
    assert len(traverse(maze, 20)) == 21
    env = LidarMazeEnv("spiral-v1", wall_offset=0.02)
    env.reset(seed=0)
    assert env.maze.name == "spiral-v1+20mm"


@pytest.mark.parametrize(
    ("name", "offset", "field", "expected"),
    [
        ("rooms-v1", 0.05, "walls", "one connected part"),
        ("serpentine-v1", 0.2, "walls", ""),
        ("serpentine-v1", -0.006, "wall_offset", "-0.005 m at least"),
        ("serpentine-v1", np.nan, "wall_offset", "finite"),
        ("serpentine-v1", True, "wall_offset", "finite"),
        ("serpentine-v1", "wide", "wall_offset", "finite"),
    ],
)
def test_offsets_that_no_robot_could_drive_in_are_named(name: str, offset: object, field: str, expected: str) -> None:
    with pytest.raises(InputError) as error:
        load_maze(name, offset)
    assert (not expected or error.value.field == field) and expected in str(error.value)


def test_a_scene_with_doors_is_refused() -> None:
    with pytest.raises(InputError, match="without doors"):
        with_wall_offset(load_scene("oak"), 0.01)
