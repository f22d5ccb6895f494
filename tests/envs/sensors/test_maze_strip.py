"""Test strips of a maze: the walls that they show against exact rays, their order, their paint and their noise."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest

from vssm_gym.data.traversals import errors, traverse
from vssm_gym.envs.lidar_maze import LidarMazeEnv
from vssm_gym.envs.maze_noise import STRIP_NOISE
from vssm_gym.envs.physics.planar import rectangles, scan
from vssm_gym.envs.rendering.maze_paint import painted
from vssm_gym.envs.scenes.apartment_parts import Material
from vssm_gym.envs.sensors.maze_strip import MazeStrip, StripNoise
from vssm_gym.envs.tasks.mazes import MAZES, load_maze
from vssm_gym.errors import InputError

HEIGHT = 0.05  # m, of the camera
COLUMNS = 64  # of a strip
POSES = np.array([[0.5, 0.5, 0.0], [0.1, 0.1, 0.7], [0.9, 0.3, -2.0]])
PRIMARY = np.eye(3)  # red, green, blue


def camera(maze: str, columns: int = COLUMNS, noise: StripNoise = STRIP_NOISE["none"]) -> MazeStrip:
    return MazeStrip(columns, painted(load_maze(maze).apartment.boxes(), maze), HEIGHT, noise)


@pytest.mark.parametrize("pose", POSES)
def test_each_column_shows_the_wall_that_its_ray_meets(pose: np.ndarray) -> None:
    """Walls in red, green and blue: the channel of a column is that of the nearest rectangle along it."""
    boxes = [box for box in load_maze("slanted-v1").apartment.boxes() if len(rectangles([box], HEIGHT))]
    colours = np.arange(len(boxes)) % 3
    plain = [replace(box, material=Material(color=tuple(PRIMARY[k]))) for box, k in zip(boxes, colours, strict=True)]
    seen = MazeStrip(COLUMNS, plain, HEIGHT, StripNoise()).see(pose)[0]
    fine = 8 * COLUMNS  # rays, so that columns with an edge in them are known
    ranges = np.array([scan(pose[None], one[None], fine)[0] for one in rectangles(boxes, HEIGHT)])
    met = colours[np.argmin(ranges, axis=0)]
    around = np.array([np.roll(met, by)[::8] for by in range(-5, 6)])  # the column's rays, and a little beyond
    whole = (around == around[0]).all(axis=0)
    assert whole.sum() > COLUMNS / 2
    np.testing.assert_array_equal(np.argmax(seen, axis=1)[whole], met[::8][whole])
    assert (np.sort(seen[whole], axis=1)[:, :2] == 0).all()


def test_a_turn_by_columns_shifts_the_strip() -> None:
    eye = camera("rooms-v1")
    pose = np.array([0.3, 0.3, 0.2])
    turned = pose + np.array([0.0, 0.0, 2.0 * np.pi * 5 / COLUMNS])
    away = np.abs(np.roll(eye.see(pose)[0].astype(int), -5, axis=0) - eye.see(turned)[0])
    assert np.median(away) <= 2 and np.mean(away) < 6.0


@pytest.mark.parametrize("columns", [1, 3, 200])
def test_any_number_of_columns_covers_the_circle(columns: int) -> None:
    strip = camera("tree-v1", columns).see(POSES[1])
    assert strip.shape == (1, columns, 3) and strip.min() > 0


def test_the_paint_follows_the_name_and_changes_nothing_else() -> None:
    apartment = load_maze("tree-v1").apartment
    boxes, before = apartment.boxes(), apartment.content_hash()
    found = painted(boxes, "tree-v1")
    assert found == painted(boxes, "tree-v1") != painted(boxes, "tree-v2")
    assert [replace(box, material=boxes[0].material) for box in found] == [
        replace(box, material=boxes[0].material) for box in boxes
    ]
    assert apartment.content_hash() == before


def test_the_paint_of_the_mazes_stays_as_it_is() -> None:
    """A maze never changes under its name, for a camera neither."""
    looks = [repr([box.material for box in painted(load_maze(name).apartment.boxes(), name)]) for name in MAZES]
    assert hashlib.sha256("".join(looks).encode()).hexdigest()[:16] == "b754a4d7ea952e57"


def test_noise_has_the_stated_deviation_and_repeats_by_seed() -> None:
    env = LidarMazeEnv("rooms-v1", sensor="camera", sensor_noise=StripNoise(std=8.0), beams=512, noise="none")
    first = env.reset(seed=1)[0]["strip"]
    again = env.reset(seed=1)[0]["strip"]
    np.testing.assert_array_equal(first, again)
    exact = camera("rooms-v1", 512).see(env.planar).astype(int)
    inside = (exact > 40) & (exact < 215)
    assert np.std((first - exact)[inside]) == pytest.approx(8.0, rel=0.1)
    with pytest.raises(InputError, match="std"):
        StripNoise(std=-1.0)


def test_the_environment_observes_the_strip_instead_of_the_scan() -> None:
    env = LidarMazeEnv("rings-v1", sensor="camera", sensor_noise="high", beams=32, render_mode="rgb_array")
    observation, _ = env.reset(seed=0)
    assert set(observation) == {"strip", "goal"} and env.observation_space.contains(observation)
    assert env.render().shape == (480, 480, 3)
    with pytest.raises(InputError, match="sensor"):
        LidarMazeEnv(sensor="sonar")
    with pytest.raises(InputError, match="sensor_noise"):
        LidarMazeEnv(sensor="camera", sensor_noise="kinect")


def test_a_traversal_by_camera_is_the_same_drive() -> None:
    maze = load_maze("serpentine-v1")
    seen, scanned = traverse(maze, 40, seed=2, sensor="camera"), traverse(maze, 40, seed=2)
    assert seen.images.shape == (41, 64, 3) and seen.images.dtype == np.uint8 and len(seen) == 41
    for name in ("motions", "poses", "angles"):
        np.testing.assert_array_equal(getattr(seen, name), getattr(scanned, name))
    np.testing.assert_array_equal(seen.path(), scanned.path())
    np.testing.assert_array_equal(errors(seen, seen.path()), errors(scanned, scanned.path()))
    assert np.abs(np.diff(seen.images.astype(int), axis=0)).max() > 20
