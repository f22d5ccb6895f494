"""Test the bumper: the side of the robot that met an obstacle, from the simulators' own contacts."""

import math

import gymnasium as gym
import numpy as np
import pytest

import vssm_gym  # noqa: F401  (registers the environments)
from tests.helpers.box_rooms import two_rooms
from tests.helpers.car_worlds import yard
from vssm_gym.envs.physics import FloorWorld, obstacles
from vssm_gym.envs.physics.planar import clearance, rectangles
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.sensors.base import GroundBody
from vssm_gym.envs.sensors.bumper import BumperConfig, BumperSensor
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import wrap_angle

ROBOT = HolonomicRobot()
FRONT, LEFT, REAR, RIGHT = range(4)


def closed(bearings: list[float], sectors: int = 4) -> list[int]:
    """Return the switches that obstacles in these directions close."""
    body = GroundBody.at(np.zeros(3), np.eye(4), 0.2, np.array(bearings, float))
    sensor = BumperSensor(BumperConfig(sectors))
    reading = sensor.measure(body)["bumper"]
    assert sensor.spaces["bumper"].contains(reading)
    return np.flatnonzero(reading).tolist()


def test_sectors_are_counted_from_ahead_counter_clockwise() -> None:
    assert closed([]) == []
    assert closed([0.0]) == [FRONT] and closed([math.pi / 2]) == [LEFT]
    assert closed([math.pi]) == closed([-math.pi]) == [REAR] and closed([-math.pi / 2]) == [RIGHT]
    assert closed([0.1, -1.5, -0.1]) == [FRONT, RIGHT]
    for sectors in (1, 3, 8, 64):
        for k in range(sectors):
            assert closed([2.0 * math.pi * k / sectors], sectors) == [k]


@pytest.mark.parametrize("sectors", [0, 65, True, 2.0, "many"])
def test_impossible_sectors_are_refused(sectors: object) -> None:
    with pytest.raises(InputError, match="BumperConfig: sectors"):
        BumperConfig(sectors)  # type: ignore[arg-type]


@pytest.mark.parametrize("heading", np.linspace(-math.pi, math.pi, 9)[:-1])
def test_contacts_point_at_the_wall(heading: float) -> None:
    """A robot that is pushed east against a wall has the obstacle east of it, for every heading."""
    world = FloorWorld(two_rooms(), ROBOT)  # the west room is [0.05, 2.95] x [0.05, 3.95]
    world.reset(np.array([2.80, 0.7, heading]))
    assert len(world.contact_bearings()) == 0
    assert world.drive(np.array([2.90, 0.7, heading + 0.1]))
    bearings = world.contact_bearings()
    assert len(bearings) and np.all(np.abs(wrap_angle(bearings + heading + 0.05)) <= 0.05 + 1e-9)
    assert world.drive(np.array([2.5, 0.7, heading]))  # it parts from the wall: contacts first, and then none
    parting = world.contact_bearings()
    assert len(parting) and np.all(np.abs(wrap_angle(parting + heading)) < 0.2)
    assert not world.drive(np.array([2.4, 0.7, heading])) and len(world.contact_bearings()) == 0
    assert world.drive(np.array([2.90, 0.7, heading]))
    world.reset(np.array([1.0, 0.7, heading]))
    assert len(world.contact_bearings()) == 0


def test_among_furniture_every_collision_has_a_direction_that_leads_to_an_obstacle() -> None:
    """In hundreds of collisions, some point of the path has a box at one radius along the bearing."""
    apartment, rng = load_scene("oak"), np.random.default_rng(0)
    world, space = FloorWorld(apartment, ROBOT), FreeSpace.from_apartment(apartment, ROBOT.radius, ROBOT.height)
    boxes = apartment.boxes()
    walls = rectangles([boxes[i] for i in obstacles(boxes, ROBOT.height)])
    met = 0
    for start in space.sample(rng, 60, 0.0):
        heading = rng.uniform(-math.pi, math.pi)
        world.reset(np.array([*start, heading]))
        for step in [*[0.04] * 30, *[0.16] * 15]:
            before = world.pose()[:2]
            aim = before + step * np.array([math.cos(heading), math.sin(heading)])
            collision = world.drive(np.array([*aim, heading]))
            bearings = world.contact_bearings()
            assert collision == bool(len(bearings))
            met += collision
            path = np.linspace(before, world.pose()[:2], 33)
            for angle in np.unique(np.round(heading + bearings, 3)):
                edge = path + ROBOT.radius * np.array([math.cos(angle), math.sin(angle)])
                assert min(clearance(*point, walls) for point in edge) < 0.5 * step
    assert met > 500


def walk(env: gym.Env, actions: np.ndarray) -> tuple[int, int]:
    """Drive steps with and without a collision; in each of them the bumper agrees with ``info``."""
    observation, info = env.reset(seed=1)
    met = free = 0
    for action in actions:
        assert observation["bumper"].any() == info["collision"]
        met, free = met + info["collision"], free + (not info["collision"])
        observation, _, terminated, _, info = env.step(action)
        if terminated:
            observation, info = env.reset()
    return met, free


@pytest.mark.parametrize("name", ["PointNav", "ImageNav", "Explore"])
def test_the_robots_bumper_closes_on_collisions_only(name: str) -> None:
    env = gym.make(
        f"vssm_gym/{name}-v0", scene=two_rooms(), camera={"width": 32, "height": 24}, noise="high", sensors=["bumper"]
    )
    rng = np.random.default_rng(0)
    actions = rng.uniform(env.action_space.low, env.action_space.high, (150, 4)).astype(np.float32) * [1, 1, 1, 0]
    met, free = walk(env, actions)
    assert met > 5 and free > 5


# From the middle of a yard of 3 x 3 m, straight ahead or astern into a wall; sideways along one it is scraped.
CRASHES = [
    ((1.5, 1.5, 0.0), 0.5, [FRONT]),
    ((1.5, 1.5, 0.4), 0.5, [FRONT]),
    ((1.5, 1.5, -0.3), -0.5, [REAR]),
    ((0.8, 2.8, 0.05), 0.5, [LEFT]),
    ((0.8, 0.2, -0.05), 0.5, [RIGHT]),
]


@pytest.mark.parametrize("physics", ["mujoco", "bullet"])
@pytest.mark.parametrize(("start", "speed", "expected"), CRASHES)
def test_the_cars_bumper_shows_the_side_of_the_wall(physics: str, start: tuple, speed: float, expected: list) -> None:
    if physics == "bullet":
        pytest.importorskip("pybullet", reason="the bullet extra is not installed")
    env = gym.make(
        "vssm_gym/CarNav-v0", scene=yard(3.0, 3.0), noise="none", images=False, physics=physics, sensors=["bumper"]
    )
    task = env.unwrapped.sampler.task(start, (1.5, 1.0, 1.0))
    observation, info = env.reset(seed=0, options={"task": task})
    first: list[int] = []
    for _ in range(60):
        switches = np.flatnonzero(observation["bumper"]).tolist()
        assert bool(switches) == info["collision"]
        first = first or switches
        observation, _, terminated, _, info = env.step(np.array([speed, 0.0], np.float32))
        assert not terminated
    assert first == expected
    env.close()
