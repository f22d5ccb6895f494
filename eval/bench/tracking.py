"""Measure the error of localisation over drives: ``bench tracker`` and ``bench drift`` (TNP-SM, fig. 4)."""

import math
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from vssm_gym.eval.sweep import worker
from vssm_gym.progress import OnProgress

TRIAL_STEPS = 100  # of the robot in a trial
PUBLISHED_TURN, PUBLISHED_STEP = math.radians(3.0), 0.05  # rad; fraction of the body length (TNP-SM, section 5)
GOOD_RMSE = 0.1  # m, half a body length
# Filters of riders whose names differ
FILTER_OF = {"astar": "tracker", "no_map": "frames"}
DRIFT_METRES = 100.0  # path length over which drift is measured
COMPARED = 6  # drives on which the slow trackers ride along


@dataclass(frozen=True)
class _Trial:
    """Hold one drive to run, over a number of ``steps`` or ``metres``."""

    scene: str
    map_file: Path
    seed: int
    driver: str
    noise: tuple[float, float]
    riders: tuple[str, ...]
    steps: int | None = None
    metres: float | None = None


def tracker_trials(
    scene: str, map_file: Path, *, trials: int, workers: int, seed: int, on_progress: OnProgress
) -> dict:
    """Measure the location RMSE of the map tracker over drives of 100 steps that the oracle agent steers.

    On the first drives the published Adam tracker and the emission-based one ride along, on the same images.

    Returns:
        ``rmse`` of every trial (m), the proportion of them below 0.1 m, quantiles, and ``methods``: RMSE, lost steps
        and milliseconds a step of each tracker on the drives that it rode.
    """
    from vssm_gym.envs.robots import HolonomicRobot

    noise = (PUBLISHED_TURN, PUBLISHED_STEP * HolonomicRobot().body_length)
    jobs = [_Trial(scene, map_file, seed + i, "oracle", noise, _riders(i), steps=TRIAL_STEPS) for i in range(trials)]
    results = _run(jobs, workers, "tracker", on_progress)
    rmse = np.array([math.sqrt(np.mean(np.square(r["errors"]["astar"]))) for r in results])
    heading = np.array([r["heading_rmse"]["astar"] for r in results])
    return {
        "scene": scene,
        "trials": trials,
        "share_below_0.1m": float(np.mean(rmse < GOOD_RMSE)),
        "rmse_m": {q: float(np.quantile(rmse, float(q))) for q in ("0.5", "0.95", "0.99", "1.0")},
        "heading_rmse_deg": {q: float(np.degrees(np.quantile(heading, float(q)))) for q in ("0.5", "0.99", "1.0")},
        "lost_steps": float(np.mean([np.mean(r["lost"]["astar"]) for r in results])),
        "all_rmse_m": [round(float(v), 5) for v in rmse],
        "methods": {name: _method(name, results[:COMPARED]) for name in _riders(0)},
    }


def _riders(trial: int) -> tuple[str, ...]:
    """Return the localizers of a trial; the slow trackers ride along on the first drives only."""
    return ("astar", "adam", "emission") if trial < COMPARED else ("astar",)


def _method(name: str, results: list[dict]) -> dict[str, Any]:
    """Summarise one tracker over the drives on which all of them rode."""
    rmse = [math.sqrt(np.mean(np.square(r["errors"][name]))) for r in results]
    return {
        "drives": len(results),
        "rmse_m_median": float(np.median(rmse)),
        "rmse_m_max": float(np.max(rmse)),
        "lost_steps": float(np.mean([np.mean(r["lost"][name]) for r in results])),
        "ms_a_step": float(np.median([ms for r in results for ms in r["ms"][name]])),
    }


def drift_trials(scene: str, map_file: Path, *, trials: int, workers: int, seed: int, on_progress: OnProgress) -> dict:
    """Measure the location error over 100 m of chained goals that ``astar`` drives; all methods see the same images.

    Returns:
        Per method the error's RMSE (m) over the drive and its mean in each tenth of the path, averaged over drives.
    """
    from vssm_gym.envs.robots import NOISE_LEVELS

    noise, riders = NOISE_LEVELS["low"], ("astar", "no_map", "dead_reckoning")
    jobs = [
        _Trial(scene, map_file, seed + i, "astar", (noise.turn, noise.step), riders, metres=DRIFT_METRES)
        for i in range(trials)
    ]
    results = _run(jobs, workers, "drift", on_progress)
    tenths = np.linspace(0.0, DRIFT_METRES, 11)
    summary: dict[str, Any] = {"scene": scene, "drives": trials, "metres": DRIFT_METRES, "methods": {}}
    for name in riders:
        rows = []
        for result in results:
            driven, error = np.array(result["travelled"]), np.array(result["errors"][name])
            place = np.clip(np.digitize(driven, tenths) - 1, 0, 9)
            rows.append([float(error[place == i].mean()) if (place == i).any() else math.nan for i in range(10)])
        rmse = [math.sqrt(np.mean(np.square(result["errors"][name]))) for result in results]
        summary["methods"][name] = {
            "rmse_m": float(np.mean(rmse)),
            "rmse_m_each": [round(v, 4) for v in rmse],
            "mean_error_by_tenth_m": [round(float(v), 4) for v in np.nanmean(rows, axis=0)],
        }
    methods = summary["methods"]
    summary["astar_over_no_map"] = [
        round(a / b, 3) for a, b in zip(methods["astar"]["rmse_m_each"], methods["no_map"]["rmse_m_each"], strict=True)
    ]
    return summary


def _run(jobs: list[_Trial], workers: int, stage: str, on_progress: OnProgress) -> list[dict]:
    """Run all trials over spawned, single-threaded workers."""
    results = []
    context = multiprocessing.get_context("spawn")
    with (
        worker.single_threaded_children(),
        ProcessPoolExecutor(min(workers, len(jobs)), mp_context=context, initializer=worker.initialise) as pool,
    ):
        for result in pool.map(_trial, jobs):
            results.append(result)
            on_progress(stage, len(results), len(jobs))
    return results


def _trial(job: _Trial) -> dict[str, Any]:
    from vssm_gym.agents.shared.localization import FilteredPose
    from vssm_gym.eval.bench.drive import drive

    env, sampler, voxel_map, driver = _world(job.scene, job.noise, job.map_file, job.driver)
    riders = {name: _Timed(FilteredPose(FILTER_OF.get(name, name))) for name in job.riders}
    done = drive(env, sampler, driver, riders, voxel_map, seed=job.seed, steps=job.steps, metres=job.metres)
    turned = {name: done.estimates[name][:, 2] - done.true[:, 2] for name in riders}
    return {
        "travelled": done.travelled.tolist(),
        "errors": {name: done.location_error(name).tolist() for name in riders},
        "heading_rmse": {
            name: float(np.sqrt(np.mean(np.square((e + math.pi) % (2 * math.pi) - math.pi))))
            for name, e in turned.items()
        },
        "lost": {name: done.lost[name].tolist() for name in riders},
        "ms": {name: rider.ms for name, rider in riders.items()},
        "goals": done.goals,
    }


class _Timed:
    """Wrap a localizer and record the time of each update, ms."""

    def __init__(self, localizer: Any) -> None:
        self.localizer, self.ms = localizer, list[float]()

    def reset(self, context: Any, observation: Any) -> Any:
        """Reset the localizer; this compiles and is not timed."""
        return self.localizer.reset(context, observation)

    def update(self, command: np.ndarray, observation: Any) -> Any:
        """Update the localizer, which waits for its result."""
        began = time.perf_counter()
        belief = self.localizer.update(command, observation)
        self.ms.append(1e3 * (time.perf_counter() - began))
        return belief


@lru_cache(maxsize=1)
def _world(scene: str, noise: tuple[float, float], map_file: Path, driver: str) -> tuple[Any, ...]:
    """Build what a worker keeps between trials, so that nothing is compiled twice."""
    from vssm_gym.agents.registry import AGENTS
    from vssm_gym.envs.pointnav import PointNavEnv
    from vssm_gym.envs.robots import ExecutionNoise
    from vssm_gym.envs.tasks.navigation import TaskSampler
    from vssm_gym.maps.voxel_map import VoxelMap

    env = PointNavEnv(scene=scene, noise=ExecutionNoise(*noise), observe_pose=True, reward="sparse")
    return env, TaskSampler(env.apartment, env.robot), VoxelMap.load(map_file), AGENTS[driver]()
