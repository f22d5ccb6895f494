"""Drive through chains of random goals with further localizers, to evaluate tracking apart from navigation.

A driver agent steers; every further localizer receives the same images and commands and nothing else, so that
their errors on one drive can be compared pairwise.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from vssm_gym.agents.base import Agent, Observation
from vssm_gym.agents.shared.localization import Localizer
from vssm_gym.envs.pointnav import PointNavEnv
from vssm_gym.envs.tasks.navigation import BORDER_MARGIN, TaskSampler
from vssm_gym.eval.protocols.agent_context import context_in
from vssm_gym.maps.voxel_map import VoxelMap

MAX_GIVEN_UP = 50  # goals in a row for which the driver does not move before the drive is an error


@dataclass(frozen=True)
class DriveRecord:
    """Hold a drive, one row a step, the start first."""

    true: Float[np.ndarray, "time 3"]  # x, y, heading
    estimates: dict[str, Float[np.ndarray, "time 3"]]  # of each localizer
    lost: dict[str, Float[np.ndarray, "time"]]  # 1 where the localizer reported that it lost track
    goals: int  # at which the driver stopped within the success radius, by the true pose

    @property
    def travelled(self) -> Float[np.ndarray, "time"]:
        """Return the true path length so far, m."""
        steps = np.linalg.norm(np.diff(self.true[:, :2], axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    def location_error(self, name: str) -> Float[np.ndarray, "time"]:
        """Return the distance (m) between an estimate's position and the truth."""
        return np.linalg.norm(self.estimates[name][:, :2] - self.true[:, :2], axis=1)


def drive(
    env: PointNavEnv,
    sampler: TaskSampler,
    driver: Agent,
    riders: Mapping[str, Localizer],
    voxel_map: VoxelMap,
    *,
    seed: int,
    steps: int | None = None,
    metres: float | None = None,
) -> DriveRecord:
    """Chain random goals until ``steps`` or ``metres`` are done; a stop of the driver draws the next goal.

    Args:
        env: PointNav, made without a step limit; its observed pose is shown to a driver that needs it, to no other.
        sampler: of the environment's scene.
        driver: steers; reset once, at the start.
        riders: localizers by name.
        voxel_map: the learned map, for driver and riders.
        seed: of start, goals and execution noise.
        steps: control steps to drive.
        metres: true path length to drive.
    """
    rng = np.random.default_rng([seed, 7])
    observation, info = env.reset(seed=seed, options={"task": sampler.draw(rng)})
    context = context_in(env, info, voxel_map, env.noise)
    driver.reset(context, _shown(observation, driver.needs_pose), seed)
    blind = _shown(observation, pose=False)
    poses = {name: [rider.reset(context, blind).planar] for name, rider in riders.items()}
    lost: dict[str, list[float]] = {name: [0.0] for name in riders}
    true, goals, driven, given_up = [np.array(info["start_pose"])], 0, 0.0, 0
    while (steps is None or len(true) <= steps) and (metres is None or driven < metres):
        decision = driver.act(_shown(observation, driver.needs_pose))
        if decision.action[3] > 0.5:
            goals += int(np.linalg.norm(true[-1][:2] - observation["goal"]) <= env.success_radius)
            given_up += 1
            if given_up > MAX_GIVEN_UP:
                raise RuntimeError(f"the driver gives up goal after goal: {decision.status}")
            observation = {**observation, "goal": sampler.space.sample(rng, 1, BORDER_MARGIN)[0].astype(np.float32)}
            continue
        given_up = 0
        goal = observation["goal"]
        observation, _, _, _, info = env.step(decision.action)
        observation = {**observation, "goal": goal}
        true.append(np.array(env.planar))
        driven += float(np.linalg.norm(true[-1][:2] - true[-2][:2]))
        blind = _shown(observation, pose=False)
        for name, rider in riders.items():
            belief = rider.update(decision.action[:3], blind)
            poses[name].append(belief.planar)
            lost[name].append(float(not belief.status.accepted))
    return DriveRecord(
        np.array(true),
        {name: np.array(rows) for name, rows in poses.items()},
        {name: np.array(rows) for name, rows in lost.items()},
        goals,
    )


def _shown(observation: Observation, pose: bool) -> Observation:
    """Return the observation with or without the true pose."""
    return observation if pose else {name: value for name, value in observation.items() if name != "pose"}
