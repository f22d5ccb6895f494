"""Build an imagined world from a map and keywords: all arrays that a step reads and none that it changes."""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vssm_gym.envs.carnav import CARNAV_REWARD
from vssm_gym.envs.pointnav import POINTNAV_REWARD
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.tasks.car import GOAL_MARGIN
from vssm_gym.envs.tasks.car import TARGET_APART as CAR_APART
from vssm_gym.envs.tasks.navigation import GOAL_APART, SHORTEST, SUCCESS
from vssm_gym.envs.world_model.collision_map import CollisionMap
from vssm_gym.envs.world_model.config import SOURCE, Imagination, noise_parameters
from vssm_gym.envs.world_model.goal_distance import GoalDistances, Lattice
from vssm_gym.envs.world_model.motion import disc_radius, standing_drives
from vssm_gym.envs.world_model.tasks import TaskLimits, TaskPool, draw_tasks
from vssm_gym.envs.world_model.view import ImaginedCamera
from vssm_gym.errors import InputError
from vssm_gym.geometry.car import GOAL_RADIUS, Car
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.map_samples import sample_map
from vssm_gym.model.transition.learned import LearnedTransition

UNKNOWN_COST = 0.05  # reward lost in a step in unobserved space, with unknown="penalised"


class Rules(eqx.Module):
    """Hold the rewards and ends of the imagined environment as numbers, so that one compiled step serves all."""

    success_radius: float  # m
    dense: bool
    stops: bool  # whether an episode ends by the stop, or on arrival
    step_cost: float
    collision_cost: float
    success_reward: float
    unknown_cost: float


class ImaginedWorld(eqx.Module):
    """Hold the arrays of one imagined world."""

    rules: Rules
    collision_map: CollisionMap
    goal_distances: GoalDistances
    pool: TaskPool
    view: ImaginedCamera
    maps: int = eqx.field(static=True)  # number of maps, of which an episode takes one
    noise: Float[Array, "2 parameters"]  # ends of the range that episodes draw from
    transition: LearnedTransition | None  # that moves the robots; None: the law of the robot's kind
    standing: Float[Array, "draws d"]  # inner states of a drive whose robot stands
    low: Float[Array, "action"]  # least and largest command
    high: Float[Array, "action"]
    start_std: Float[Array, "3"]  # m, m, rad
    pose_std: Float[Array, "3"]
    pose_memory: Float[Array, ""]
    max_steps: Int[Array, ""]  # 0: no limit


Robot = HolonomicRobot | Car


def robot_of(config: Imagination) -> Robot:
    """Return the robot that is imagined."""
    return Car() if config.robot == "car" else HolonomicRobot()


def _rules(config: Imagination, robot: Robot) -> Rules:
    dense, unknown_cost = config.reward == "dense", UNKNOWN_COST if config.unknown == "penalised" else 0.0
    if isinstance(robot, Car):
        radius, stops, weights = GOAL_RADIUS, False, CARNAV_REWARD
    else:
        radius, stops, weights = SUCCESS * robot.body_length, config.end_on == "stop", POINTNAV_REWARD
    return Rules(radius, dense, stops, weights.step_cost, weights.collision_cost, weights.success, unknown_cost)


def build_world(source: Any, config: Imagination, robot: Robot, max_steps: int) -> ImaginedWorld:
    """Build the world of ``source``, a map file's path or a :class:`VoxelMap`.

    Raises :class:`InputError` for what is not a map, or a map in which the robot has no tasks.
    """
    m = _map(source)
    maps = [m]
    if config.map_samples:
        keys = jax.random.split(jax.random.key(config.pool_seed), config.map_samples)
        maps = [sample_map(key, m) for key in keys]
    camera = config.camera.intrinsics()  # type: ignore[union-attr]
    collision_map = CollisionMap.of([m, *maps] if config.map_samples else maps, robot.height, config.unknown)
    lattice = Lattice(collision_map, _task_limits(robot).radius)
    pool, goal_distances = draw_tasks(lattice, _task_limits(robot), config)
    if config.map_samples:  # tasks are those of the mean map; robots drive in the samples
        samples = collision_map.clearance.reshape(len(maps) + 1, -1)[1:]
        collision_map = eqx.tree_at(lambda g: g.clearance, collision_map, samples.reshape(-1))
    if config.observation == "scan":
        view = ImaginedCamera.scan(maps, camera, robot.T_body_cam, config.max_depth)
    else:
        view = ImaginedCamera.images(maps, camera, robot.T_body_cam, config.max_depth, config.observation == "rgbd")
    transition = config.learned()
    low = -robot.limits if isinstance(robot, Car) else np.array([-robot.max_turn, -robot.max_offset, 0.0])
    noise = [noise_parameters(one) for one in config.noise_range()]
    device = lambda values: jnp.asarray(values, jnp.float32)
    return ImaginedWorld(
        rules=jax.tree.map(jnp.asarray, _rules(config, robot)),
        collision_map=collision_map,
        goal_distances=goal_distances,
        pool=pool,
        view=view,
        maps=len(maps),
        noise=device(noise),
        transition=transition,
        standing=standing_drives(transition, robot.dt),
        low=device(low),
        high=device(robot.limits),
        start_std=device(config.start_std),
        pose_std=device(config.pose_std),
        pose_memory=device(config.pose_memory),
        max_steps=jnp.asarray(max(0, max_steps), jnp.int32),
    )


def _task_limits(robot: Robot) -> TaskLimits:
    if isinstance(robot, Car):
        # Paths of the rear axle are those of the largest disc around it inside the footprint; at a start or goal the
        # car is free at every heading.
        inside = min(robot.rear_overhang, 0.5 * robot.width)
        reach = robot.center_forward + 0.5 * robot.length * (1.0 - 1.0 / 3.0) + disc_radius(robot)
        return TaskLimits(inside, reach + GOAL_MARGIN, CAR_APART, GOAL_RADIUS, 0.0)
    return TaskLimits(robot.radius, robot.radius, GOAL_APART * robot.body_length, SUCCESS * robot.body_length, SHORTEST)


def _map(source: Any) -> VoxelMap:
    """Return the map, read where it is a file."""
    if isinstance(source, VoxelMap):
        return source
    if isinstance(source, str | Path):
        return VoxelMap.load(source)
    raise InputError(SOURCE, "map", f"a map file's path, or a VoxelMap; found {source!r:.80}")
