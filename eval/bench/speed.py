"""Measure the median time of every stage on frames of a drive through a scene: ``bench speed``.

The fast search and the fixed march are timed in turns, so that changes of the machine's speed affect both.
"""

import os
import platform
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vssm_gym.model.emission import RGBD
from vssm_gym.progress import OnProgress

EXTENT, VOXEL = 14.0, 0.07  # m: the published grid of 200^3 cells
FRAMES = 160  # of the drive
TIMED = 40  # frames on which every stage is timed
AIMS = {"image": 10.0, "tracker": 10.0, "map update": 10.0, "control loop": 30.0}  # ms, the project's own aims


class CompileCounter:
    """Count XLA compilations since its construction."""

    def __init__(self) -> None:
        import jax

        self.count = 0
        jax.monitoring.register_event_duration_secs_listener(self._heard)

    def _heard(self, event: str, duration_secs: float, **_: Any) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            self.count += 1


def median_ms(function: Callable[[int], Any], times: int) -> float:
    """Return the median wall-clock ms of ``function(i)`` with its JAX results; the first call is not counted."""
    import jax

    seconds = []
    for i in range(times + 1):
        began = time.perf_counter()
        jax.block_until_ready(function(i))
        seconds.append(time.perf_counter() - began)
    return 1e3 * float(np.median(seconds[1:]))


def speed(scene: str, map_file: Path, *, seed: int, on_progress: OnProgress) -> dict[str, Any]:
    """Time image, tracker, map update, environment, planner and control loop; medians in milliseconds.

    Args:
        scene: built-in name or path.
        map_file: the scene's learned map, for planner and agent; image, update and tracker use the published grid.
        seed: of the drive.
        on_progress: called after every stage.

    Returns:
        ``rows`` of (stage, value, unit, aim), and the machine.
    """
    import jax
    import jax.numpy as jnp

    from vssm_gym.agents.navigation.astar import AStarAgent
    from vssm_gym.envs.pointnav import PointNavEnv
    from vssm_gym.envs.tasks.navigation import TaskSampler
    from vssm_gym.eval.protocols.agent_context import context_in
    from vssm_gym.inference.filter import Rig
    from vssm_gym.inference.mapping import map_update
    from vssm_gym.inference.tracking.map_tracker import FrameTracker, MapTracker
    from vssm_gym.maps.voxel_map import VoxelMap
    from vssm_gym.model import emission
    from vssm_gym.model.posterior import Posterior
    from vssm_gym.model.transition import MotionNoise, Planar, planar_belief
    from vssm_gym.planning.clearance import ClearanceMap
    from vssm_gym.planning.grid_search.astar import plan

    stages = 7
    env = PointNavEnv(scene=scene, noise="low", observe_pose=True, reward="sparse")
    sampler = TaskSampler(env.apartment, env.robot)
    camera, noise = env.camera, (env.noise.turn, env.noise.step)
    config = map_update.MapUpdateConfig()
    observation, info = env.reset(seed=seed, options={"task": sampler.draw(np.random.default_rng(seed))})
    centre = np.array([*np.mean([p for room in env.apartment.rooms for p in room.polygon], axis=0), 1.0])
    m = VoxelMap.cube(centre, EXTENT, VOXEL)

    def images(observation: dict, info: dict) -> tuple[Any, Any]:
        return RGBD.from_camera(observation["rgb"], observation["depth"]), jnp.asarray(info["T_world_cam"], jnp.float32)

    # A random drive through free space; its time a step is the environment's own speed.
    rng = np.random.default_rng(seed)
    frames, controls, seconds = [images(observation, info)], [np.zeros(3, np.float32)], []
    while len(frames) < FRAMES:
        turn = 0.2 if len(frames) % 64 < 32 else float(rng.uniform(-0.2, 0.2))
        action = np.array([turn, 0.0, 0.12 if len(frames) % 64 >= 32 else 0.0, 0.0], np.float32)
        began = time.perf_counter()
        observation, _, _, _, info = env.step(action)
        seconds.append(time.perf_counter() - began)
        frames.append(images(observation, info))
        controls.append(action[:3])
    rows: list[tuple[str, float, str, float | None]] = [
        ("environment, RGB-D 160x120", 1.0 / float(np.median(seconds)), "steps/s", 350.0)
    ]
    on_progress("bench", 1, stages)

    updates = []
    for image, T in frames:
        began = time.perf_counter()
        m = jax.block_until_ready(map_update.update(m, image.depth, image.rgb, T, camera, config))
        updates.append(time.perf_counter() - began)
    shape = "x".join(str(n) for n in m.shape)
    rows.append((f"map update, {shape} cells", 1e3 * float(np.median(updates[1:])), "ms", AIMS["map update"]))
    on_progress("bench", 2, stages)

    counter = CompileCounter()
    march = jax.jit(lambda m, T: emission.render_with(emission.march, m, T, camera))
    poses = [T for _, T in frames[-TIMED - 1 :]]
    differing = np.mean([_differing(emission.render(m, T, camera), march(m, T)) for T in poses])
    before = counter.count
    fast: list[float] = []
    slow: list[float] = []
    for T in poses:
        for function, times in ((lambda T=T: emission.render(m, T, camera), fast), (lambda T=T: march(m, T), slow)):
            began = time.perf_counter()
            jax.block_until_ready(function())
            times.append(time.perf_counter() - began)
    rows.append((f"image 160x120, {shape} cells, skipping search", 1e3 * float(np.median(fast)), "ms", AIMS["image"]))
    rows.append((f"image 160x120, {shape} cells, fixed march", 1e3 * float(np.median(slow)), "ms", None))
    on_progress("bench", 3, stages)

    rig = Rig.of(camera, env.robot.T_body_cam)
    motion = Planar(MotionNoise(jnp.float32(noise[0]), jnp.float32(noise[1])))
    recompiled = counter.count - before

    def begun(i: int, tracker: Any) -> Any:
        start = jnp.asarray(np.asarray(_planar(frames[i][1]), np.float32))
        prior = Posterior(planar_belief(start, 1e-6 * jnp.eye(3)), m)
        return tracker.init(prior, frames[i][0], jax.random.key(0))

    def step(i: int, tracker: Any, states: list[Any]) -> Any:
        control = jnp.asarray(controls[i + 1], jnp.float32)
        return tracker.step(states[i], control, frames[i + 1][0], env.robot.dt)[0].past

    in_map, by_frames = (
        partial(step, tracker=tracker, states=[begun(i, tracker) for i in range(TIMED + 1)])
        for tracker in (MapTracker(rig, motion), FrameTracker(rig, motion))
    )
    jax.block_until_ready((in_map(0), by_frames(0)))
    before = counter.count
    rows.append(("tracker step, image at hand", median_ms(by_frames, TIMED), "ms", AIMS["tracker"]))
    rows.append(("tracker step, image included", median_ms(in_map, TIMED), "ms", None))
    recompiled += counter.count - before
    on_progress("bench", 4, stages)

    learned = VoxelMap.load(map_file)
    clearance = ClearanceMap.from_voxel_map(learned, 0.08, 0.5, 0.025)
    ends = [sampler.draw(np.random.default_rng([seed, i])) for i in range(TIMED + 1)]
    planner = median_ms(
        lambda i: (
            plan(np.array(ends[i].start), np.array(ends[i].goal), clearance, env.robot.radius, goal_radius=0.35).cost
        ),
        TIMED,
    )
    rows.append(("planner, A* across the scene", planner, "ms", None))
    on_progress("bench", 5, stages)

    agent, loops, alone = AStarAgent(), [], []
    for i in range(3):
        observation, info = env.reset(seed=seed + i, options={"task": ends[i]})
        agent.reset(context_in(env, info, learned, env.noise), observation, seed)
        before = counter.count
        for _ in range(60):
            began = time.perf_counter()
            decision = agent.act(observation)
            decided = time.perf_counter()
            if decision.action[3] > 0.5:
                break
            observation, _, _, _, info = env.step(decision.action)
            alone.append(decided - began)
            loops.append(time.perf_counter() - began)
        recompiled += counter.count - before
    rows.append(("agent: track, plan, steer", 1e3 * float(np.median(alone[1:])), "ms", None))
    rows.append(("control loop with the environment", 1e3 * float(np.median(loops[1:])), "ms", AIMS["control loop"]))
    on_progress("bench", 7, stages)
    return {
        "scene": scene,
        "rows": [list(row) for row in rows],
        "pixels_where_search_and_march_differ": float(differing),
        "recompilations_after_the_first_step": recompiled,
        "machine": {
            "cores": os.cpu_count(),
            "processor": platform.machine(),
            "jax_device": str(jax.devices()[0]),
            "renderer": env.renderer_name,
        },
    }


def _differing(a: Any, b: Any) -> float:
    """Return the proportion of pixels whose hits differ, or whose depths differ by more than 0.1 mm."""
    return float(np.mean((np.asarray(a.hit) != np.asarray(b.hit)) | (np.abs(np.asarray(a.depth - b.depth)) > 1e-4)))


def _planar(T_world_cam: Any) -> np.ndarray:
    """Return the robot's planar pose below a level camera that looks along its x axis."""
    T = np.asarray(T_world_cam, np.float64)
    return np.array([T[0, 3], T[1, 3], np.arctan2(T[1, 2], T[0, 2])])
