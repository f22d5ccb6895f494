"""CarNav in a sweep: a chain of target poses, its environment, and one episode of it (SPEC 7)."""

import time
from functools import lru_cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from vssm_gym.agents.base import Agent, AgentContext, Decision
from vssm_gym.envs.car_task_sets import CarTaskSet, load, make_car_tasks, save
from vssm_gym.envs.car_tasks import ALIGNED, REACHED, CarTask
from vssm_gym.envs.scene import Apartment
from vssm_gym.eval.config import Condition, Episode, episode_seed
from vssm_gym.eval.episode import estimates_of, latency_of, thinned, trace_of
from vssm_gym.eval.failure import failure_reason
from vssm_gym.eval.metrics import episode_metrics
from vssm_gym.planning import reeds_shepp
from vssm_gym.voxel_map import VoxelMap

# What agents that track are told of how the car strays from the bicycle in a step: rad and m.
STRAYS = (0.02, 0.01)
MOVING = 0.05  # m/s, of a command: slower is standing, for the count of direction changes


def write_tasks(apartment: Apartment, n: int, path: Path) -> None:
    """A chain of ``n`` test targets of a scene as a file; one that is there and as long is kept."""
    if path.is_file() and len(load(path, apartment).tasks) >= n:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    save(make_car_tasks(apartment, n), path)


def run(episode: Episode, agent: Agent, task_file: Path, voxel_map: VoxelMap | None) -> dict[str, Any]:
    """Run one episode; returns what it was worth."""
    tasks = _tasks(task_file)
    env = _env(episode.condition, agent.needs_pose)
    seed = episode_seed(episode.seed, tasks.scene_hash, episode.task)
    return run_episode(env, agent, tasks.tasks[episode.task], seed=seed, voxel_map=voxel_map)


def run_episode(env: gym.Env, agent: Agent, task: CarTask, *, seed: int, voxel_map: VoxelMap | None) -> dict[str, Any]:
    """Run ``agent`` on ``task`` until the car is there, time is out, or the agent refuses it.

    Args:
        env: CarNav with its time limit; the pose is observed if and only if the agent needs it.
        agent: any agent of the registry that drives a car; it is reset here.
        task: start and target pose.
        seed: of the environment's streams and, mixed, of the agent; the same for every agent.
        voxel_map: the learned map.

    Returns:
        The metrics of :func:`episode_metrics`, with the length of the shortest Reeds-Shepp curve into the target's
        region, obstacles apart, as ``geodesic``; ``touches`` (times the car came to touch something), ``touched``,
        ``seconds``, ``direction_changes``, ``heading_error`` (rad); ``failure``, ``status``, latencies, ``trace`` (its
        ``poses`` with headings).
    """
    observation, info = env.reset(seed=seed, options={"task": task})
    world: Any = env.unwrapped
    context = _context(world, info, voxel_map)
    agent.reset(context, observation, int(np.random.SeedSequence([seed, 1]).generate_state(1)[0]))
    poses, contacts, speeds = [world.planar], [], []
    decisions: list[Decision] = []
    seconds: list[float] = []
    ended = False
    while not ended:
        began = time.perf_counter()
        decision = agent.act(observation)
        seconds.append(time.perf_counter() - began)
        decisions.append(decision)
        if decision.gives_up:
            break
        observation, _, terminated, truncated, info = env.step(decision.action)
        ended = terminated or truncated
        poses.append(world.planar)
        contacts.append(bool(info["collision"]))
        speeds.append(float(info["control"][0]))

    path, goal, contact = np.array(poses), np.array(task.goal), np.array(contacts, dtype=bool)
    estimates = estimates_of(decisions, stopped=decisions[-1].gives_up)
    estimates = None if estimates is None else estimates[: len(path)]
    success = bool(info.get("success", False))
    radius = context.car.turning_radius if context.car else 0.0
    metrics = episode_metrics(
        success=success,
        geodesic=shortest_curve(np.array(task.start), goal, radius),
        remaining=0.0 if success else shortest_curve(path[-1], goal, radius),
        positions=path[:, :2],
        goal=goal[:2],
        contacts=contact,
        estimates=estimates,
    )
    failure = failure_reason(
        stopped=False,
        statuses=[decision.status for decision in decisions],
        positions=path[:, :2],
        estimates=estimates,
        goal=goal[:2],
        contacts=contact,
        body_length=context.body_length,
    )
    if decisions[-1].gives_up:
        failure = f"planner: {decisions[-1].status}"
    return {
        **metrics,
        "touches": int(info["touches"]),
        "touched": bool(info["touches"]),
        "seconds": round(len(contacts) * context.dt, 3),
        "direction_changes": direction_changes(np.array(speeds)),
        "heading_error": task.turn(path[-1]),
        "failure": None if success else failure,
        "status": decisions[-1].status,
        "latency": latency_of(decisions, seconds),
        "end_on": "reach",
        "tracer": world.renderer_name,
        "success_radius": context.success_radius,
        "goal": [float(v) for v in goal],
        "trace": {**trace_of(path[:, :2], estimates, contact), "poses": thinned(path)},
    }


def shortest_curve(start: np.ndarray, goal: np.ndarray, radius: float) -> float:
    """Length (m) of the shortest Reeds-Shepp curve from a pose into a target's region: to 4 mm, no car drives less.

    Over a lattice of the region; at least a millimetre, so that ratios stay finite.
    """
    r, angle = np.meshgrid(np.array([0.0, 0.5, 1.0]) * REACHED, np.linspace(-np.pi, np.pi, 13)[:-1], indexing="ij")
    offsets = np.stack([r * np.cos(angle), r * np.sin(angle)], axis=-1).reshape(-1, 2)
    turns = np.linspace(-ALIGNED, ALIGNED, 5) if len(goal) == 3 else np.linspace(-np.pi, np.pi, 25)[:-1]
    heading = goal[2] if len(goal) == 3 else 0.0
    places = np.concatenate([goal[:2] + offsets], axis=0)
    goals = np.array([(*place, heading + turn) for place in places for turn in turns])
    starts = np.broadcast_to(start, goals.shape)
    return max(1e-3, float(reeds_shepp.length(starts, goals, radius).min()))


def direction_changes(speeds: np.ndarray) -> int:
    """How often a drive turns from forwards to backwards or the other way, standing in between or not."""
    signs = np.sign(speeds[np.abs(speeds) > MOVING])
    return int(np.count_nonzero(np.diff(signs)))


def _context(world: Any, info: dict[str, Any], voxel_map: VoxelMap | None) -> AgentContext:
    car = world.car
    return AgentContext(
        K=np.array(info["K"]),
        camera=(world.camera.width, world.camera.height),
        T_body_cam=car.T_body_cam,
        limits=car.limits,
        dt=car.dt,
        map=voxel_map,
        start_pose=np.array(info["start_pose"]),
        body_length=car.length,
        success_radius=REACHED,
        noise=STRAYS,
        car=car,
    )


@lru_cache(maxsize=2)  # of one condition, with and without the observed pose: episodes come condition by condition
def _env(condition: Condition, observe_pose: bool) -> gym.Env:
    return gym.make(
        condition.env,
        scene=condition.scene,
        noise=condition.noise,
        sensor_noise=condition.sensor_noise,
        renderer=condition.renderer,
        physics=condition.physics,
        observe_pose=observe_pose,
        images=not observe_pose,  # who sees the pose needs no images, and rendering takes half of the time
        reward="sparse",
        disable_env_checker=True,
    )


@lru_cache(maxsize=1)
def _tasks(path: Path) -> CarTaskSet:
    return load(path)
