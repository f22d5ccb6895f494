"""Draw episodes of a data set: every kind of observation and info that the environments have."""

from typing import Any

import gymnasium as gym
import numpy as np

from vssm_gym.data.datasets.episode import Block, Description, Episode

SPACE = gym.spaces.Dict(
    {
        "rgb": gym.spaces.Box(0, 255, (36, 40, 3), np.uint8),
        "depth": gym.spaces.Box(0.0, np.inf, (36, 40), np.float32),
        "units": gym.spaces.Box(0, 65535, (3, 4), np.uint16),
        "goal": gym.spaces.Box(-9.0, 9.0, (2,), np.float32),
        "time": gym.spaces.Box(-np.inf, np.inf, (1,), np.float64),
        "contact": gym.spaces.Box(0, 1, (8,), np.int8),
    }
)
DESCRIPTION = Description(
    source="drawn episodes",
    observations=SPACE,
    actions=gym.spaces.Box(-1.0, 1.0, (4,), np.float32),
    rate=5.0,
    version="0.1.0+0123456789ab",
    robot="holonomic",
    agents=("astar", "random"),
    env="vssm_gym/PointNav-v0",
    keywords={"scene": "oak", "noise": "low"},
    max_episode_steps=77,
)


def _values(space: Any, n: int, rng: np.random.Generator) -> np.ndarray:
    if space.dtype.kind == "f":
        return rng.normal(size=(n, *space.shape)).astype(space.dtype)
    low, high = (1, 2) if space.dtype == np.int8 else (0, np.iinfo(space.dtype).max + 1)
    return rng.integers(0 * low, high, (n, *space.shape)).astype(space.dtype)


def drawn_block(steps: int, seed: int, last: bool = True) -> Block:
    """Return a block of an episode with random values of every kind."""
    rng, n = np.random.default_rng(seed), steps + last
    observations = {name: _values(space, n, rng) for name, space in SPACE.spaces.items()}
    infos: list[dict[str, Any]] = [
        {"success": i > 3, "spl": 0.1 * i, "T": [[0.5, i], [1.0, 2.0]], "reason": "time" if i > 2 else None}
        for i in range(n)
    ]
    infos[0]["task"] = {"id": seed, "start": [0.1, 0.2, 0.3]}
    actions = rng.normal(size=(steps, 4)).astype(np.float32)
    ends = last & (np.arange(steps) == steps - 1)
    return Block(observations, actions, rng.normal(size=steps), ends, np.zeros(steps, bool), infos)


def drawn_episodes(lengths: tuple[int, ...] = (5, 1, 7)) -> list[Episode]:
    """Return episodes of these numbers of steps, each of one block."""
    return [
        Episode(f"drive {k % 2}", 2**32 - 1 - k, {"number": k, "name": "ü"}, [drawn_block(steps, k)])
        for k, steps in enumerate(lengths)
    ]
