"""Test the motion of imagined robots: the simulator's laws of noise, servos, and distances to goals."""

import jax.numpy as jnp
import numpy as np
import pytest
import shapely

from tests.helpers.imagined_room import CUPBOARD, FLOOR, TABLE, room
from vssm_gym.envs.robots import NOISE_LEVELS, HolonomicRobot, execute
from vssm_gym.envs.robots.car_noise import CarActuators, CarNoise
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.tasks.geodesic import Geodesics
from vssm_gym.envs.tasks.navigation import GOAL_APART, SHORTEST, SUCCESS
from vssm_gym.envs.world_model.collision_map import CollisionMap
from vssm_gym.envs.world_model.config import Imagination
from vssm_gym.envs.world_model.goal_distance import Lattice
from vssm_gym.envs.world_model.motion import _follow, estimated_pose
from vssm_gym.envs.world_model.tasks import TaskLimits, draw_tasks
from vssm_gym.model.transition import PLANAR, MotionNoise, Planar

RADIUS = HolonomicRobot().radius


class Listed:
    """Return given standard normals in place of a random stream."""

    def __init__(self, values: np.ndarray) -> None:
        self.values = values

    def standard_normal(self, size: int) -> np.ndarray:
        return self.values[:size]


@pytest.mark.parametrize("level", NOISE_LEVELS)
def test_a_noisy_step_equals_the_simulators(level):
    """The same normals give the same pose, for turns to both sides, no turn, short steps and no step."""
    rng = np.random.default_rng(0)
    n = 200
    limits = HolonomicRobot().limits
    commands = rng.uniform([-1.0, -1.0, 0.0], 1.0, (n, 3)) * limits
    commands[::5, 0], commands[::7, 2] = 0.0, 0.0
    poses = rng.uniform([-3.0, -3.0, -np.pi], [3.0, 3.0, np.pi], (n, 3))
    normals = rng.standard_normal((n, 2))
    noise = NOISE_LEVELS[level]
    expected = [
        execute(pose, command, noise, Listed(normal))  # type: ignore[arg-type]
        for pose, command, normal in zip(poses, commands, normals, strict=True)
    ]
    robots = Planar(MotionNoise(jnp.full(n, noise.turn), jnp.full(n, noise.step)))
    found = np.asarray(robots.executed(*(jnp.asarray(a, jnp.float32) for a in (poses, commands, normals))))
    np.testing.assert_allclose(found[:, :2], np.array(expected)[:, :2], atol=2e-6)
    turned = np.remainder(found[:, 2] - np.array(expected)[:, 2] + np.pi, 2 * np.pi) - np.pi
    np.testing.assert_allclose(turned, 0.0, atol=2e-6)


def test_a_servos_lag_equals_the_simulators():
    """The set point after a step, and its mean, against ticks of 10 ms."""
    actuators = CarActuators(CarNoise(speed_lag=0.2, steering_lag=0.12), np.random.default_rng(0))
    speed = steering = jnp.zeros(1)
    for aim in (0.6, 0.6, -0.3):
        points, _ = actuators(np.array([aim, aim]), 0.4, 0.1)
        speed, mean = _follow(speed, jnp.array([aim]), jnp.array([0.2]), 0.1)
        steering, _ = _follow(steering, jnp.array([0.4]), jnp.array([0.12]), 0.1)
        assert float(speed[0]) == pytest.approx(points[-1, 0], abs=1e-5)
        assert float(steering[0]) == pytest.approx(points[-1, 1], abs=1e-5)
        assert float(mean[0]) == pytest.approx(points[:, 0].mean(), abs=0.03 * 0.9)  # half a tick of the fastest change


def test_the_estimate_errs_in_the_body_frame():
    """``T exp(e)`` up to the curvature of a small turn."""
    rng = np.random.default_rng(1)
    planar, error = rng.uniform(-2.0, 2.0, (50, 3)), 0.02 * rng.standard_normal((50, 3))
    planar, error = (jnp.asarray(a, jnp.float32) for a in (planar, error))
    np.testing.assert_allclose(
        np.asarray(estimated_pose(planar, error)), np.asarray(PLANAR.perturb(planar, error)), atol=2e-3
    )


@pytest.fixture(scope="module")
def lattice() -> Lattice:
    return Lattice(CollisionMap.of([room()], HolonomicRobot().height, "blocked"), RADIUS)


def test_goal_distances_are_geodesics_of_the_true_room(lattice):
    """They are within 3 % and two cells of the exact visibility graph, from everywhere in the room."""
    named = [("cupboard", CUPBOARD), ("table", TABLE)]
    exact = Geodesics(FreeSpace("room", FLOOR, named, RADIUS, {"room": FLOOR}))
    goals = np.array([[1.0, 2.5], [4.2, 2.4], [4.7, 0.3]])
    distances = lattice.goal_distances(goals)
    rng = np.random.default_rng(2)
    xy = rng.uniform([0.2, 0.2], [4.8, 2.8], (200, 2))
    solid = shapely.union_all([CUPBOARD, TABLE])
    xy = xy[shapely.distance(solid, shapely.points(xy)) > 0.15]
    for number, goal in enumerate(goals):
        found = distances.at(jnp.full(len(xy), number), *(jnp.asarray(xy[:, a], jnp.float32) for a in (0, 1)))
        expected = np.array([exact.length(p, goal) for p in xy])
        off = np.asarray(found) - expected
        assert (off > -0.05).all() and (off < 0.03 * expected + 0.2).all()


def test_drawn_tasks_keep_the_rules(lattice):
    robot = HolonomicRobot()
    limits = TaskLimits(RADIUS, RADIUS, GOAL_APART * robot.body_length, SUCCESS * robot.body_length, SHORTEST)
    pool, distances = draw_tasks(lattice, limits, Imagination(pool=100, goals=8))
    assert int(pool.count) == 100 and len(pool.goal) == 128
    start, goal = np.asarray(pool.start)[:100], np.asarray(distances.goals)[np.asarray(pool.goal)[:100]]
    assert (np.linalg.norm(start[:, :2] - goal, axis=1) > 0.6).all()
    assert (np.asarray(pool.geodesic)[:100] >= 1.4).all()
    for xy in (start[:, :2], goal):
        assert (lattice.clearance(xy) >= 0.12 - 1e-5).all() and lattice.known(xy).all()
    again, _ = draw_tasks(lattice, limits, Imagination(pool=100, goals=8))
    np.testing.assert_array_equal(np.asarray(again.start), np.asarray(pool.start))
