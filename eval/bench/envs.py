"""Measure steps a second of the environments through ``gym.make`` and ``gym.make_vec``: ``bench envs``.

A step includes physics, rays, shading, reward, observation and info. Rates are medians over windows of random actions
that never stop; the same windows for every row. Two rows render depth images only, as the camera does and by Embree,
which shows the cost of a ray tracer.
"""

import importlib.util
import os
import platform
import time
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

import vssm_gym  # noqa: F401  (registers the environments)
from vssm_gym.envs.physics.tracing import EmbreeTracer
from vssm_gym.envs.rendering.raycast import RaycastCamera
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.geometry.transforms import R_BODY_CAM
from vssm_gym.progress import OnProgress

WINDOWS, WINDOW_SECONDS = 5, 1.0  # windows a row, and their least length, s
ROBOTS = 16  # of a vector environment
SCENE = "oak"


def measure(*, scene: str = SCENE, seed: int = 0, on_progress: OnProgress | None = None) -> dict[str, Any]:
    """Measure the rates of every kind of environment.

    Args:
        scene: of the apartments' environments.
        seed: of tasks, noise and actions.
        on_progress: called with ("measuring", rows done, total).

    Returns:
        ``rows``: ``(what, steps a second, cores, aim or None)``; ``shapes`` of the scene; the machine; ``peer``: why
        MiniWorld was not measured, or None.
    """
    scan: dict[str, Any] = {"camera": {"width": 64, "height": 1}}
    two = min(2, os.cpu_count() or 1)
    plans: list[tuple[str, Callable[[], float], int, float | None]] = [
        ("RGB-D 160x120", lambda: _alone("PointNav", scene, seed), 1, 1200.0),
        (f"the same, {ROBOTS} at once", lambda: _many("PointNav", scene, seed), two, 700.0),
        ("RGB-D 160x120 as a Kinect sees", lambda: _alone("PointNav", scene, seed, sensor_noise="kinect"), 1, None),
        ("depth images alone, 160x120", lambda: _images(scene, seed, traced=False), 1, None),
        ("the same by Embree's rays", lambda: _images(scene, seed, traced=True), 1, None),
        ("64 rays", lambda: _alone("PointNav", scene, seed, **scan), 1, None),
        (f"64 rays, {ROBOTS} at once", lambda: _many("PointNav", scene, seed, **scan), two, None),
        ("Explore", lambda: _alone("Explore", scene, seed), 1, None),
        ("Flight", lambda: _alone("Flight", "hall", seed), 1, None),
        ("LidarMaze, 64 rays", lambda: _alone("LidarMaze", None, seed), 1, None),
    ]
    peer = None if importlib.util.find_spec("miniworld") else "MiniWorld is not installed"
    if peer is None:
        plans.append(("MiniWorld-FourRooms-v0, RGB + depth 160x120", lambda: _miniworld(seed), 1, None))
    rows = []
    for i, (what, rate, cores, aim) in enumerate(plans):
        try:
            rows.append((what, rate(), cores, aim))
        except Exception as error:  # a peer may fail with a reason; our environments may not
            if not what.startswith("MiniWorld"):
                raise
            peer = f"MiniWorld does not run here: {' '.join(str(error).split()):.200}"
        if on_progress:
            on_progress("measuring", i + 1, len(plans))
    shapes = len(load_scene(scene).boxes())
    machine = {"cores": os.cpu_count(), "processor": platform.machine()}
    return {"scene": scene, "shapes": shapes, "rows": rows, "peer": peer, "machine": machine}


def _alone(kind: str, scene: str | None, seed: int, **keywords: Any) -> float:
    if scene is not None:
        keywords["scene"] = scene
    env = gym.make(f"vssm_gym/{kind}-v0", **keywords)
    env.reset(seed=seed)
    low, high = env.action_space.low, env.action_space.high  # type: ignore[attr-defined]
    rng = np.random.default_rng(seed)

    def step() -> int:
        action = rng.uniform(low, high)
        if kind != "Flight":
            action[-1] = 0.0
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()
        return 1

    rate = steps_a_second(step)
    env.close()
    return rate


def _many(kind: str, scene: str, seed: int, **keywords: Any) -> float:
    env = gym.make_vec(f"vssm_gym/{kind}-v0", num_envs=ROBOTS, scene=scene, **keywords)
    env.reset(seed=seed)
    low, high = env.action_space.low, env.action_space.high  # type: ignore[attr-defined]
    rng = np.random.default_rng(seed)

    def step() -> int:
        actions = rng.uniform(low, high)
        actions[:, -1] = 0.0
        env.step(actions.astype(np.float32))
        return ROBOTS

    rate = steps_a_second(step)
    env.close()
    return rate


def _images(scene: str, seed: int, traced: bool) -> float:
    """Measure depth images a second from random poses, as the camera renders them or by Embree's rays."""
    boxes, camera = load_scene(scene).boxes(), CameraConfig().intrinsics()
    drawn, tracer = RaycastCamera(boxes, camera), EmbreeTracer(boxes)
    rays = np.asarray(camera.rays(), dtype=np.float64).reshape(-1, 3)
    rng = np.random.default_rng(seed)
    low, high = (edge([box.center for box in boxes], axis=0) for edge in (np.min, np.max))

    def step() -> int:
        heading = rng.uniform(-np.pi, np.pi)
        c, s = np.cos(heading), np.sin(heading)
        R_world_cam = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ R_BODY_CAM
        origin = np.array([*rng.uniform(low[:2], high[:2]), 0.4])
        if traced:
            tracer.trace(origin, (rays @ R_world_cam.T).astype(np.float32))
        else:
            T_world_cam = np.eye(4)
            T_world_cam[:3, :3], T_world_cam[:3, 3] = R_world_cam, origin
            drawn.first_boxes(T_world_cam)
        return 1

    return steps_a_second(step)


def steps_a_second(step: Callable[[], int]) -> float:
    """Return the median steps a second over the windows, after a warm-up that compiles and allocates."""
    warm = time.perf_counter() + 0.3
    while time.perf_counter() < warm:
        step()
    rates = []
    for _ in range(WINDOWS):
        began, done = time.perf_counter(), 0
        while (now := time.perf_counter()) < began + WINDOW_SECONDS:
            done += step()
        rates.append(done / (now - began))
    return float(np.median(rates))


def _miniworld(seed: int) -> float:
    """Measure MiniWorld's four bare rooms, colour and depth at our size."""
    import miniworld  # noqa: F401  (registers its environments)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = gym.make("MiniWorld-FourRooms-v0", obs_width=160, obs_height=120)
        env.reset(seed=seed)
        rng = np.random.default_rng(seed)
        world: Any = env.unwrapped

        def step() -> int:
            _, _, terminated, truncated, _ = env.step(int(rng.integers(3)))
            world.render_depth()
            if terminated or truncated:
                env.reset()
            return 1

        rate = steps_a_second(step)
        env.close()
    return rate
