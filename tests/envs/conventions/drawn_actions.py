"""Draw actions of any environment that do not end its episode."""

import gymnasium as gym
import numpy as np


def drawn_action(env: gym.Env, rng: np.random.Generator) -> np.ndarray:
    """Return a random action whose last number, which is ``stop`` where there is one, is 0, but for Flight."""
    space = env.action_space
    if isinstance(space, gym.spaces.Discrete):
        return rng.integers(space.n)
    action = rng.uniform(space.low, space.high).astype(np.float32)
    if "Flight" not in env.spec.id:
        action[-1] = 0.0
    return action


def zero_action(space: gym.Space) -> np.ndarray:
    """Return zeros: no motion in SI units, the middle of normalised actions, and the first discrete one."""
    return np.zeros(space.shape, space.dtype)
