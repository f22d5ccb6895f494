"""Run one exploration of one agent: the agent receives observations, and only the metrics see the truth.

A run continues until the agent stops or time is out, whatever it has covered: an episode that ended at 99 % would cut
the entropy of the fastest explorer short.
"""

import time
from functools import lru_cache
from typing import Any

import gymnasium as gym
import numpy as np
from jaxtyping import Bool, Float

from vssm_gym.agents.base import Agent, Decision, decide
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.tasks.scene_cache import SceneCache
from vssm_gym.eval.metrics.exploration import COVERAGE_GOAL, Recorder
from vssm_gym.eval.metrics.failure import GAVE_UP_LOST, lost_track, stuck_at
from vssm_gym.eval.metrics.navigation import location_errors, path_length
from vssm_gym.eval.metrics.surfaces import Surface, completeness, mesh_quality, observable_surface
from vssm_gym.eval.protocols.agent_context import context_in
from vssm_gym.eval.protocols.episode import (
    Spectator,
    StepRecord,
    calibration_of,
    estimates_of,
    latency_of,
    thinned,
    trace_of,
)
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.exploration.information import entropy

COMPLETENESS_POINTS = 4000  # of the surface, at which completeness is sampled along a run
EXPLORE_TRACE_POINTS = 300  # points of a path kept in a row: explorers drive far


def map_of(agent: Agent) -> VoxelMap | None:
    """Return the belief of an agent that keeps one (``agent.map``), else None."""
    return getattr(agent, "map", None)


def run_episode(
    env: gym.Env, agent: Agent, start: Float[np.ndarray, "3"], *, seed: int, spectator: Spectator | None = None
) -> dict[str, Any]:
    """Let ``agent`` explore from ``start`` until it stops or time is out.

    Args:
        env: Explore with its time limit and without another end; the pose is observed if the agent needs it.
        agent: any agent; it is reset here and is given no map.
        start: x, y (m), heading (rad).
        seed: of the environment's streams and, mixed, of the agent; the same for every agent.
        spectator: called with every step, in order; its time does not count as the agent's.

    Returns:
        ``metres_50, _90, _95, _99`` and ``seconds_...`` (None: the run ended before), ``coverage``, ``entropy`` (nats,
        relative to the prior) and ``completeness`` at its end (None without a map), ``curve`` of these, the mesh's
        ``accuracy, accurate_5cm, completion, complete_5cm`` (m and proportions), ``success`` (90 %), ``stopped`` (by
        the agent), ``path_length``, ``seconds``, ``steps``, ``collisions`` (steps in contact), ``collided``, location
        errors, ``nees``, ``in_95``, ``failure``, ``status``, latencies, ``budget`` (what the time limit allows),
        ``trace``.
    """
    observation, info = env.reset(seed=seed, options={"start": start})
    world: Any = env.unwrapped
    context = context_in(world, info, None, world.noise)
    surface = _surface(world.simulation.scene_cache)
    sampled = _thinned(surface)
    agent.reset(context, observation, int(np.random.SeedSequence([seed, 1]).generate_state(1)[0]))

    def measure() -> tuple[float | None, float | None]:
        m = map_of(agent)
        return (None, None) if m is None else (entropy(m), completeness(m, sampled))

    recorder = Recorder(measure)
    poses = [np.array(world.planar)]
    contacts: list[bool] = []
    decisions: list[Decision] = []
    seconds: list[float] = []
    stopped = truncated = False
    while not (stopped or truncated):
        began = time.perf_counter()
        decision = decide(agent, observation)
        seconds.append(time.perf_counter() - began)
        decisions.append(decision)
        # The agent's map now holds what coverage counts: the image of this step, not yet that of the next.
        driven = len(contacts) * context.dt
        recorder.record(info["path_length"], driven, info["coverage"])
        if spectator is not None:
            spectator(StepRecord(len(contacts), driven, np.array(world.planar), observation, info, decision))
        observation, _, stopped, truncated, info = env.step(decision.action)
        poses.append(np.array(world.planar))
        contacts.append(bool(info["collision"]))
    recorder.record(info["path_length"], (len(contacts) - stopped) * context.dt, info["coverage"], last=True)

    path, contact = np.array(poses)[:, :2], np.array(contacts, dtype=bool)
    estimates = estimates_of(agent, decisions, stopped)
    statuses = [decision.status for decision in decisions]
    coverage, final = float(info["coverage"]), map_of(agent)
    success = 100.0 * coverage >= COVERAGE_GOAL - 1e-9
    why = None if success else _failure(statuses, stopped, coverage, path, estimates, contact, context.body_length)
    quality = {} if final is None else mesh_quality(final, surface, world.simulation.renderer.boxes)
    curve = recorder.curve
    return {
        "success": success,
        **recorder.row(),
        "coverage": coverage,
        "entropy": curve["entropy"][-1],
        "completeness": curve["completeness"][-1],
        **quality,
        "path_length": path_length(path),
        "seconds": curve["seconds"][-1],
        "steps": len(contacts),
        "stopped": bool(stopped),
        "collisions": int(contact.sum()),
        "collided": bool(contact.any()),
        **location_errors(path, estimates),
        **calibration_of(decisions, poses),
        "budget": _budget(env, world.robot),
        "failure": why,
        "status": statuses[-1],
        "latency": latency_of(decisions, seconds),
        "end_on": "stop",
        "tracer": world.renderer_name,
        "trace": {
            **trace_of(path, None, contact),
            "true": thinned(path, EXPLORE_TRACE_POINTS),
            "reached": {str(s): _place(path, at[0]) for s, at in recorder.reached.items()},
        },
    }


def _failure(
    statuses: list[str],
    stopped: bool,
    coverage: float,
    path: np.ndarray,
    estimates: np.ndarray | None,
    contacts: Bool[np.ndarray, "steps"],
    body_length: float,
) -> str:
    """Explain why a run ended below :data:`COVERAGE_GOAL`, as ``kind: detail``; failures are counted by the kind."""
    reached = f"{100.0 * coverage:.0f} % covered"
    if lost := lost_track(statuses, path, estimates, contacts, body_length):
        return f"{lost}, {reached}"
    kind, _, detail = statuses[-1].partition(": ")
    if stopped and statuses[-1].startswith(GAVE_UP_LOST):
        return f"lost: {statuses[-1]}, {reached}"
    if stopped and kind == "boxed in":
        return f"{kind}: {detail}, {reached}"
    if stopped:
        return f"stopped early: {reached}, {statuses[-1]}"
    if stuck := stuck_at(path, contacts, body_length):
        return f"{stuck}, {reached}"
    return f"time out: {reached} after {len(path) - 1} steps"


def _budget(env: gym.Env, robot: HolonomicRobot) -> dict[str, float]:
    """Return the steps and seconds of the time limit, and the metres that the robot can drive in them."""
    steps = int(env.get_wrapper_attr("_max_episode_steps"))
    return {"steps": steps, "seconds": round(steps * robot.dt, 3), "metres": round(steps * robot.max_step, 3)}


def _place(path: np.ndarray, metres: float) -> list[float]:
    """Return the point at which the path has the length ``metres``, to the millimetre."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    return path[np.argmin(np.abs(along - metres))].round(3).tolist()


@lru_cache(maxsize=1)
def _surface(cache: SceneCache) -> Surface:
    return observable_surface(cache)


@lru_cache(maxsize=1)
def _thinned(surface: Surface) -> Surface:
    return surface.thinned(COMPLETENESS_POINTS)
