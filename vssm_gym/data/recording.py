"""Drive through a scene and record it as a TUM folder: what maps are learned from (``vssm-gym record``).

The driver knows the floor plan and the true pose; what it leaves behind is images, commands and ground truth, as a
motion-capture hall would. Agents get the map made from them, never the recording or the plan.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from vssm_gym.camera import Camera
from vssm_gym.data.sequences import SequenceWriter
from vssm_gym.envs.pointnav import PointNavEnv
from vssm_gym.envs.survey import Waypoint, survey_route
from vssm_gym.envs.tasks import TaskSampler
from vssm_gym.errors import InputError
from vssm_gym.files import atomic_write
from vssm_gym.planning.pursuit import steer

PROVENANCE = "recording.json"  # beside TUM's files: which scene, driven how
ARRIVED = 0.06  # m from a waypoint; nearer than the noise of a step makes no sense


def record(
    scene: str | Path,
    out: Path,
    *,
    noise: str = "low",
    seed: int = 0,
    progress: Callable[[str, int, int], None] | None = None,
) -> int:
    """Drive the survey route of ``scene`` and turn around once at each viewpoint; returns the number of frames.

    Args:
        scene: built-in name or path of a scene file.
        out: new or empty folder; it appears whole or not at all.
        noise: execution noise of the drive; the recorded poses are the true ones.
        seed: of the route and of the noise.
        progress: told ("recording", waypoints passed, waypoints) after every waypoint.

    Raises:
        InputError: an unknown scene or noise, or a folder that is not empty.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(out, "folder", "an empty or new folder: a recording is never overwritten")
    env = PointNavEnv(scene=str(scene), noise=noise, observe_pose=True, reward="sparse")
    route = survey_route(env.apartment, env.robot, seed)
    provenance = {
        "scene": env.apartment.name,
        "scene_hash": env.apartment.content_hash(),
        "noise": noise,
        "renderer": env.renderer_name,
        "seed": seed,
    }
    out.parent.mkdir(parents=True, exist_ok=True)
    try:
        with atomic_write(out) as unfinished:
            frames = _drive(env, route, unfinished, seed, progress)
            (unfinished / PROVENANCE).write_text(json.dumps(provenance, indent=1) + "\n", encoding="utf-8")
    finally:
        env.close()
    return frames


def read_provenance(recording: Path) -> dict[str, Any]:
    """What :func:`record` wrote about a recording; empty for a folder that it did not write."""
    try:
        return json.loads((recording / PROVENANCE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


def _drive(
    env: PointNavEnv,
    route: list[Waypoint],
    folder: Path,
    seed: int,
    progress: Callable[[str, int, int], None] | None,
) -> int:
    """Follow the route from its first waypoint and write every image; returns how many."""
    ahead = next((w for w in route[1:]), route[0])
    heading = float(np.arctan2(ahead.y - route[0].y, ahead.x - route[0].x))
    sampler = TaskSampler(env.apartment, env.robot)
    task = sampler.task((route[0].x, route[0].y, heading), (route[-1].x, route[-1].y))
    observation, info = env.reset(seed=seed, options={"task": task})
    camera = Camera.from_matrix(info["K"], env.camera.width, env.camera.height)
    writer = SequenceWriter(folder, camera, env.robot.T_body_cam)
    frames = 0

    def write() -> None:
        nonlocal frames
        control, rgb, depth = info["control"], observation["rgb"], observation["depth"]
        writer.append(frames * env.robot.dt, rgb, depth, info["T_world_cam"], control)
        frames += 1

    def command(turn: float, offset: float, step: float) -> None:
        nonlocal observation, info
        observation, _, _, _, info = env.step(np.array([turn, offset, step, 0.0]))
        write()

    write()
    limits = env.robot.limits
    for i, waypoint in enumerate(route):
        target = np.array([waypoint.x, waypoint.y])
        # A robot that noise has pushed behind a corner slides along it; one that cannot pass goes on to the next.
        for _ in range(_patience(env.planar[:2], target, limits)):
            if np.hypot(*(env.planar[:2] - target)) < ARRIVED:
                break
            command(*steer(env.planar, np.array([env.planar[:2], target]), limits))
        if waypoint.turn_around:
            for _ in range(int(np.ceil(2.0 * np.pi / limits[0]))):
                command(limits[0], 0.0, 0.0)
        if progress:
            progress("recording", i + 1, len(route))
    writer.close()
    return frames


def _patience(xy: np.ndarray, target: np.ndarray, limits: np.ndarray) -> int:
    """Steps after which a leg is given up: twice a half turn and twice the way."""
    return int(2 * np.ceil(np.pi / limits[0]) + 2 * np.ceil(np.hypot(*(target - xy)) / limits[2]))
