"""Step many imagined robots in one compiled program: move, evaluate, restart ended episodes, observe.

    e' = rho e + sqrt(1 - rho^2) n,  n ~ N(0, pose_std^2)          error of the pose estimate, (forward, left, turn)

A robot at T has the pose estimate ``T exp(e)``. The error begins at ``e ~ N(0, start_std^2)``, the belief about the
start, and tends to ``N(0, pose_std^2)``, the error of a tracker. Goals are observed relative to the estimate.

Every robot has a random stream of its own: draw number i is ``threefry(key, i)``, one a step and one a restart,
for all commands and numbers of robots.
"""

from functools import cache, partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vssm_gym.envs.world_model.goal_distance import REACHABLE_DISTANCE
from vssm_gym.envs.world_model.motion import (
    Aim,
    Motion,
    aim_by_learned,
    aim_by_servos,
    block_car,
    estimated_pose,
    slide_disc,
)
from vssm_gym.envs.world_model.world import ImaginedWorld, Robot
from vssm_gym.geometry.car import Car
from vssm_gym.model.transition import Bicycle, MotionNoise, Planar

MOTION_NORMALS = 2  # a step, of a robot whose law is written down; a learned law has one for each of its errors


class BatchState(eqx.Module):
    """Hold the state of n robots."""

    key: Array  # (n, 2) uint32
    draws: Int[Array, "n"]  # taken from the stream
    planar: Float[Array, "n 3"]  # x, y (m), heading (rad)
    error: Float[Array, "n 3"]  # of the estimate: forward, left (m), turn (rad)
    variance: Float[Array, "n 3"]  # of that error
    drive: Float[Array, "n d"]  # inner state of the drive: servos of a car, the rest of a learned transition
    noise: Float[Array, "n parameters"]  # of this episode
    which: Int[Array, "n"]  # map of this episode
    task: Int[Array, "n"]  # of the pool
    potential: Float[Array, "n"]  # m to the goal; more than REACHABLE_DISTANCE where that is not known
    steps: Int[Array, "n"]  # of this episode
    ended: Bool[Array, "n"]


class Outcome(eqx.Module):
    """Hold what a step returns in addition to the new state."""

    observation: dict[str, Array]
    reward: Float[Array, "n"]
    terminated: Bool[Array, "n"]
    truncated: Bool[Array, "n"]
    success: Bool[Array, "n"]
    collision: Bool[Array, "n"]
    command: Float[Array, "n command"]  # as clipped
    begun: Bool[Array, "n"]  # whether this step began an episode and ignored its action


def empty_state(world: ImaginedWorld, n: int) -> BatchState:
    """Return the state of n robots before their first episode."""
    zeros = lambda *shape: jnp.zeros((n, *shape), jnp.float32)
    count = lambda: jnp.zeros(n, jnp.int32)  # one array each: the step donates the memory of all
    drive = zeros(world.standing.shape[1])
    return BatchState(
        jnp.zeros((n, 2), jnp.uint32), count(), zeros(3), zeros(3), zeros(3), drive, zeros(world.noise.shape[1]),
        count(), count(), zeros(), count(), jnp.ones(n, bool),
    )  # fmt: skip


def step(
    robot: Robot, world: ImaginedWorld, state: BatchState, action: Float[Array, "n action"]
) -> tuple[BatchState, Outcome]:
    """Carry out ``action``; robots whose episode has ended begin their next one instead, with reward 0."""
    begun, rules = state.ended, world.rules
    keys = jax.vmap(jax.random.fold_in)(state.key, state.draws)
    errors = MOTION_NORMALS if world.transition is None else len(world.transition.manifold.turns)
    normal = jax.vmap(lambda key: jax.random.normal(key, (errors + 3,)))(keys)
    moved, stopped, command = _act(robot, world, state, action, normal[:, :errors])
    rho, spread = world.pose_memory, 1.0 - world.pose_memory**2
    after = BatchState(
        state.key, state.draws + 1, moved.planar,
        rho * state.error + jnp.sqrt(spread) * world.pose_std * normal[:, errors:],
        rho**2 * state.variance + spread * world.pose_std**2,
        moved.drive, state.noise, state.which, state.task, state.potential, state.steps + 1, state.ended,
    )  # fmt: skip
    goal = world.goal_distances.goals[world.pool.goal[state.task]]
    arrived = jnp.hypot(*(moved.planar[:, :2] - goal).T) <= rules.success_radius
    terminated = jnp.where(rules.stops, stopped, arrived) & ~begun
    truncated = (world.max_steps > 0) & (after.steps >= world.max_steps) & ~begun
    success = terminated & arrived
    reward, potential = _reward(world, after, success, moved.collision)
    after = eqx.tree_at(lambda s: (s.potential, s.ended), after, (potential, terminated | truncated))
    # A branch, because most steps begin nothing
    after = jax.lax.cond(
        jnp.any(begun), lambda s: _where(begun, begin(robot, world, state, None), s), lambda s: s, after
    )
    return after, Outcome(
        observe(world, after),
        jnp.where(begun, 0.0, reward),
        terminated,
        truncated,
        success,
        moved.collision & ~begun,
        jnp.where(begun[:, None], 0.0, command),
        begun,
    )


def begin(robot: Robot, world: ImaginedWorld, state: BatchState, task: Int[Array, "n"] | None) -> BatchState:
    """Begin episodes of all robots; map, noise, start and each ``task`` that is not given (>= 0) are drawn."""
    keys = jax.vmap(jax.random.fold_in)(state.key, state.draws)
    share, normal = jax.vmap(lambda key: (jax.random.uniform(key, (3,)), jax.random.normal(key, (8,))[3:]))(keys)
    drawn = jnp.minimum((share[:, 0] * world.pool.count).astype(jnp.int32), world.pool.count - 1)
    task = drawn if task is None else jnp.where(task >= 0, task, drawn)
    which = jnp.minimum((share[:, 1] * world.maps).astype(jnp.int32), world.maps - 1)
    noise = world.noise[0] + share[:, 2:] * (world.noise[1] - world.noise[0])
    start = world.pool.start[task]
    # The true start is off the task's start by -e: the pose estimate then is the task's start exactly.
    error = normal[:, :3] * world.start_std
    heading = start[:, 2] - error[:, 2]
    c, s = jnp.cos(heading), jnp.sin(heading)
    x, y = start[:, 0] - c * error[:, 0] + s * error[:, 1], start[:, 1] - s * error[:, 0] - c * error[:, 1]
    planar = estimated_pose(jnp.stack([x, y, heading], axis=-1), jnp.zeros_like(error))
    drive = world.standing[jax.vmap(lambda key: _any_of(world.standing, key))(keys)]
    if isinstance(robot, Car) and world.transition is None:
        trim = noise[:, 3] * normal[:, 4]
        drive = jnp.stack([jnp.zeros_like(trim), trim, 1.0 + noise[:, 2] * normal[:, 3], trim], axis=-1)
    zero, variance = jnp.zeros_like(which), jnp.broadcast_to(world.start_std**2, error.shape)
    potential = world.goal_distances.at(world.pool.goal[task], x, y)
    return BatchState(
        state.key, state.draws + 1, planar, error, variance, drive, noise, which, task, potential, zero,
        jnp.zeros_like(state.ended),
    )  # fmt: skip


def restart(
    robot: Robot,
    world: ImaginedWorld,
    state: BatchState,
    shown: dict[str, Array],
    index: Int[Array, "w"],
    task: Int[Array, "w"],
) -> tuple[BatchState, dict[str, Array]]:
    """Begin episodes of the robots ``index``; the others are unchanged, and numbers beyond the last do nothing."""
    some = jax.tree.map(lambda a: a.at[index].get(mode="clip"), state)
    some = begin(robot, world, some, task)
    put = lambda a, b: a.at[index].set(b, mode="drop")
    return jax.tree.map(put, state, some), jax.tree.map(put, shown, observe(world, some))


class Programs(NamedTuple):
    """Hold the compiled programs."""

    step: Any
    restart: Any


@cache
def programs(one_core: bool) -> Programs:
    """Compile :func:`step`, which donates the memory of the state, and :func:`restart`."""
    # Wider vectors are a quarter faster, but for one robot XLA of jaxlib 0.10 then computes wrong scans.
    options = {"xla_cpu_multi_thread_eigen": False} if one_core else None
    compiled = partial(jax.jit, static_argnums=0, compiler_options=options)
    return Programs(compiled(step, donate_argnums=2), compiled(restart))


def observe(world: ImaginedWorld, state: BatchState) -> dict[str, Array]:
    """Observe images or scans from the true poses, and ``goal``, ``pose`` and ``pose_std`` of the pose estimates."""
    shown = world.view(state.which, state.planar)
    pose = estimated_pose(state.planar, state.error)
    away = world.goal_distances.goals[world.pool.goal[state.task]] - pose[:, :2]
    bearing = jnp.arctan2(away[:, 1], away[:, 0]) - pose[:, 2]
    shown["goal"] = jnp.stack([jnp.hypot(away[:, 0], away[:, 1]), jnp.cos(bearing), jnp.sin(bearing)], axis=-1)
    shown["pose"] = pose
    shown["pose_std"] = jnp.sqrt(state.variance)
    return shown


def _act(
    robot: Robot, world: ImaginedWorld, state: BatchState, action: Array, normal: Array
) -> tuple[Motion, Bool[Array, "n"], Float[Array, "n command"]]:
    """Carry out the commands; return the motion, which robots stopped, and the clipped commands."""
    command = jnp.clip(action[:, : len(world.low)], world.low, world.high)
    stopped = jnp.zeros(len(command), bool)
    if not isinstance(robot, Car):
        stopped = (action[:, 3] > 0.5) & world.rules.stops
        command = jnp.where(stopped[:, None], 0.0, command)  # a stop carries out nothing else
    if world.transition is not None:
        aim = aim_by_learned(state.planar, command, state.drive, normal, world.transition, robot.dt)
        aim = Aim(jnp.where(stopped[:, None], state.planar, aim.planar), aim.drive)
    elif isinstance(robot, Car):
        bicycle = Bicycle(wheelbase=robot.wheelbase)
        aim = aim_by_servos(state.planar, command, state.drive, state.noise, normal, bicycle, robot.dt)
    else:
        planar = Planar(MotionNoise(state.noise[:, 0], state.noise[:, 1]))
        aim = Aim(planar.executed(state.planar, command, normal), state.drive)
    if isinstance(robot, Car):
        standing = world.standing[:1] if world.transition is not None else aim.drive.at[:, 0].set(0.0)
        moved = block_car(world.collision_map, state.which, state.planar, aim, standing, robot)
    else:
        moved = slide_disc(world.collision_map, state.which, state.planar, aim, robot.radius)
    return moved, stopped, command


def _reward(
    world: ImaginedWorld, state: BatchState, success: Array, collision: Array
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """Return the reward of the step that led to ``state``, and the new potential."""
    rules = world.rules
    prize = rules.success_reward * success
    lost = rules.unknown_cost * ~world.collision_map.known_at(state.planar[:, 0], state.planar[:, 1])
    now = world.goal_distances.at(world.pool.goal[state.task], state.planar[:, 0], state.planar[:, 1])
    # Squeezed between obstacles a robot may be off the grid of free positions: it gains nothing until it is back.
    held = (now > REACHABLE_DISTANCE) | (state.potential > REACHABLE_DISTANCE)
    gained = jnp.where(held, 0.0, state.potential - now)
    potential = jnp.where(now > REACHABLE_DISTANCE, state.potential, now)
    dense = gained - rules.step_cost - rules.collision_cost * collision
    return jnp.where(rules.dense, dense, 0.0) + prize - lost, potential


def _any_of(drives: Float[Array, "draws d"], key: Array) -> Int[Array, ""]:
    """Return the number of one of several drives."""
    return jax.random.randint(jax.random.fold_in(key, 1), (), 0, len(drives))


def _where(mask: Bool[Array, "n"], a: BatchState, b: BatchState) -> BatchState:
    pick = lambda x, y: jnp.where(mask.reshape(-1, *[1] * (x.ndim - 1)), x, y)
    return jax.tree.map(pick, a, b)
