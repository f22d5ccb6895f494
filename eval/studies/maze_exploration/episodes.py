"""Run one explorer in one maze, and sample coverage and the map's information along the way.

The information is the fall of the entropy of a map of what is known (:class:`ScanMapper`): the agent's own, or for a
policy without one the map that the same filter makes of its scans and commands. It is not told to the policy.
"""

import zlib
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import gymnasium as gym
import numpy as np

from vssm_gym.agents.base import Agent, decide
from vssm_gym.agents.exploration.maze_frontier import MazeFrontierAgent
from vssm_gym.agents.exploration.maze_information import MazeInformationAgent
from vssm_gym.agents.exploration.maze_lstm import LSTM_FILES, MazeLstmAgent
from vssm_gym.agents.exploration.maze_random import MazeRandomAgent
from vssm_gym.agents.shared.planar.scan_mapper import ScanMapper, planar_entropy
from vssm_gym.envs.tasks.mazes import load_maze
from vssm_gym.eval.episodes.identity import episode_seed
from vssm_gym.eval.protocols.agent_context import agent_context

SAMPLED_EVERY = 20  # steps between two points of a curve

EXPLORERS: Mapping[str, Callable[[str], Agent]] = {
    "maze_information": lambda maze: MazeInformationAgent(),
    "maze_frontier": lambda maze: MazeFrontierAgent(),
    "maze_lstm": lambda maze: MazeLstmAgent(),
    "maze_lstm_own": lambda maze: MazeLstmAgent(LSTM_FILES / f"{maze}.npz"),
    "maze_random": lambda maze: MazeRandomAgent(),
}
"""The agents by name, made for a maze: only ``maze_lstm_own`` knows which one it is."""


def explore(agent: Agent, maze: str, seed: int, steps: int, noise: str, sensor_noise: str) -> dict[str, Any]:
    """Return the row of one run: curves of coverage and nats, and figures of the whole.

    Args:
        agent: it is reset here, and never sees ``info``.
        maze: its name.
        seed: of start, noise and agent: the same for every agent.
        steps: of the run; it goes on where all tiles were visited.
        noise: level of the execution noise.
        sensor_noise: level of the ranges' noise.
    """
    env = _environment(maze, steps, noise, sensor_noise)
    tasks = load_maze(maze).tasks
    task = tasks.tasks[np.random.default_rng([seed, zlib.crc32(maze.encode())]).integers(len(tasks.tasks))]
    of_episode = episode_seed(seed, tasks.scene_hash, task.id)
    observation, info = env.reset(seed=of_episode, options={"task": task})
    context = agent_context(env, info)
    agent.reset(context, observation, int(np.random.SeedSequence([of_episode, 1]).generate_state(1)[0]))
    watcher = None if hasattr(agent, "planar_map") else ScanMapper()
    if watcher is not None:
        watcher.reset(context, observation)
    coverage, nats, errors, planning = [], [], [], []
    collisions, travelled, sent = 0, 0.0, np.zeros(2)
    before = np.array(info["pose"])
    for k in range(steps + 1):
        if watcher is not None and k > 0:
            watcher.observe(sent, observation)
        if k == steps:
            break
        decision = decide(agent, observation)
        if k % SAMPLED_EVERY == 0:
            coverage.append(round(float(info["coverage"]), 4))
            nats.append(round(-planar_entropy(watcher.map if watcher else agent.planar_map), 1))  # type: ignore[attr-defined]
        if decision.pose is not None:
            errors.append(float(np.hypot(*(decision.pose - info["pose"])[:2])))
        if "planning" in decision.latency:
            planning.append(decision.latency["planning"])
        sent = decision.action[:2]
        observation, _, _, _, info = env.step(decision.action)
        collisions += int(info["collision"])
        travelled += float(np.hypot(*(info["pose"] - before)[:2]))
        before = np.array(info["pose"])
    final = watcher.map if watcher else agent.planar_map  # type: ignore[attr-defined]
    return {
        "maze": maze,
        "seed": seed,
        "agent": agent.name,
        "task": task.id,
        "coverage": [*coverage, round(float(info["coverage"]), 4)],
        "nats": [*nats, round(-planar_entropy(final), 1)],
        "collisions": collisions,
        "path_length": round(travelled, 3),
        "location_error_mean": round(float(np.mean(errors)), 5) if errors else None,
        "location_error_max": round(float(np.max(errors)), 5) if errors else None,
        "decisions": len(planning),
        "decision_p50": round(float(np.median(planning)), 4) if planning else None,
        "decision_p95": round(float(np.quantile(planning, 0.95)), 4) if planning else None,
    }


@lru_cache(maxsize=1)
def _environment(maze: str, steps: int, noise: str, sensor_noise: str) -> gym.Env:
    keywords: dict[str, Any] = {
        "noise": noise,
        "sensor_noise": sensor_noise,
        "reward": "sparse",
        "max_episode_steps": steps + 1,
    }
    return gym.make("vssm_gym/LidarMaze-v0", scene=maze, task="explore", disable_env_checker=True, **keywords)
