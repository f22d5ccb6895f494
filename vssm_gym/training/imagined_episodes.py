"""Run a policy's episodes in imagination: the tasks of a sweep, driven in the learned map, evaluated by the same rules.

    return = max(0, l - r) - 0.01 steps + 2.5 success,   l geodesic of the start, r remaining geodesic at the end

This is PointNav's dense reward except for the last metres inside the success region. Rows of both worlds have it, so
that ``imagined - real`` of a task measures how much the model overestimates the policy.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vssm_gym.agents.policy.agent import stop_radius
from vssm_gym.agents.policy.command_history import CommandHistory
from vssm_gym.agents.policy.features import features, size_of
from vssm_gym.agents.policy.policy_file import Policy
from vssm_gym.agents.shared.localization import Localization
from vssm_gym.envs.pointnav import POINTNAV_REWARD
from vssm_gym.envs.registration import ENVIRONMENTS
from vssm_gym.envs.tasks.navigation import Task
from vssm_gym.envs.world_model.config import Imagination
from vssm_gym.eval.metrics.navigation import spl
from vssm_gym.inference.status import Status
from vssm_gym.training.config import SIMULATOR, EnvironmentSettings
from vssm_gym.training.environment import make_observing

STEPS = ENVIRONMENTS[SIMULATOR].max_episode_steps or 0  # PointNav's time limit
POSE_STD = Imagination.pose_std  # of the pose estimate in imagination: forward (m), left (m), turn (rad)

Row = dict[str, Any]


@dataclass(frozen=True)
class ImaginedStep:
    """Hold one step of n imagined robots as a spectator sees it: they have decided, and nothing has moved yet.

    Attributes:
        number: steps before it.
        planar: ``(n, 3)`` true poses in imagination: x, y (m), heading (rad).
        observation: of n robots: ``scan``, ``goal`` and ``pose``, the pose estimate.
        collision: ``(n,)`` whether they collided in the step before.
        stop: ``(n,)`` whether they stop.
    """

    number: int
    planar: np.ndarray
    observation: dict[str, np.ndarray]
    collision: np.ndarray
    stop: np.ndarray


def imagine(
    policy: Policy,
    map_file: Path,
    tasks: Sequence[Task],
    noise: str,
    seed: int = 0,
    spectator: Callable[[ImaginedStep], None] | None = None,
    transition: Path | None = None,
) -> list[Row]:
    """Imagine one episode of each task; return rows of ``task, success, spl, steps, collisions, path_length, return``.

    Task number i draws from the stream of ``seed + i``, independent of the other tasks. The spectator is called with
    every step until the last episode has ended; robots whose episode ended before have begun others.

    Raises :class:`InputError` where a task does not fit the map.
    """
    n = len(tasks)
    settings = EnvironmentSettings(map=str(map_file), num_envs=n, max_episode_steps=STEPS)
    uncertain = "pose_std" in policy.spec.parts
    env: Any = make_observing(
        settings,
        noise=noise,
        transition=transition,
        pose_std=POSE_STD,
        tasks=list(tasks),
        end_on="stop",
        show_uncertainty=uncertain,
    )
    observation, _ = env.reset(seed=seed, options={"task": np.arange(n)})
    spec, radius = policy.spec, env.success_radius
    farther = radius - stop_radius(radius, Localization(np.zeros(3), np.array(POSE_STD), Status.OK))
    seen = np.zeros((n, spec.frames, size_of(spec.parts)), np.float32)
    history = CommandHistory(n)
    at = env.planar[:, :2]
    driven, gained = np.zeros(n), np.zeros(n)
    steps, collisions = np.zeros(n, int), np.zeros(n, int)
    success, running = np.zeros(n, bool), np.ones(n, bool)
    collided, number = np.zeros(n, bool), 0
    while running.any():
        goal = observation["goal"].astype(np.float64)
        goal[:, 0] += farther
        seen = np.roll(seen, -1, axis=1)
        seen[:, -1] = features({**observation, "goal": goal, "commands": history.commands}, spec.parts)
        stop = goal[:, 0] <= radius
        command = policy(seen.reshape(n, -1))
        history.add(command)
        action = np.concatenate([command, stop[:, None]], axis=1)
        if spectator is not None:
            spectator(ImaginedStep(number, env.planar, observation, collided, stop))
        observation, reward, terminated, truncated, infos = env.step(action.astype(np.float32))
        collided, number = np.asarray(infos["collision"]), number + 1
        now = env.planar[:, :2]
        driven += np.where(running, np.linalg.norm(now - at, axis=1), 0.0)
        gained += np.where(running, reward, 0.0)
        steps += running
        collisions += running & infos["collision"]
        success |= running & terminated & np.asarray(infos.get("success", np.zeros(n)), bool)
        running &= ~(terminated | truncated)
        at = now
    away = np.asarray(env.world.pool.geodesic, np.float64)[:n]  # m to the goal itself; beyond is padding
    left = away - (gained + POINTNAV_REWARD.step_cost * steps - POINTNAV_REWARD.success * success)
    geodesic = np.array([task.geodesic for task in tasks])
    remaining = np.where(success, 0.0, np.maximum(0.0, left - radius))
    return [
        {
            "task": task.id,
            "success": bool(success[i]),
            "spl": float(spl(success[i], geodesic[i], driven[i])),
            "steps": int(steps[i]),
            "collisions": int(collisions[i]),
            "path_length": float(driven[i]),
            "return": _return(geodesic[i] - remaining[i], int(steps[i]), bool(success[i])),
        }
        for i, task in enumerate(tasks)
    ]


def real_return(row: Row) -> float:
    """Compute the return of a sweep's episode from its SoftSPL, ``max(0, l - r) / max(p, l)``."""
    progress = row["soft_spl"] * max(row["path_length"], row["geodesic"])
    return _return(progress, row["steps"], row["success"])


def _return(progress: float, steps: int, success: bool) -> float:
    return float(max(0.0, progress) - POINTNAV_REWARD.step_cost * steps + POINTNAV_REWARD.success * success)
