"""Measure what agents say of faulty images: nobody is to claim an arrival that is none, nor to drive on lost for long.

An agent *claims* success where it stops and does not give up, an explorer where it says that it has finished. The
claim is wrong where a navigating robot is outside the success radius, or where an explorer is not where it believes to
be. A status other than ``ok`` *flags* the estimate. An estimate is wrong beyond ``WRONG_POSITION``; the steps in a row
with a wrong estimate and no flag are counted. A car claims nothing: its episode ends where it arrives.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from jaxtyping import Bool, Float

from vssm_gym.agents.base import Agent, Decision
from vssm_gym.agents.registry import make_agent
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.tasks.car_sets import make_car_tasks
from vssm_gym.envs.tasks.navigation import task_set
from vssm_gym.eval.faults.faulty_env import FaultyEnv
from vssm_gym.eval.protocols.agent_context import agent_context
from vssm_gym.inference.status import Status
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.progress import OnProgress
from vssm_gym.slam.map_building import ensure_map

WRONG_POSITION = 0.4  # m: the success radius of PointNav
SILENT_STEPS = 10  # steps in a row that a wrong estimate may go without a flag
FAULTS_NOISE = "low"
EXPLORED_STEPS = 150  # steps of an explorer's episode
FAULT_STEPS = 20  # steps of a fault that ends
# Thresholds were chosen with train tasks of reed and fern, and none with the car.
VOXEL = {"vssm_gym/PointNav-v0": 0.05, "vssm_gym/CarNav-v0": 0.03}  # m, of the learned maps
SCENES = {"vssm_gym/PointNav-v0": "oak", "vssm_gym/Explore-v0": "ivy", "vssm_gym/CarNav-v0": "depot"}


@dataclass(frozen=True)
class Case:
    """Hold one fault of an episode."""

    name: str
    fault: str  # of FaultyEnv
    steps: int | None  # None: to the end


CASES = (
    Case("frozen for 20", "frozen", FAULT_STEPS),
    Case("frozen to the end", "frozen", None),
    Case("blackout for 20", "blackout", FAULT_STEPS),
    Case("kidnapped", "kidnap", None),
    Case("shoved", "shove", None),
    Case("scaled depth", "scaled depth", None),
    Case("swapped depth", "swapped depth", None),
    Case("mirrored", "mirrored", None),
)
# agent -> environment, episodes of each case, step of the first faulty image
RUNS = {
    "astar": ("vssm_gym/PointNav-v0", 3, 10),
    "no_map": ("vssm_gym/PointNav-v0", 2, 10),
    "vi_mpc_estimated_pose": ("vssm_gym/CarNav-v0", 1, 10),
    "frontier_gain_estimated_pose": ("vssm_gym/Explore-v0", 1, 50),
}


@dataclass(frozen=True)
class FaultyEpisode:
    """Hold the outcome of one episode."""

    case: str
    agent: str
    task: int
    flagged: int | None  # steps of the fault before the first flag; None: none was raised
    silent: int  # most steps in a row with a wrong estimate and no flag
    error: float  # m, of the estimate at the end
    steps: int
    claimed: bool  # success
    wrong: bool  # the claim was wrong
    status: str  # the last one

    @property
    def passed(self) -> bool:
        """Return whether no claim was wrong and no wrong estimate went unflagged for long."""
        return not self.wrong and self.silent <= SILENT_STEPS


def run(folder: Path, *, seed: int = 0, on_progress: OnProgress | None = None) -> list[FaultyEpisode]:
    """Run every agent with every fault.

    Args:
        folder: for the maps of the scenes, which are kept and used again.
        seed: of the drives that the maps are learned from, and of the episodes.
        on_progress: called after every episode.
    """
    rows = []
    total = len(CASES) * sum(episodes for _, episodes, _ in RUNS.values())
    for name, (environment, episodes, first) in RUNS.items():
        agent, scene = make_agent(name), SCENES[environment]
        voxel_map = None
        if agent.needs_map:
            voxel = VOXEL[environment]
            voxel_map = VoxelMap.load(ensure_map(scene, folder, voxel=voxel, seed=seed, on_progress=on_progress))
        env, tasks = _environment(environment, scene), _tasks(environment, scene, episodes * len(CASES))
        for number, case in enumerate(case for case in CASES for _ in range(episodes)):
            faulty = FaultyEnv(env, case.fault, first, case.steps, seed=seed + number)
            rows.append(measure(faulty, agent, case.name, number, tasks[number], seed + number, voxel_map))
            if on_progress:
                on_progress("episodes with faults", len(rows), total)
        env.close()
    return rows


def measure(
    env: FaultyEnv,
    agent: Agent,
    case: str,
    task: int,
    options: dict[str, Any],
    seed: int,
    voxel_map: VoxelMap | None,
) -> FaultyEpisode:
    """Run one episode until it ends, or the agent gives up; ``options`` are those of the reset."""
    observation, info = env.reset(seed=seed, options=options)
    agent.reset(agent_context(env, info, voxel_map), observation, seed)
    decisions: list[Decision] = []
    ended = False
    while not ended:
        decisions.append(agent.act(observation))
        if decisions[-1].gives_up:
            break
        observation, _, terminated, truncated, info = env.step(decisions[-1].action)
        ended = terminated or truncated
    return judged(case, agent, task, decisions, np.array(env.true), env.first, bool(info.get("success", False)))


def judged(
    case: str,
    agent: Agent,
    task: int,
    decisions: Sequence[Decision],
    true: Float[np.ndarray, "time 3"],
    first: int,
    success: bool,
) -> FaultyEpisode:
    """Compare what an agent said with the truth.

    Args:
        case: name of the fault.
        agent: the agent.
        task: number of the episode.
        decisions: all that it made.
        true: pose at reset and after every step; as many as decisions, or one more.
        first: step of the first faulty image.
        success: of the environment, at the end.
    """
    estimates = np.array([[np.nan] * 2 if d.pose is None else d.pose[:2] for d in decisions])
    errors = np.linalg.norm(estimates - true[: len(decisions), :2], axis=1)
    flags = np.array([flagged(decision.status) for decision in decisions])
    raised = np.flatnonzero(flags[first:])
    last = decisions[-1]
    claimed = len(last.action) > 3 and bool(last.action[3] > 0.5) and not last.gives_up
    at_place = success if agent.task == "pointgoal" else errors[-1] <= WRONG_POSITION
    return FaultyEpisode(
        case=case,
        agent=agent.name,
        task=task,
        flagged=int(raised[0]) if len(raised) else None,
        silent=longest((errors > WRONG_POSITION) & ~flags),
        error=float(errors[-1]),
        steps=len(decisions),
        claimed=claimed,
        wrong=claimed and not at_place,
        status=last.status,
    )


def flagged(status: str) -> bool:
    """Return True where an agent's status says that its estimate is not to be believed."""
    return any(str(one) in status for one in Status if not one.accepted)


def longest(marks: Bool[np.ndarray, "time"]) -> int:
    """Return the length of the longest run of marks."""
    ends = np.flatnonzero(~np.concatenate([[False], marks, [False]]))
    return int(np.diff(ends).max()) - 1


def figures(rows: Sequence[FaultyEpisode]) -> dict[str, object]:
    """Return the rows and what they were judged by, for JSON."""
    rule = {"wrong_m": WRONG_POSITION, "silent_steps": SILENT_STEPS, "noise": FAULTS_NOISE, "scenes": SCENES}
    return {"rule": rule, "rows": [asdict(row) | {"passed": row.passed} for row in rows]}


def _environment(environment: str, scene: str) -> gym.Env:
    """Return the environment of a scene with images and without the pose."""
    more: dict[str, Any] = {"scene": scene, "noise": FAULTS_NOISE, "reward": "sparse"}
    if "Explore" in environment:
        more |= {"observe_pose": False, "finish": 2.0, "max_episode_steps": EXPLORED_STEPS}
    return gym.make(environment, disable_env_checker=True, **more)


def _tasks(environment: str, scene: str, n: int) -> list[dict[str, Any]]:
    """Return the options of ``n`` resets: test tasks of the scene."""
    apartment = load_scene(scene)
    if "CarNav" in environment:
        return [{"task": task} for task in make_car_tasks(apartment, n).tasks]
    tasks = task_set(apartment, HolonomicRobot(), "test", n).tasks
    if "Explore" in environment:
        return [{"start": np.array(task.start)} for task in tasks]
    return [{"task": task} for task in tasks]
