"""An imagined world: everything a step reads and nothing it changes, built once from a map and keywords."""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vssm_gym.envs.carnav import COLLISION_COST
from vssm_gym.envs.carnav import STEP_COST as CAR_STEP_COST
from vssm_gym.envs.carnav import SUCCESS_REWARD as CAR_SUCCESS_REWARD
from vssm_gym.envs.pointnav import STEP_COST, SUCCESS_REWARD
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.tasks.car import APART as CAR_APART
from vssm_gym.envs.tasks.car import GOAL_MARGIN, REACHED
from vssm_gym.envs.tasks.navigation import APART, SHORTEST, SUCCESS
from vssm_gym.envs.world_model.collision_map import Ground
from vssm_gym.envs.world_model.config import SOURCE, Imagination, noise_parameters
from vssm_gym.envs.world_model.goal_distance import Lattice, Ways
from vssm_gym.envs.world_model.motion import disc_radius
from vssm_gym.envs.world_model.tasks import Fit, Pool, draw_tasks
from vssm_gym.envs.world_model.view import View
from vssm_gym.errors import InputError
from vssm_gym.geometry.car import Car
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission_uncertainty import sample_map

UNKNOWN_COST = 0.05  # of a step in space that nothing observed, with unknown="penalised"


class Rules(eqx.Module):
    """Rewards and ends of the environment that the imagined one stands for: numbers, so that one compiled step serves
    all of them."""

    success_radius: float  # m
    dense: bool
    stops: bool  # whether an episode ends by the stop, or on arrival
    step_cost: float
    touch_cost: float
    success_reward: float
    unknown_cost: float


class World(eqx.Module):
    """Arrays of one imagined world."""

    rules: Rules
    ground: Ground
    ways: Ways
    pool: Pool
    view: View
    maps: int = eqx.field(static=True)  # of which an episode takes one
    noise: Float[Array, "2 parameters"]  # between which an episode draws its own
    low: Float[Array, "action"]  # of what a command may be
    high: Float[Array, "action"]
    start_std: Float[Array, "3"]  # m, m, rad
    pose_std: Float[Array, "3"]
    pose_memory: Float[Array, ""]
    max_steps: Int[Array, ""]  # 0: no limit


Robot = HolonomicRobot | Car


def robot_of(wanted: Imagination) -> Robot:
    """The robot that is imagined."""
    return Car() if wanted.robot == "car" else HolonomicRobot()


def _rules(wanted: Imagination, robot: Robot) -> Rules:
    dense, price = wanted.reward == "dense", UNKNOWN_COST if wanted.unknown == "penalised" else 0.0
    if isinstance(robot, Car):
        return Rules(REACHED, dense, False, CAR_STEP_COST, COLLISION_COST, CAR_SUCCESS_REWARD, price)
    radius, stops = SUCCESS * robot.body_length, wanted.end_on == "stop"
    return Rules(radius, dense, stops, STEP_COST, 0.0, SUCCESS_REWARD, price)


def build_world(source: Any, wanted: Imagination, robot: Robot, max_steps: int) -> World:
    """The world of a map: a file's path, or a :class:`VoxelMap`.

    Raises :class:`InputError` for what is no map, or one in which the robot finds no tasks.
    """
    m = _map(source)
    maps = [m]
    if wanted.map_samples:
        keys = jax.random.split(jax.random.key(wanted.pool_seed), wanted.map_samples)
        maps = [sample_map(key, m) for key in keys]
    camera = wanted.camera.intrinsics()  # type: ignore[union-attr]
    ground = Ground.of([m, *maps] if wanted.map_samples else maps, robot.height, wanted.unknown)
    lattice = Lattice(ground, _fit(robot).radius)
    pool, ways = draw_tasks(lattice, _fit(robot), wanted)
    if wanted.map_samples:  # tasks are those of the mean map; robots drive in the samples
        samples = ground.clearance.reshape(len(maps) + 1, -1)[1:]
        ground = eqx.tree_at(lambda g: g.clearance, ground, samples.reshape(-1))
    if wanted.observation == "scan":
        view = View.scan(maps, camera, robot.T_body_cam, wanted.max_depth)
    else:
        view = View.images(maps, camera, robot.T_body_cam, wanted.max_depth, wanted.observation == "rgbd")
    low = -robot.limits if isinstance(robot, Car) else np.array([-robot.max_turn, -robot.max_offset, 0.0])
    noise = [noise_parameters(one) for one in wanted.noise_range()]
    device = lambda values: jnp.asarray(values, jnp.float32)
    return World(
        rules=jax.tree.map(jnp.asarray, _rules(wanted, robot)),
        ground=ground,
        ways=ways,
        pool=pool,
        view=view,
        maps=len(maps),
        noise=device(noise),
        low=device(low),
        high=device(robot.limits),
        start_std=device(wanted.start_std),
        pose_std=device(wanted.pose_std),
        pose_memory=device(wanted.pose_memory),
        max_steps=jnp.asarray(max(0, max_steps), jnp.int32),
    )


def _fit(robot: Robot) -> Fit:
    if isinstance(robot, Car):
        # The rear axle's way is that of the largest disc around it inside the footprint; where a start or goal lies,
        # the car fits at every heading.
        inside = min(robot.rear_overhang, 0.5 * robot.width)
        reach = robot.center_forward + 0.5 * robot.length * (1.0 - 1.0 / 3.0) + disc_radius(robot)
        return Fit(inside, reach + GOAL_MARGIN, CAR_APART, REACHED, 0.0)
    return Fit(robot.radius, robot.radius, APART * robot.body_length, SUCCESS * robot.body_length, SHORTEST)


def _map(source: Any) -> VoxelMap:
    if isinstance(source, VoxelMap):
        return source
    if isinstance(source, str | Path):
        return VoxelMap.load(source)
    raise InputError(SOURCE, "map", f"a map file's path, or a VoxelMap; found {source!r:.80}")
