"""Drive a random policy through all environments for a long time and check every step: ``bench soak``.

Observations must lie inside their spaces (so no NaN), rewards be finite, no body be inside an obstacle by more than
``PENETRATION`` (computed from geometry, not from the simulator's contacts), and memory must not grow.
"""

import gc
import resource
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
import numpy as np
from shapely import Point, contains_xy, prepare

import vssm_gym  # noqa: F401  (registers the environments)
from vssm_gym.envs.tasks.navigation import START_SLACK
from vssm_gym.progress import OnProgress

APARTMENTS = ("vssm_gym/PointNav-v0", "vssm_gym/ImageNav-v0", "vssm_gym/Explore-v0")
PROCEDURAL = 10  # procedural apartments that each environment drives in
GROWTH = 100.0  # MB: growth from the first tenth to the end that caches explain
PENETRATION = 0.006  # m: contacts are found no deeper than a substep, 5 mm (envs/physics/floor_world.py)
SEEING = {"camera": {"width": 40, "height": 30}, "sensor_noise": "kinect"}
CAR_SCENE = "arena"


class SoakError(RuntimeError):
    """Report a failed check: its environment, scene, seed and step."""


def soak(*, steps: int = 100_000, seed: int = 0, on_progress: OnProgress | None = None) -> dict[str, Any]:
    """Drive ``steps`` in all, over every environment and ten procedural apartments.

    Returns:
        ``rows``: ``(environment, scene, steps, episodes, steps with a collision, deepest penetration in mm)``;
        ``memory_mb`` after the first tenth and at the end.

    Raises:
        SoakError: with the step, at the first failed check.
    """
    sizes = ("small", "medium", "large")
    scenes = [f"procedural:{seed + i}:{sizes[i % 3]}" for i in range(PROCEDURAL)]
    plans = [(name, scene, SEEING) for scene in scenes for name in APARTMENTS]
    plans += [("vssm_gym/LidarMaze-v0", "rooms-v1", {}), ("vssm_gym/Flight-v0", "hall", SEEING)]
    plans += [("vssm_gym/PointNav-v0", "elm", SEEING), *(("vssm_gym/CarNav-v0", CAR_SCENE, car) for car in _cars())]
    part, rows, memory = -(-steps // len(plans)), [], []
    for i, (name, scene, keywords) in enumerate(plans):
        world = f"{scene}, {keywords['physics']}" if "physics" in keywords else scene
        rows.append((name.removeprefix("vssm_gym/"), world, *_drive(name, scene, part, seed, keywords)))
        if i + 1 == max(1, len(plans) // 10) or i + 1 == len(plans):
            memory.append(_resident_mb())
        if on_progress:
            on_progress("driving at random", i + 1, len(plans))
    memory = [memory[0], memory[-1]]
    if memory[1] > memory[0] + GROWTH:
        raise SoakError(f"memory grew from {memory[0]:.0f} to {memory[1]:.0f} MB")
    return {"scene": f"{len(plans)} worlds", "rows": rows, "memory_mb": memory, "steps": part * len(plans)}


def _cars() -> list[dict[str, Any]]:
    """Return CarNav's keywords for each simulator that is installed."""
    simulators = ["mujoco", "bullet"] if find_spec("pybullet") else ["mujoco"]
    return [SEEING | {"physics": physics} for physics in simulators]


def _drive(name: str, scene: str, steps: int, seed: int, keywords: dict[str, Any]) -> tuple[int, int, int, float]:
    env = gym.make(name, scene=scene, noise="high", **keywords)
    world: Any = env.unwrapped
    inside = _penetration(world)
    rng = np.random.default_rng(seed)
    low, high = env.action_space.low, env.action_space.high  # type: ignore[attr-defined]
    env.reset(seed=seed)
    episodes, collisions, deepest, drift = 1, 0, 0.0, np.zeros(low.shape)
    for k in range(steps):
        if k % 10 == 0:  # a constant drift for 10 steps presses the robot against walls
            drift = rng.uniform(low, high)
        action = np.clip(drift + 0.2 * (high - low) * rng.standard_normal(low.shape), low, high)
        if "Flight" in name:  # hovers under random forces
            action = 0.1 * action + np.array([0.0, 0.0, 9.81, 0.0, 0.0, 0.0])
        elif "Car" not in name:
            action[-1] = float(rng.random() < 0.002)
        observation, reward, terminated, truncated, info = env.step(action.astype(np.float32))
        depth = inside()
        deepest = max(deepest, depth)
        if not env.observation_space.contains(observation) or not np.isfinite(float(reward)) or depth > PENETRATION:
            raise SoakError(f"{name} in {scene}, seed {seed}, step {k}: {1e3 * depth:.1f} mm inside, reward {reward}")
        collisions += bool(info["collision"])
        if terminated or truncated:
            env.reset()
            episodes += 1
    env.close()
    return steps, episodes, collisions, 1e3 * deepest


def _penetration(world: Any) -> Callable[[], float]:
    """Return a function that computes how deep the body is in an obstacle, m, from polygons or exact distances.

    The depth is infinite for a robot that has left its part of free space through a wall.
    """
    if hasattr(world, "simulation"):
        space, radius = world.simulation.scene_cache.sampler.space, world.simulation.robot.radius
        reachable = space.largest.buffer(START_SLACK)
        prepare(reachable)

        def of_plan() -> float:
            xy = world.simulation.planar[:2]
            if not contains_xy(reachable, *xy):
                return np.inf
            return max(0.0, radius - float(space.distance_to_solid(xy)))

        return of_plan
    if hasattr(world, "car"):
        shrunk = np.arange(0.0, 0.02, 0.0005)

        def of_car() -> float:
            for by in shrunk:
                if world.sampler.space.free(world.planar, -by):
                    return float(by)
            return np.inf

        return of_car
    if hasattr(world, "maze"):
        from vssm_gym.envs.physics.planar import clearance

        return lambda: max(
            0.0, world.robot.radius - float(clearance(world.planar[0], world.planar[1], world.maze.rectangles))
        )
    from vssm_gym.envs.scenes.solids import footprint

    solids = [(box, footprint(box)) for box in world.renderer.boxes]

    def of_ball() -> float:
        x, y, z = world.state.position
        point, nearest = Point(x, y), np.inf
        for box, shape in solids:
            above = max(abs(z - box.center[2]) - 0.5 * box.size[2], 0.0)
            if above < world.body.radius:
                nearest = min(nearest, float(np.hypot(shape.distance(point), above)))
        return max(0.0, world.body.radius - nearest)

    return of_ball


def _resident_mb() -> float:
    """Return what this process holds in memory now (Linux), or held at most (elsewhere), MB.

    Worlds that were closed are cycles of objects: in a process that holds many others they would wait for a full
    collection for long, and look like a leak.
    """
    gc.collect()
    try:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * resource.getpagesize() / 2**20
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
