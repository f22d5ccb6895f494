"""Compare robot-steps a second inside a learned map with those of the simulator, and their agreement: ``bench rl``.

A step includes all work of ``make_vec(...).step``: motion, collision, scan or image, reward, restart, and the returned
arrays. Actions are random and never stop; episodes are truncated after 500 steps, so that restarts are included. Real
rows are PointNav's: its default RGB-D images, and 64 rays, the real equivalent of an imagined scan.
"""

import os
import platform
import resource
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import vssm_gym  # noqa: F401  (registers the environments)
from vssm_gym.envs.world_model.step import programs
from vssm_gym.eval.bench.envs import ROBOTS, steps_a_second
from vssm_gym.eval.bench.imagined_replay import replay
from vssm_gym.progress import OnProgress

SCANS = (1, 16, 64, 256, 1024)  # robots of the imagined rows
IMAGES = (16, 64, 256)  # robots of the imagined rows with images
MAIN = 256  # robots of the rows with an aim
SCAN_AIM, IMAGE_AIM, RATIO_AIM = 150_000.0, 5_000.0, 50.0  # the project's own aims: steps/s, steps/s, their ratio
DRAWN_BATCHES = 50  # batches of actions drawn beforehand, because drawing them is not part of a step

Plan = tuple[str, int, Callable[[], float], float | None]  # what, robots, its rate, aim


def measure(
    scene: str, map_file: Path, *, steps: int = 1_000_000, seed: int = 0, on_progress: OnProgress | None = None
) -> dict[str, Any]:
    """Measure rates, memory, recompilations and agreement.

    Args:
        scene: of the real environment.
        map_file: learned from its images.
        steps: robot-steps over which memory is observed.
        seed: of tasks, noise and actions.
        on_progress: called with ("measuring", rows done, total).

    Returns:
        ``rows``: ``(what, robots, steps a second, aim or None)``; ``ratios`` of imagined to real rates; ``memory_mb``
        early and late and ``recompilations`` over ``steps``; ``replay`` (:mod:`vssm_gym.eval.bench.imagined_replay`).
    """
    import jax

    def imagined(what: str, observation: str, robots: int, aim: float) -> Plan:
        rate = lambda: _imagined(map_file, robots, seed, observation)
        return f"imagined, {what}", robots, rate, aim if robots == MAIN else None

    plans: list[Plan] = [
        *(imagined("scan", "scan", n, SCAN_AIM) for n in SCANS),
        *(imagined("depth 64x48", "depth", n, IMAGE_AIM) for n in IMAGES),
        ("real, RGB-D 160x120", 1, lambda: _real(scene, 1, seed), None),
        ("real, RGB-D 160x120", ROBOTS, lambda: _real(scene, ROBOTS, seed), None),
        ("real, 64 rays", ROBOTS, lambda: _real(scene, ROBOTS, seed, camera={"width": 64, "height": 1}), None),
        ("real, RGB-D 64x48", ROBOTS, lambda: _real(scene, ROBOTS, seed, camera={"width": 64, "height": 48}), None),
    ]
    rows = []
    for i, (what, robots, rate, aim) in enumerate(plans):
        rows.append((what, robots, rate(), aim))
        if on_progress:
            on_progress("measuring", i + 1, len(plans) + 2)
    rate_of = {(what, robots): rate for what, robots, rate, _ in rows}
    scan, depth = rate_of["imagined, scan", MAIN], rate_of["imagined, depth 64x48", MAIN]
    alone, many = (rate_of["real, RGB-D 160x120", n] for n in (1, ROBOTS))
    rays, images = rate_of["real, 64 rays", ROBOTS], rate_of["real, RGB-D 64x48", ROBOTS]
    ratios = [
        ("imagined scan / real RGB-D, one robot", scan / alone, RATIO_AIM),
        (f"imagined scan / real RGB-D, {ROBOTS} at once", scan / many, RATIO_AIM),
        (f"like for like: imagined scan / real 64 rays, {ROBOTS} at once", scan / rays, None),
        (f"imagined depth / real RGB-D 64x48, {ROBOTS} at once", depth / images, None),
    ]
    soaked = _soak(map_file, steps, seed)
    if on_progress:
        on_progress("measuring", len(plans) + 1, len(plans) + 2)
    agreement = replay(scene, map_file, seed=seed)
    if on_progress:
        on_progress("measuring", len(plans) + 2, len(plans) + 2)
    machine = {"cores": os.cpu_count(), "processor": platform.machine(), "device": str(jax.devices()[0])}
    return {"scene": scene, "rows": rows, "ratios": ratios, **soaked, "replay": agreement, "machine": machine}


def _imagined(map_file: Path, robots: int, seed: int, observation: str) -> float:
    env = gym.make_vec("vssm_gym/WorldModelNav-v0", num_envs=robots, map=map_file, observation=observation)
    env.reset(seed=seed)
    drive = _driver(env, seed)
    rate = steps_a_second(lambda: drive() * robots)
    env.close()
    return rate


def _real(scene: str, robots: int, seed: int, **keywords: Any) -> float:
    env = gym.make_vec("vssm_gym/PointNav-v0", num_envs=robots, scene=scene, **keywords)
    env.reset(seed=seed)
    drive = _driver(env, seed)
    rate = steps_a_second(lambda: drive() * robots)
    env.close()
    return rate


def _driver(env: Any, seed: int) -> Callable[[], int]:
    """Return a function that makes one step of the vector environment."""
    rng = np.random.default_rng(seed)
    actions = rng.uniform(env.action_space.low, env.action_space.high, (DRAWN_BATCHES, *env.action_space.shape))
    actions[..., -1] = 0.0
    batches, count = actions.astype(np.float32), 0

    def drive() -> int:
        nonlocal count
        env.step(batches[count % DRAWN_BATCHES])
        count += 1
        return 1

    return drive


def _soak(map_file: Path, steps: int, seed: int) -> dict[str, Any]:
    """Measure memory and compilations over many steps, with restarts by mask."""
    env = gym.make_vec("vssm_gym/WorldModelNav-v0", num_envs=MAIN, map=map_file)
    env.reset(seed=seed)
    drive = _driver(env, seed)
    some = np.arange(MAIN) % 32 == 0
    env.reset(options={"reset_mask": some})
    drive()
    compiled, early, batches = _compiled(), 0.0, max(10, steps // MAIN)
    for i in range(batches):
        drive()
        if i % 100 == 99:
            env.reset(options={"reset_mask": some})
        if i == batches // 10:
            early = _memory_mb()
    result = {
        "steps": batches * MAIN,
        "memory_mb": (early, _memory_mb()),
        "recompilations": _compiled() - compiled,
    }
    env.close()
    return result


def _compiled() -> int:
    return sum(program._cache_size() for one_core in (False, True) for program in programs(one_core))


def _memory_mb() -> float:
    """Return the resident memory of this process, or its peak where the system does not report it, MB."""
    status = Path("/proc/self/statm")
    if status.exists():
        return int(status.read_text().split()[1]) * resource.getpagesize() / 1e6
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)
