"""Drive a round robot through apartments by its true pose, for filters that are run on the drive afterwards.

The robot follows shortest paths with a margin around obstacles, so that it meets none, or drives straight at places
that walls and furniture hide, so that it does. Filters get the same images and commands as on board.
"""

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np

from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.tasks.geodesic import Geodesics
from vssm_gym.envs.tasks.navigation import Split
from vssm_gym.errors import InputError
from vssm_gym.eval.protocols.agent_context import agent_context
from vssm_gym.eval.studies.calibration.replay import Drive
from vssm_gym.eval.studies.calibration.split import seed_of
from vssm_gym.planning.pursuit import steer

DRIVE_FRAMES = 100  # of a drive: 20 s
ROAD_MARGIN = 0.1  # m around the robot that paths keep free, against the noise of a step
BORDER = 0.02  # m that places keep from the border of free space
PLACES = 40  # drawn for a drive; a drive of 20 s visits three or four
ARRIVED = 0.06  # m from a place at which the next one is driven to
BLOCKED = 2  # contacts in a row after which a robot that drives straight gives its place up
TRIES = 5  # drives that may be dropped for each one that counts


def drives(
    scenes: tuple[str, ...],
    count: int,
    *,
    noise: str,
    sensor_noise: str,
    split: Split,
    seed: int,
    contacts: bool = False,
) -> Iterator[tuple[str, Drive]]:
    """Yield ``count`` drives and their scenes, dealt out evenly to the scenes, those of one scene in a row.

    Args:
        scenes: names of apartments.
        count: number of drives.
        noise: level of the execution noise, which the robot knows.
        sensor_noise: of the camera.
        split: of the seeds.
        seed: of the row.
        contacts: True for drives with contacts alone, False for drives without.

    Raises:
        InputError: an apartment in which such drives are rare.
    """
    number = 0
    for index, scene in enumerate(scenes):
        wanted = len(range(index, count, len(scenes)))
        if not wanted:
            continue
        env = gym.make(
            "vssm_gym/PointNav-v0",
            scene=scene,
            noise=noise,
            sensor_noise=sensor_noise,
            reward="sparse",
            disable_env_checker=True,
            max_episode_steps=DRIVE_FRAMES,
        )
        try:
            world: Any = env.unwrapped
            space = FreeSpace.from_apartment(world.apartment, world.robot.radius + ROAD_MARGIN, world.robot.height)
            roads, found = Geodesics(space), 0
            for _ in range(wanted * (1 + TRIES)):
                drive = _drive(env, space, None if contacts else roads, seed_of(split, seed, number))
                number += 1
                if bool(drive.contacts.any()) == contacts:
                    found += 1
                    yield scene, drive
                if found == wanted:
                    break
            else:
                kind = "with" if contacts else "without"
                raise InputError(scene, "drives", f"{wanted} {kind} a contact in {wanted * (1 + TRIES)}; found {found}")
        finally:
            env.close()


def _drive(env: gym.Env, space: FreeSpace, roads: Geodesics | None, seed: int) -> Drive:
    """Drive to random places of a space for :data:`DRIVE_FRAMES` frames: along its roads, or straight on where None."""
    world: Any = env.unwrapped
    rng = np.random.default_rng([seed, 3])
    places = space.sample(rng, PLACES, BORDER)
    start = (*places[0].tolist(), float(rng.uniform(-np.pi, np.pi)))
    observation, info = env.reset(seed=seed, options={"task": world.sampler.task(start, places[1].tolist())})
    context = agent_context(env, info)
    images, planar = [(observation["rgb"], observation["depth"])], [world.planar]
    commands: list[np.ndarray] = []
    contacts: list[bool] = []
    target, path = 0, np.zeros((0, 2))
    while len(images) < DRIVE_FRAMES:
        stuck = len(contacts) >= BLOCKED and all(contacts[-BLOCKED:])
        at = planar[-1][:2]
        if not len(path) or np.hypot(*(path[-1] - at)) < ARRIVED or stuck:
            target = 1 + target % (PLACES - 1)
            straight = np.array([at, places[target]])
            path = straight if roads is None else roads.path(space.nearest(at), places[target])
        elif len(path) > 2 and np.hypot(*(path[1] - at)) < ARRIVED:
            path = path[1:]
        command = steer(planar[-1], np.array([at, *path[1:]]), context.limits)
        observation, _, _, _, info = env.step(np.array([*command, 0.0], np.float32))
        images.append((observation["rgb"], observation["depth"]))
        planar.append(world.planar)
        commands.append(np.asarray(info["control"], float))
        contacts.append(bool(info["collision"]))
    return Drive(context, tuple(images), np.array(commands), np.array(planar), np.array(contacts))
