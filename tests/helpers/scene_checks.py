"""Check what holds for every scene: free space, images without holes, and a robot that drives in it."""

import numpy as np

from vssm_gym.envs.pointnav import PointNavEnv
from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.sensors import CameraConfig


def check_scene(apartment: Apartment, steps: int = 30) -> FreeSpace:
    """Check free space, rendering and driving; return the free space of a robot of 0.1 m radius and 0.5 m height."""
    space = FreeSpace.from_apartment(apartment, 0.1, 0.5)
    assert space.largest.area > 0.5
    env = PointNavEnv(apartment, camera=CameraConfig(64, 48), reward="sparse")
    try:
        observation, _ = env.reset(seed=1)
        rng = np.random.default_rng(2)
        low, high = env.action_space.low, env.action_space.high
        for _ in range(steps):
            assert observation["depth"].min() > 0.0, "a ray left the apartment"
            observation, reward, *_ = env.step(np.append(rng.uniform(low[:3], high[:3]), 0.0))
            assert np.isfinite(reward)
            fitting = space.nearest(env.planar[:2])
            assert np.linalg.norm(fitting - env.planar[:2]) < 0.03, "the body is in a wall or off the floor"
    finally:
        env.close()
    return space
