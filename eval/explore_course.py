"""Explore in a sweep: its starts, its environment, one run, and navigation on the map that the run leaves (SPEC 8).

Start ``i`` is that of PointNav's test task ``i`` of the scene, so that both share one frozen, hashed file. A run goes
on until the agent stops or time is out, whatever it has covered: an episode that ended at 99 % would cut the entropy
of the fastest explorer short.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, TypeAlias

import gymnasium as gym
import numpy as np
from jaxtyping import Bool, Float

from vssm_gym.agents.astar import AStarAgent
from vssm_gym.agents.base import Agent, AgentContext, Decision, Observation
from vssm_gym.envs.explore import ExploreEnv
from vssm_gym.envs.robots import NOISE_LEVELS, HolonomicRobot
from vssm_gym.envs.scene import Apartment, load_scene
from vssm_gym.envs.stage import Stage
from vssm_gym.envs.tasks import TaskSampler, TaskSet, load
from vssm_gym.eval import episode as pointnav
from vssm_gym.eval import pointnav_course
from vssm_gym.eval.config import Condition, Episode, ExploreSettings, episode_seed
from vssm_gym.eval.explore_metrics import GOAL, Recorder
from vssm_gym.eval.failure import lost_track, stuck_at
from vssm_gym.eval.metrics import location_errors, path_length
from vssm_gym.eval.surfaces import Surface, completeness, mesh_quality, observable_surface
from vssm_gym.planning.information import entropy
from vssm_gym.voxel_map import VoxelMap

LEAST_TASKS = 40  # of a scene's file, so that there are some to navigate beside the starts
JUDGED = 4000  # points of the surface that completeness is sampled by along a run
TRACE_POINTS = 300  # of a path kept in a row: explorers drive far


@dataclass(frozen=True)
class Step:
    """One step of a run as a spectator sees it: the agent has taken up the image and decided, nothing has moved yet.

    Attributes:
        number: steps before it.
        seconds: since the start.
        planar: ``(3,)`` true x, y (m), heading (rad).
        observation: what the agent saw.
        info: the environment's, of the same moment.
        decision: the agent's.
    """

    number: int
    seconds: float
    planar: np.ndarray
    observation: Observation
    info: dict[str, Any]
    decision: Decision


Spectator: TypeAlias = Callable[[Step], None]


def write_tasks(apartment: Apartment, n: int, path: Path) -> None:
    """The first test tasks of a scene, at least ``n``, as a file; one that is there and holds them is kept."""
    pointnav_course.write_tasks(apartment, max(n, LEAST_TASKS), path)


def run(
    episode: Episode,
    agent: Agent,
    task_file: Path,
    voxel_map: VoxelMap | None,
    spectator: Spectator | None = None,
) -> dict[str, Any]:
    """Run one episode and what is driven on its map; returns what it was worth."""
    tasks, settings = _tasks(task_file), episode.explore or ExploreSettings()
    env = _env(episode.condition, agent.needs_pose, settings.steps)
    start = np.array(tasks.tasks[episode.task].start)
    seed = episode_seed(episode.seed, tasks.scene_hash, episode.task)
    row = run_episode(env, agent, start, seed=seed, spectator=spectator)
    explored = map_of(agent)
    if settings.navigation and explored is not None:
        row["navigation"] = navigate(episode, tasks, explored, settings.navigation)
    return row


def map_of(agent: Agent) -> VoxelMap | None:
    """The belief of an agent that keeps one (``agent.map``), else None."""
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
        spectator: shown every step, in order; what it does takes none of the agent's time.

    Returns:
        ``metres_50, _90, _95, _99`` and ``seconds_...`` (None: the run ended before), ``coverage``, ``entropy`` (nats,
        relative to the prior) and ``completeness`` at its end (None without a map), ``curve`` of these, the mesh's
        ``accuracy, accurate_5cm, completion, complete_5cm`` (m and shares), ``success`` (90 %), ``stopped`` (by the
        agent), ``path_length``, ``seconds``, ``steps``, ``collisions`` (steps in contact), ``touched``, location
        errors, ``failure``, ``status``, latencies, ``budget`` (what the time limit allows), ``trace``.
    """
    observation, info = env.reset(seed=seed, options={"start": start})
    world: Any = env.unwrapped
    context = _context(world, info)
    surface = _surface(world.simulation.stage)
    judged = _thinned(surface)
    agent.reset(context, observation, int(np.random.SeedSequence([seed, 1]).generate_state(1)[0]))

    def measure() -> tuple[float | None, float | None]:
        m = map_of(agent)
        return (None, None) if m is None else (entropy(m), completeness(m, judged))

    recorder = Recorder(measure)
    positions: list[np.ndarray] = [world.planar[:2]]
    contacts: list[bool] = []
    decisions: list[Decision] = []
    seconds: list[float] = []
    stopped = truncated = False
    while not (stopped or truncated):
        began = time.perf_counter()
        decision = agent.act(observation)
        seconds.append(time.perf_counter() - began)
        decisions.append(decision)
        # The agent's map now holds what coverage counts: the image of this step, not yet that of the next.
        driven = len(contacts) * context.dt
        recorder.see(info["path_length"], driven, info["coverage"])
        if spectator is not None:
            spectator(Step(len(contacts), driven, np.array(world.planar), observation, info, decision))
        observation, _, stopped, truncated, info = env.step(decision.action)
        positions.append(world.planar[:2])
        contacts.append(bool(info["collision"]))
    recorder.see(info["path_length"], (len(contacts) - stopped) * context.dt, info["coverage"], last=True)

    path, contact = np.array(positions), np.array(contacts, dtype=bool)
    estimates = pointnav.estimates_of(decisions, stopped)
    statuses = [decision.status for decision in decisions]
    coverage, final = float(info["coverage"]), map_of(agent)
    success = 100.0 * coverage >= GOAL - 1e-9
    why = None if success else _failure(statuses, stopped, coverage, path, estimates, contact, context.body_length)
    quality = {} if final is None else mesh_quality(final, surface, world.simulation.scenery.boxes)
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
        "touched": bool(contact.any()),
        **location_errors(path, estimates),
        "budget": _budget(env, world.robot),
        "failure": why,
        "status": statuses[-1],
        "latency": pointnav.latency_of(decisions, seconds),
        "end_on": "stop",
        "tracer": world.renderer_name,
        "trace": {
            **pointnav.trace_of(path, None, contact),
            "true": pointnav.thinned(path, TRACE_POINTS),
            "reached": {str(s): _place(path, at[0]) for s, at in recorder.reached.items()},
        },
    }


def navigate(episode: Episode, tasks: TaskSet, explored: VoxelMap, n: int) -> dict[str, Any]:
    """Drive ``n`` of the scene's PointNav tasks with ``astar`` on a map that an explorer left.

    They are the ``n`` tasks after the one whose start the run had, so that all agents meet the same ones.

    Returns:
        ``tasks`` (how many), ``success`` and ``spl`` (means), ``failures`` (reasons).
    """
    chosen = [tasks.tasks[(episode.task + 1 + k) % len(tasks.tasks)] for k in range(n)]
    noise = NOISE_LEVELS[episode.condition.noise]
    rows = [
        pointnav.run_episode(
            _pointnav(episode.condition),
            _sampler(episode.condition.scene),
            _navigator(),
            task,
            seed=episode_seed(episode.seed, tasks.scene_hash, task.id),
            voxel_map=explored,
            noise=(noise.turn, noise.step),
        )
        for task in chosen
    ]
    return {
        "tasks": n,
        "success": float(np.mean([row["success"] for row in rows])),
        "spl": float(np.mean([row["spl"] for row in rows])),
        "failures": [row["failure"] for row in rows if row["failure"]],
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
    """Why a run ended below :data:`GOAL`; what stands before the colon is the kind it is counted by."""
    reached = f"{100.0 * coverage:.0f} % covered"
    if lost := lost_track(statuses, path, estimates, contacts, body_length):
        return f"{lost}, {reached}"
    kind, _, detail = statuses[-1].partition(": ")
    if stopped and kind in ("lost", "boxed in"):
        return f"{kind}: {detail}, {reached}"
    if stopped:
        return f"stopped early: {reached}, {statuses[-1]}"
    if stuck := stuck_at(path, contacts, body_length):
        return f"{stuck}, {reached}"
    return f"time out: {reached} after {len(path) - 1} steps"


def _budget(env: gym.Env, robot: HolonomicRobot) -> dict[str, float]:
    """What the time limit allows: steps, seconds, and the metres that the robot can drive in them."""
    steps = int(env.get_wrapper_attr("_max_episode_steps"))
    return {"steps": steps, "seconds": round(steps * robot.dt, 3), "metres": round(steps * robot.max_step, 3)}


def _place(path: np.ndarray, metres: float) -> list[float]:
    """Where the path has the length ``metres``, to the millimetre."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    return path[np.argmin(np.abs(along - metres))].round(3).tolist()


def _context(world: ExploreEnv, info: dict[str, Any]) -> AgentContext:
    robot = world.robot
    return AgentContext(
        K=np.array(info["K"]),
        camera=(world.camera.width, world.camera.height),
        T_body_cam=robot.T_body_cam,
        limits=robot.limits,
        dt=robot.dt,
        map=None,
        start_pose=np.array(info["start_pose"]),
        body_length=robot.body_length,
        success_radius=0.0,  # there is no goal
        noise=(world.noise.turn, world.noise.step),
    )


@lru_cache(maxsize=1)
def _surface(stage: Stage) -> Surface:
    return observable_surface(stage)


@lru_cache(maxsize=1)
def _thinned(surface: Surface) -> Surface:
    return surface.thinned(JUDGED)


@lru_cache(maxsize=2)  # of one condition, with and without the observed pose: episodes come condition by condition
def _env(condition: Condition, observe_pose: bool, steps: int) -> gym.Env:
    return gym.make(
        condition.env,
        **_world(condition),
        observe_pose=observe_pose,
        reward="sparse",
        finish=2.0,  # never: only the agent or the time limit ends a run
        max_episode_steps=steps,
        disable_env_checker=True,
    )


@lru_cache(maxsize=1)
def _pointnav(condition: Condition) -> gym.Env:
    return gym.make("vssm_gym/PointNav-v0", **_world(condition), reward="sparse", disable_env_checker=True)


def _world(condition: Condition) -> dict[str, Any]:
    return {name: getattr(condition, name) for name in ("scene", "noise", "sensor_noise", "renderer")}


@cache
def _navigator() -> Agent:
    return AStarAgent()


@lru_cache(maxsize=1)
def _sampler(scene: str) -> TaskSampler:
    return TaskSampler(load_scene(scene), HolonomicRobot())


@lru_cache(maxsize=1)
def _tasks(path: Path) -> TaskSet:
    return load(path)
