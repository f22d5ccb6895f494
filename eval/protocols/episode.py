"""Run one navigation episode of one agent: the agent receives observations, and only the metrics see the truth."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import gymnasium as gym
import numpy as np
from jaxtyping import Float

from vssm_gym.agents.base import Agent, Decision, Observation, decide
from vssm_gym.envs.tasks.navigation import Task, TaskSampler
from vssm_gym.eval.metrics.failure import failure_reason
from vssm_gym.eval.metrics.navigation import episode_metrics
from vssm_gym.eval.metrics.pose_calibration import pose_calibration
from vssm_gym.eval.protocols.agent_context import KnownNoise, context_in
from vssm_gym.inference.scan_encoder.network import ScanEncoder
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.scan_model import ScanModel

TRACE_POINTS = 80  # points of a path kept in a row, enough for a picture
TRACE_CONTACTS = 30  # points of contact kept in a row


@dataclass(frozen=True)
class StepRecord:
    """Hold one step of a run as a spectator sees it: the agent has decided, and nothing has moved yet.

    Attributes:
        number: steps before it.
        seconds: since the start.
        planar: ``(3,)`` true x, y (m), heading (rad).
        observation: the agent's observation.
        info: the environment's info of the same moment.
        decision: the agent's decision.
    """

    number: int
    seconds: float
    planar: np.ndarray
    observation: Observation
    info: dict[str, Any]
    decision: Decision


Spectator: TypeAlias = Callable[[StepRecord], None]


def run_episode(
    env: gym.Env,
    sampler: TaskSampler,
    agent: Agent,
    task: Task,
    *,
    seed: int,
    voxel_map: VoxelMap | None,
    noise: KnownNoise,
    limits: np.ndarray | None = None,
    spectator: Spectator | None = None,
    scan_model: ScanModel | None = None,
    scan_encoder: ScanEncoder | None = None,
) -> dict[str, Any]:
    """Run ``agent`` on ``task`` until it stops or time is out.

    Args:
        env: PointNav, ImageNav or LidarMaze with its time limit; it shows the pose only to an agent that needs it.
        sampler: of the environment's scene, for the distance that remains at the end.
        agent: any agent of the registry; it is reset here.
        task: start and goal.
        seed: of the environment's streams and, mixed, of the agent; the same for every agent.
        voxel_map: the learned map, None for an agent that needs none.
        noise: the execution noise in the agent's context.
        limits: largest commands, where they are not all of the robot's limits.
        spectator: called with every step, in order; its time does not count as the agent's.
        scan_model: the learned model of scans, None for an agent that needs none.
        scan_encoder: of that model, None for an agent whose goals are no scans.

    Returns:
        The metrics of :func:`episode_metrics` and of :func:`calibration_of`, ``failure`` (None on success), the agent's
        last ``status``, its ``responses`` to failures and ``expansions`` where it counts them, latency percentiles by
        stage in seconds, and the downsampled ``trace``: plain JSON values.
    """
    observation, info = env.reset(seed=seed, options={"task": task})
    world: Any = env.unwrapped
    world = getattr(world, "navigation", world)  # ImageNav moves, rewards and ends as the PointNav that it holds
    context = context_in(world, info, voxel_map, noise, limits, scan_model, scan_encoder)
    agent.reset(context, observation, int(np.random.SeedSequence([seed, 1]).generate_state(1)[0]))

    poses = [np.array(world.planar)]
    contacts: list[bool] = []
    decisions: list[Decision] = []
    seconds: list[float] = []
    ended = False
    while not ended:
        began = time.perf_counter()
        decision = decide(agent, observation)
        seconds.append(time.perf_counter() - began)
        if spectator is not None:
            driven = len(contacts) * context.dt
            spectator(StepRecord(len(contacts), driven, np.array(world.planar), observation, info, decision))
        observation, _, stopped, truncated, info = env.step(decision.action)
        ended = stopped or truncated
        decisions.append(decision)
        poses.append(np.array(world.planar))
        contacts.append(bool(info["collision"]))

    path, goal, contact = np.array(poses)[:, :2], np.array(task.goal), np.array(contacts)
    estimates = estimates_of(agent, decisions, stopped)
    success = bool(info.get("success", False)) and not decisions[-1].gives_up  # to give up is no claim to have arrived
    metrics = episode_metrics(
        success=success,
        geodesic=task.geodesic,
        remaining=0.0 if success else _remaining(sampler, path[-1], goal, context.success_radius),
        positions=path,
        goal=goal,
        contacts=contact,
        estimates=estimates,
    )
    failure = failure_reason(
        stopped=stopped,
        statuses=[decision.status for decision in decisions],
        positions=path,
        estimates=estimates,
        goal=goal,
        contacts=contact,
        body_length=context.body_length,
    )
    return {
        **metrics,
        **calibration_of(decisions, poses),
        "failure": None if success else failure,
        "status": decisions[-1].status,
        **({} if decisions[-1].responses is None else {"responses": dict(decisions[-1].responses)}),
        **({} if decisions[-1].expansions is None else {"expansions": decisions[-1].expansions}),
        "latency": latency_of(decisions, seconds),
        "end_on": world.end_on,
        "tracer": getattr(world, "renderer_name", "none"),
        "success_radius": context.success_radius,
        "goal": [float(v) for v in goal],
        "trace": trace_of(path, estimates, contact),
    }


def estimates_of(agent: Agent, decisions: Sequence[Decision], stopped: bool) -> Float[np.ndarray, "time 2"] | None:
    """Return the agent's position estimates at reset and after every step; None if it keeps none or observes its pose.

    A decision's estimate is of the time before its action. After the last action the agent is not called again: a stop
    moves nothing, so its estimate still holds; after a time-out it is unknown.
    """
    if agent.needs_pose or all(decision.pose is None for decision in decisions):
        return None
    unknown = np.full(2, np.nan)
    known = [unknown if decision.pose is None else np.asarray(decision.pose, float)[:2] for decision in decisions]
    return np.array([*known, known[-1] if stopped else unknown])


def calibration_of(decisions: Sequence[Decision], poses: Sequence[Float[np.ndarray, "3"]]) -> dict[str, float | None]:
    """Return ``nees`` and ``in_95`` of the estimates whose covariance the agent states; None where there is none.

    Args:
        decisions: of the episode; the first one's estimate is the start, which the agent was given, and is left out.
        poses: true ``(x, y, heading)`` at reset and after every step.
    """
    later = zip(decisions[1:], poses[1:], strict=False)  # the last pose may have no decision
    stated = [(made.pose, made.covariance, true) for made, true in later if made.covariance is not None]
    estimates, covariances, truth = (np.array([step[k] for step in stated], float) for k in range(3))
    return pose_calibration(estimates, covariances, truth)


def _remaining(sampler: TaskSampler, position: np.ndarray, goal: np.ndarray, success_radius: float) -> float:
    """Return the path length (m) from a true position, perhaps slightly inside a wall, to the success region."""
    return sampler.geodesics.length(sampler.space.nearest(position), goal, success_radius)


def latency_of(decisions: Sequence[Decision], seconds: Sequence[float]) -> dict[str, dict[str, float]]:
    """Return the 50 % and 95 % points of every stage that the agent reports, and of the whole decision, s."""
    stages = {stage: [d.latency[stage] for d in decisions if stage in d.latency] for stage in decisions[0].latency}
    return {
        stage: {"p50": round(float(np.quantile(values, 0.5)), 6), "p95": round(float(np.quantile(values, 0.95)), 6)}
        for stage, values in {**stages, "total": list(seconds)}.items()
    }


def trace_of(
    positions: np.ndarray, estimates: np.ndarray | None, contacts: np.ndarray
) -> dict[str, list[list[float]] | None]:
    """Return the true and estimated path at the same few times, and some points of contact, to the millimetre."""
    known = np.arange(len(positions))
    if estimates is not None:
        known = known[np.isfinite(estimates).all(axis=1)]
    in_contact = positions[1:][contacts]
    return {
        "true": thinned(positions[known]),
        "estimate": None if estimates is None else thinned(estimates[known]),
        "contacts": thinned(in_contact, TRACE_CONTACTS),
    }


def thinned(points: np.ndarray, limit: int = TRACE_POINTS) -> list[list[float]]:
    """Return at most ``limit`` of the points, first and last among them."""
    chosen = np.unique(np.linspace(0, len(points) - 1, min(limit, len(points))).round().astype(int))
    return points[chosen].round(3).tolist()
