"""Compare imagined with real rollouts: the same starts and commands, without noise, in WorldModelNav and PointNav.

    position error of a rollout = |xy_imagined(T) - xy_real(T)|,   scan error = |scan_imagined - scan_real|  per ray
    return error = |sum of rewards imagined - sum of rewards real|

Commands are random: correlated turns and steps from slow to full speed, so that robots collide as learners do.
Rollouts with a collision in either world are counted, and their errors are also given apart.
"""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import vssm_gym  # noqa: F401  (registers the environments)
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scan_wrapper import ScanObservation
from vssm_gym.maps.voxel_map import VoxelMap

ROLLOUT_SECONDS = 5.0  # of a rollout


def commands(rng: np.random.Generator, steps: int) -> np.ndarray:
    """Draw commands ``(steps, 4)`` float32 of (turn, o, s, stop = 0)."""
    robot = HolonomicRobot()
    turn, out = 0.0, np.zeros((steps, 4), np.float32)
    for i in range(steps):
        turn = 0.8 * turn + 0.6 * rng.normal(0.0, 0.5 * robot.max_turn)
        offset = rng.uniform(-robot.max_offset, robot.max_offset)
        out[i, :3] = robot.clip(np.array([turn, offset, rng.uniform(0.25, 1.0) * robot.max_step]))
    return out


def replay(scene: Any, belief: Path | VoxelMap, *, rollouts: int = 100, seed: int = 0) -> dict[str, Any]:
    """Measure the errors of imagination in a map of ``scene``.

    Returns:
        Medians and 90th percentiles of the position error at the end (m), of the scans (m, rays and steps of all
        rollouts, where both worlds have a reading) and of the return, over ``all`` rollouts, those ``free`` of
        collisions, and the ``collided`` ones; ``collisions``, the number of the latter.
    """
    real = gym.make(
        "vssm_gym/PointNav-v0",
        scene=scene,
        noise="none",
        camera={"width": 64, "height": 1},
        observe_pose=True,
        max_episode_steps=-1,
    )
    real = ScanObservation(real)
    steps = round(ROLLOUT_SECONDS / HolonomicRobot().dt)
    rng = np.random.default_rng(seed)
    acts = np.stack([commands(rng, steps) for _ in range(rollouts)], axis=1)  # (steps, rollouts, 4)
    tasks, at, seen, collided = (
        [],
        np.zeros((steps, rollouts, 2)),
        np.zeros((steps, rollouts, 64)),
        np.zeros(rollouts, bool),
    )
    gained = np.zeros(rollouts)  # imagined less real
    for i in range(rollouts):
        _, info = real.reset(seed=seed + i)
        tasks.append(info["task"])
        for t in range(steps):
            observation, reward, _, _, info = real.step(acts[t, i])
            gained[i] -= reward
            at[t, i], seen[t, i] = observation["pose"][:2], observation["scan"]
            collided[i] |= info["collision"]
    real.close()
    imagined = gym.make_vec(
        "vssm_gym/WorldModelNav-v0",
        num_envs=rollouts,
        map=belief,
        noise="none",
        pose_std=(0.0, 0.0, 0.0),
        tasks=tasks,
        max_episode_steps=-1,
    )
    imagined.reset(seed=seed, options={"task": np.arange(rollouts)})
    off, scans = np.zeros((steps, rollouts)), np.full((steps, rollouts, 64), np.nan)
    for t in range(steps):
        observation, rewards, _, _, infos = imagined.step(acts[t])
        gained += rewards
        off[t] = np.hypot(*(observation["pose"][:, :2] - at[t]).T)
        both = (observation["scan"] > 0.0) & (seen[t] > 0.0)
        scans[t] = np.where(both, np.abs(observation["scan"] - seen[t]), np.nan)
        collided |= infos["collision"]
    imagined.close()
    result: dict[str, Any] = {"rollouts": rollouts, "seconds": ROLLOUT_SECONDS, "collisions": int(collided.sum())}
    for name, chosen in (("all", np.ones(rollouts, bool)), ("free", ~collided), ("collided", collided)):
        if chosen.any():
            result[name] = {
                "position_m": _quantiles(off[-1, chosen]),
                "scan_m": _quantiles(scans[:, chosen]),
                "return": _quantiles(np.abs(gained[chosen])),
                "rays_compared": float(np.isfinite(scans[:, chosen]).mean()),
            }
    return result


def _quantiles(errors: np.ndarray) -> dict[str, float]:
    errors = errors[np.isfinite(errors)]
    return {"p50": float(np.median(errors)), "p90": float(np.quantile(errors, 0.9))}
