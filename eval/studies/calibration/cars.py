"""Drive a car through arenas by its true pose, for the tracker that is run on the drive afterwards.

The driver is ``hybrid_astar``, which observes the pose; the tracker is that of ``vi_mpc_estimated_pose`` and receives
the same images and commands as on board. A drive is one episode with a random start and target.
"""

from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np

from vssm_gym.agents.base import Agent
from vssm_gym.agents.car.hybrid_astar import HybridAStarAgent
from vssm_gym.envs.tasks.navigation import Split
from vssm_gym.errors import InputError
from vssm_gym.eval.protocols.agent_context import agent_context
from vssm_gym.eval.studies.calibration.replay import Drive
from vssm_gym.eval.studies.calibration.split import seed_of
from vssm_gym.maps.voxel_map import VoxelMap

CAR_FRAMES = 250  # of a drive at most: 25 s
FEWEST_CAR_FRAMES = 60  # a shorter drive is dropped
CAR_TRIES = 5  # drives that may be dropped for each one that counts


def car_drives(
    scenes: tuple[str, ...], count: int, *, noise: str, split: Split, seed: int, map_of: Callable[[str], VoxelMap]
) -> Iterator[tuple[str, Drive]]:
    """Yield ``count`` drives without contact and their arenas, dealt out evenly, those of one arena in a row.

    Args:
        scenes: names of arenas.
        count: number of drives.
        noise: level of the car's execution noise.
        split: of the seeds.
        seed: of the row.
        map_of: returns the learned map of an arena.

    Raises:
        InputError: an arena in which such drives are rare.
    """
    number = 0
    for index, scene in enumerate(scenes):
        wanted = len(range(index, count, len(scenes)))
        if not wanted:
            continue
        agent, voxel_map = HybridAStarAgent(), map_of(scene)
        env = gym.make(
            "vssm_gym/CarNav-v1",
            scene=scene,
            noise=noise,
            end_on="reach",
            observe_pose=True,
            reward="sparse",
            disable_env_checker=True,
        )
        try:
            found = 0
            for _ in range(wanted * (1 + CAR_TRIES)):
                drive = _drive(env, agent, voxel_map, seed_of(split, seed, number))
                number += 1
                if len(drive.planar) >= FEWEST_CAR_FRAMES and not drive.contacts.any():
                    found += 1
                    yield scene, drive
                if found == wanted:
                    break
            else:
                expected = f"{wanted} without contact in {wanted * (1 + CAR_TRIES)}; found {found}"
                raise InputError(scene, "drives", expected)
        finally:
            env.close()


def _drive(env: gym.Env, agent: Agent, voxel_map: VoxelMap, seed: int) -> Drive:
    """Drive one episode, until the car has arrived or for :data:`CAR_FRAMES` frames."""
    body: Any = env.unwrapped
    observation, info = env.reset(seed=seed)
    context = agent_context(env, info, voxel_map)
    agent.reset(context, observation, seed)
    images, planar = [(observation["rgb"], observation["depth"])], [body.planar]
    commands: list[np.ndarray] = []
    contacts: list[bool] = []
    ended = False
    while not ended and len(images) < CAR_FRAMES:
        decision = agent.act(observation)
        if decision.gives_up:
            break
        observation, _, terminated, truncated, info = env.step(decision.action)
        ended = terminated or truncated
        images.append((observation["rgb"], observation["depth"]))
        planar.append(body.planar)
        commands.append(np.asarray(decision.action, float))
        contacts.append(bool(info["collision"]))
    steps = np.array(commands).reshape(len(commands), len(context.limits))
    return Drive(context, tuple(images), steps, np.array(planar), np.array(contacts, bool))
