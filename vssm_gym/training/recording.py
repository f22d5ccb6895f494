"""Record one task driven by one policy twice, in the simulator and in the learned map, for a video of both.

Both begin at the task's start and end where the policy stops or time is out. The simulator's run repeats the sweep's
episode of that task; the imagined one has the random stream that ``evaluate`` gives it among all tasks.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from vssm_gym.agents.policy import policy_file
from vssm_gym.agents.registry import make_agent
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.scenes.specs import scene_name
from vssm_gym.envs.tasks.navigation import Task, load
from vssm_gym.eval.protocols import pointnav as pointnav_protocol
from vssm_gym.eval.protocols.episode import StepRecord
from vssm_gym.eval.sweep.config import SweepConfig, expand
from vssm_gym.eval.video.plans import CroppedPlan
from vssm_gym.files.shipped import POLICIES, shipped
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.scan import BEAMS, scan_of
from vssm_gym.geometry.transforms import planar_to_matrix
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import render
from vssm_gym.planning.occupancy_grid import FREE, OCCUPIED, UNKNOWN
from vssm_gym.progress import OnProgress
from vssm_gym.training.evaluation import files_of
from vssm_gym.training.imagined_episodes import STEPS, ImaginedStep, imagine
from vssm_gym.viz import pictures

SIMULATOR_CELL = 0.025  # m, of the simulator's floor plan
PLAN_MARGIN = 0.3  # m, margin of that plan
ROBOT = HolonomicRobot()


@dataclass(frozen=True)
class PolicyMoment:
    """Hold one moment of a run.

    Attributes:
        seconds: since the start.
        planar: the true pose: x, y (m), heading (rad).
        estimate: the pose estimate that the policy receives.
        hits: ends of the rays of its scan, world, m; rays without a reading are left out.
        image: its camera's image; in imagination the belief rendered from there.
        collisions: steps in contact so far.
        status: the agent's status.
    """

    seconds: float
    planar: Float[np.ndarray, "3"]
    estimate: Float[np.ndarray, "3"]
    hits: Float[np.ndarray, "n 2"]
    image: UInt8[np.ndarray, "height width 3"]
    collisions: int
    status: str


@dataclass(frozen=True)
class PolicyRun:
    """Hold one of the two runs.

    Attributes:
        moments: one a step, the stop included.
        plan: floor plan at the heights of the robot's body.
        success: whether it stopped at the goal.
        ending: how it ended, in words.
    """

    moments: tuple[PolicyMoment, ...]
    plan: CroppedPlan
    success: bool
    ending: str

    def path(self, name: str, n: int) -> Float[np.ndarray, "n 2"]:
        """Return xy of ``planar`` or ``estimate`` of the first ``n`` moments, m."""
        return np.array([getattr(moment, name)[:2] for moment in self.moments[:n]])


@dataclass(frozen=True)
class PolicyRuns:
    """Hold both runs of one task; ``label`` is the policy's name and hash, ``success_radius`` in m."""

    label: str
    scene: str
    task: Task
    success_radius: float
    real: PolicyRun
    imagined: PolicyRun

    def __len__(self) -> int:
        return max(len(self.real.moments), len(self.imagined.moments))


def record_runs(
    policy: Path,
    out: Path,
    *,
    scene: str,
    task: int,
    robot: str = "holonomic",
    noise: str = "low",
    transition: Path | None = None,
    seed: int = 0,
    on_progress: OnProgress | None = None,
) -> PolicyRuns:
    """Drive one task of an evaluation in both worlds.

    Args:
        policy: file of `vssm-gym train`, or the name of a policy that comes with the package.
        out: folder of :func:`vssm_gym.training.evaluation.evaluate_policy`, which has run with the same arguments.
        scene: built-in name or path of a scene file.
        task: number of the test task.
        robot: that drives in the simulator.
        noise: of execution.
        transition: by which the robot moves in imagination; None: by the holonomic robot's law.
        seed: of imagination.
        on_progress: called with ("driving" | "imagining", done, total).

    Raises:
        InputError: a task that does not fit the map.
    """
    policy = shipped(policy, POLICIES)
    task_file, agents_map = files_of(out, scene)
    wanted = load(task_file).tasks[task]
    # First the run that may be refused
    imagined = _imagined(policy, agents_map, wanted, noise, transition, seed + task, on_progress)
    agent = f"{policy_file.PREFIX}{policy.resolve()}"
    config = SweepConfig(scenes=(scene,), agents=(agent,), robot=(robot,), noise=(noise,), tasks=(task,))
    real = _real(config, task_file, VoxelMap.load(agents_map), on_progress)
    radius = policy_file.load(str(policy)).spec.success_radius
    return PolicyRuns(policy_file.agent_label(agent), scene_name(scene), wanted, radius, real, imagined)


def _real(config: SweepConfig, task_file: Path, m: VoxelMap, on_progress: OnProgress | None) -> PolicyRun:
    (episode,) = expand(config)
    agent: Any = make_agent(episode.agent)
    spec, moments, collisions = agent.policy.spec, [], 0

    def see(step: StepRecord) -> None:
        nonlocal collisions
        collisions += bool(step.info["collision"])
        assert step.decision.pose is not None
        hits = ray_ends(step.planar, scan_of(step.observation["depth"], spec.max_depth), spec.hfov)
        image, status = np.array(step.observation["rgb"]), step.decision.status
        moments.append(PolicyMoment(step.seconds, step.planar, step.decision.pose, hits, image, collisions, status))
        if on_progress:
            on_progress("driving", step.number, STEPS)

    row = pointnav_protocol.run(episode, agent, task_file, m, see)
    if on_progress:
        on_progress("driving", STEPS, STEPS)
    ending = "arrived" if row["success"] else str(row["failure"])
    return PolicyRun(tuple(moments), true_plan(episode.condition.scene), bool(row["success"]), ending)


def _imagined(
    policy: Path,
    map_file: Path,
    task: Task,
    noise: str,
    transition: Path | None,
    seed: int,
    on_progress: OnProgress | None,
) -> PolicyRun:
    network, moments, collisions = policy_file.load(str(policy)), [], 0
    m, steps, hfov = VoxelMap.load(map_file), [], network.spec.hfov

    def see(step: ImaginedStep) -> None:
        steps.append(step)
        if on_progress:
            on_progress("imagining", step.number, STEPS)

    (row,) = imagine(network, map_file, [task], noise, seed, see, transition)
    for step in steps:
        planar, estimate = (np.asarray(a[0], np.float64) for a in (step.planar, step.observation["pose"]))
        collisions += bool(step.collision[0])
        hits = ray_ends(planar, step.observation["scan"][0], hfov)
        status = "arrived" if step.stop[0] else "driving"
        image = _seen(m, planar, hfov)
        moments.append(PolicyMoment(step.number * ROBOT.dt, planar, estimate, hits, image, collisions, status))
    if on_progress:
        on_progress("imagining", STEPS, STEPS)
    away = float(np.linalg.norm(moments[-1].planar[:2] - task.goal))
    failure = f"{'stopped outside' if steps[-1].stop[0] else 'time out'}: {away:.2f} m from the goal"
    return PolicyRun(tuple(moments), CroppedPlan.of(m), row["success"], "arrived" if row["success"] else failure)


def ray_ends(planar: Float[np.ndarray, "3"], scan: Float[np.ndarray, "beams"], hfov: float) -> Float[np.ndarray, "n 2"]:
    """Return the world points (m) of a scan's readings; the camera is on the robot's axis and looks ahead.

    Ray k is left of the middle by ``tan(hfov / 2) (1 - 2 (k + 1/2) / 64)`` a metre of depth
    (:mod:`vssm_gym.geometry.scan`).
    """
    left = math.tan(0.5 * hfov) * (1.0 - 2.0 * (np.arange(BEAMS) + 0.5) / BEAMS)
    read = scan > 0.0
    ahead, aside = scan[read], (left * scan)[read]
    c, s = math.cos(planar[2]), math.sin(planar[2])
    return planar[:2] + np.stack([c * ahead - s * aside, s * ahead + c * aside], axis=-1)


def true_plan(scene: str) -> CroppedPlan:
    """Compute the simulator's floor plan at the robot's height; cells off the floor are UNKNOWN."""
    space = FreeSpace.from_apartment(load_scene(scene), ROBOT.radius, ROBOT.height)
    low, high = (np.array(space.region.bounds[i : i + 2]) + sign * PLAN_MARGIN for i, sign in ((0, -1.0), (2, 1.0)))
    n = np.ceil((high - low) / SIMULATOR_CELL).astype(int)
    axes = [low[a] + SIMULATOR_CELL * (np.arange(n[a]) + 0.5) for a in range(2)]
    xy = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    solid, free = space.distance_to_solid(xy) == 0.0, space.distance_to_obstacle(xy) > 0.0
    cells = np.where(solid, OCCUPIED, np.where(free, FREE, UNKNOWN)).astype(np.int8)
    return CroppedPlan(cells, low + 0.5 * SIMULATOR_CELL, SIMULATOR_CELL)


def _seen(m: VoxelMap, planar: np.ndarray, hfov: float) -> UInt8[np.ndarray, "height width 3"]:
    """Render the mean map from the robot's camera; grey where nothing was observed."""
    T_world_cam = planar_to_matrix(jnp.asarray(planar, jnp.float32)) @ jnp.asarray(ROBOT.T_body_cam, jnp.float32)
    seen = render(m, T_world_cam, Camera.from_hfov(160, 120, hfov))
    rgb = np.where(np.asarray(seen.known)[..., None], np.asarray(seen.rgb), pictures.UNKNOWN_COLOUR)
    return np.rint(255.0 * np.clip(rgb, 0.0, 1.0)).astype(np.uint8)
