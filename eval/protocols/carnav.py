"""Run CarNav in a sweep: chains of target poses, the environment, and single episodes."""

import math
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from vssm_gym.agents.base import Agent, Decision, decide
from vssm_gym.envs.robots.car_noise import NOISE_LEVELS
from vssm_gym.envs.scenes.scene import Apartment
from vssm_gym.envs.tasks import car_sets
from vssm_gym.envs.tasks.car import CarTask
from vssm_gym.envs.tasks.car_sets import CarTaskSet
from vssm_gym.eval.episodes.identity import Episode, episode_seed
from vssm_gym.eval.episodes.recorder import Wrap, unwrapped
from vssm_gym.eval.metrics.failure import GAVE_UP_LOST, failure_reason
from vssm_gym.eval.metrics.navigation import episode_metrics
from vssm_gym.eval.protocols import shared
from vssm_gym.eval.protocols.agent_context import agent_context
from vssm_gym.eval.protocols.episode import calibration_of, estimates_of, latency_of, thinned, trace_of
from vssm_gym.eval.protocols.shared import (
    WORLD,
    ensure_map,
    keep_or_write,
    load,
    load_map,
    notice,
    scene_names,
    tasks_in,
    world,
)
from vssm_gym.geometry.car import GOAL_HEADING_TOLERANCE, GOAL_RADIUS
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.car import reeds_shepp

__all__ = ["conditions", "ensure_map", "load", "load_map", "notice", "run", "run_episode", "scene_names", "write_tasks"]

KEYWORDS = tuple(name for name in WORLD if name not in ("robot", "direction_frame"))  # of a condition
MOVING_SPEED = 0.05  # m/s: slower commands count as standing when direction changes are counted


def conditions() -> Mapping[str, Sequence[str]]:
    """Return the names that a configuration may hold for the car."""
    own = {"robot": ("car",), "noise": tuple(NOISE_LEVELS), "direction_frame": ("body",)}
    return {**shared.conditions(), **own}


def write_tasks(apartment: Apartment, n: int, path: Path) -> None:
    """Write a chain of ``n`` test targets of a scene to a file; keep a file that already holds them."""
    make = partial(car_sets.make_car_tasks, apartment, n)
    keep_or_write(apartment, n, path, car_sets.load, make, car_sets.save)


def run(
    episode: Episode, agent: Agent, task_file: Path, voxel_map: VoxelMap | None, *, wrap: Wrap = unwrapped
) -> dict[str, Any]:
    """Run one episode and return the measured fields of its row."""
    tasks = tasks_in(task_file, CarTaskSet)
    env = world(
        episode.condition,
        fields=KEYWORDS,
        physics=episode.condition.physics,
        observe_pose=agent.needs_pose,
        images=not agent.needs_pose,  # an agent that observes the pose needs none; rendering takes half of the time
    )
    seed = episode_seed(episode.seed, tasks.scene_hash, episode.task)
    return run_episode(wrap(env), agent, tasks.tasks[episode.task], seed=seed, voxel_map=voxel_map)


def run_episode(env: gym.Env, agent: Agent, task: CarTask, *, seed: int, voxel_map: VoxelMap | None) -> dict[str, Any]:
    """Run ``agent`` on ``task`` until the episode ends, in v0 on arrival, in v1 on a stop, or the agent gives up.

    Args:
        env: CarNav with its time limit; the pose is observed if and only if the agent needs it.
        agent: any agent of the registry that drives a car; it is reset here.
        task: start and target pose.
        seed: of the environment's streams and, mixed, of the agent; the same for every agent.
        voxel_map: the learned map.

    Returns:
        The metrics of :func:`episode_metrics`, with the length of the shortest Reeds-Shepp curve into the target's
        region, obstacles ignored, as ``geodesic``; those of :func:`calibration_of`; ``collision_events`` (times that
        contact began), ``collided``, ``seconds``, ``direction_changes``, ``heading_error`` (rad); ``failure``,
        ``status``, the agent's ``responses`` to failures where it counts them, latencies, ``trace`` (its ``poses`` with
        headings).
    """
    observation, info = env.reset(seed=seed, options={"task": task})
    body: Any = env.unwrapped
    context = agent_context(env, info, voxel_map)
    agent.reset(context, observation, int(np.random.SeedSequence([seed, 1]).generate_state(1)[0]))
    poses, contacts, speeds = [body.planar], [], []
    decisions: list[Decision] = []
    seconds: list[float] = []
    ended = False
    while not ended:
        began = time.perf_counter()
        decision = decide(agent, observation)
        seconds.append(time.perf_counter() - began)
        decisions.append(decision)
        if decision.gives_up:
            break
        observation, _, terminated, truncated, info = env.step(decision.action)
        ended = terminated or truncated
        poses.append(body.planar)
        contacts.append(bool(info["collision"]))
        speeds.append(float(info["control"][0]))

    path, goal, contact = np.array(poses), np.array(task.goal), np.array(contacts, dtype=bool)
    estimates = estimates_of(agent, decisions, stopped=decisions[-1].gives_up)
    estimates = None if estimates is None else estimates[: len(path)]
    success = bool(info.get("success", False))
    radius = body.car.turning_radius
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
        stopped=str(info.get("reason", "")).startswith("stopped"),
        statuses=[decision.status for decision in decisions],
        positions=path[:, :2],
        estimates=estimates,
        goal=goal[:2],
        contacts=contact,
        body_length=context.body_length,
    )
    if decisions[-1].gives_up and not decisions[-1].status.startswith(GAVE_UP_LOST):
        failure = f"planner: {decisions[-1].status}"
    elif failure.startswith("stopped outside"):
        turned = math.degrees(task.turn(path[-1]))
        away = float(np.hypot(*(path[-1, :2] - goal[:2])))
        failure = f"stopped outside: {info['reason']}, {away:.3f} m and {turned:.1f} degrees from the target"
    return {
        **metrics,
        **calibration_of(decisions, poses),
        "collision_events": int(info["collisions"]),
        "collided": bool(info["collisions"]),
        "seconds": round(len(contacts) * context.dt, 3),
        "direction_changes": direction_changes(np.array(speeds)),
        "heading_error": task.turn(path[-1]),
        "failure": None if success else failure,
        "status": decisions[-1].status,
        **({} if decisions[-1].responses is None else {"responses": dict(decisions[-1].responses)}),
        "latency": latency_of(decisions, seconds),
        "end_on": body.end_on,
        "tracer": body.renderer_name,
        "success_radius": context.success_radius,
        "goal": [float(v) for v in goal],
        "trace": {**trace_of(path[:, :2], estimates, contact), "poses": thinned(path)},
    }


def shortest_curve(start: np.ndarray, goal: np.ndarray, radius: float) -> float:
    """Return the length (m) of the shortest Reeds-Shepp curve from a pose into a target's region, to 4 mm.

    It is a lower bound of every car's path length, computed over a lattice of the region; at least a millimetre, so
    that ratios stay finite.
    """
    r, angle = np.meshgrid(np.array([0.0, 0.5, 1.0]) * GOAL_RADIUS, np.linspace(-np.pi, np.pi, 13)[:-1], indexing="ij")
    offsets = np.stack([r * np.cos(angle), r * np.sin(angle)], axis=-1).reshape(-1, 2)
    turns = (
        np.linspace(-GOAL_HEADING_TOLERANCE, GOAL_HEADING_TOLERANCE, 5)
        if len(goal) == 3
        else np.linspace(-np.pi, np.pi, 25)[:-1]
    )
    heading = goal[2] if len(goal) == 3 else 0.0
    places = np.concatenate([goal[:2] + offsets], axis=0)
    goals = np.array([(*place, heading + turn) for place in places for turn in turns])
    starts = np.broadcast_to(start, goals.shape)
    return max(1e-3, float(reeds_shepp.length(starts, goals, radius).min()))


def direction_changes(speeds: np.ndarray) -> int:
    """Count the changes between forward and backward driving, with or without a stand in between."""
    signs = np.sign(speeds[np.abs(speeds) > MOVING_SPEED])
    return int(np.count_nonzero(np.diff(signs)))
