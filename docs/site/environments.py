"""Tabulate a registered environment: what Gymnasium's registry and an instance of it say."""

from functools import cache
from typing import Any

import gymnasium as gym
import numpy as np

from vssm_gym.agents.base import ANY_TASK
from vssm_gym.agents.registry import AGENTS
from vssm_gym.envs.registration import ENVIRONMENTS

NEEDED = {"vssm_gym/WorldModelNav-v0": {"map": "oak"}}  # keywords without a default


def environment(name: str) -> str:
    """Return the table of one id: class, spaces with their bounds, steps, keywords that the id sets, agents.

    Args:
        name: the id.
    """
    spec = ENVIRONMENTS[name]
    env = made(name)
    observation = env.observation_space
    assert isinstance(observation, gym.spaces.Dict)
    rows = [
        ("id", f"`{name}`"),
        ("class", f"{{py:class}}`~{spec.env.replace(':', '.')}`"),
        ("action", f"`{space(env.action_space)}`"),
        *((f"observation, `{key}`", f"`{space(part)}`") for key, part in observation.items()),
        ("most steps", str(spec.max_episode_steps or "none: the episode ends by itself")),
        (
            "keywords that the id sets",
            ", ".join(f"`{key}={value!r}`" for key, value in spec.keywords.items())
            or "none: each has the default of the class",
        ),
        ("agents", ", ".join(f"`{agent}`" for agent in agents(name)) or "none in sweeps"),
    ]
    return "\n".join(["| | |", "|---|---|", *(f"| {key} | {value} |" for key, value in rows)]) + "\n"


@cache
def made(name: str) -> gym.Env[Any, Any]:
    """Make an environment with its defaults."""
    gym.logger.min_level = gym.logger.ERROR  # v0 has a successor, which its page says
    return gym.make(name, **NEEDED.get(name, {})).unwrapped


def space(one: gym.Space[Any]) -> str:
    """Write a space with its bounds: one number where all components share it."""
    if not isinstance(one, gym.spaces.Box):
        return repr(one)
    low, high = (bound(limit) for limit in (one.low, one.high))
    return f"Box({low}, {high}, {one.shape}, {one.dtype})"


def bound(limit: np.ndarray) -> str:
    """Write the bounds of a box on one side."""
    values = [f"{value:.4g}" for value in limit.ravel()[:12]]
    return values[0] if len(set(limit.ravel().tolist())) == 1 else f"[{', '.join(values)}]"


def agents(name: str) -> list[str]:
    """List the agents that sweeps may run on an id."""
    spec = ENVIRONMENTS[name]
    return [
        agent
        for agent, kind in AGENTS.items()
        if spec.protocol and kind.robot == spec.robot and kind.task in (spec.task, ANY_TASK)
    ]
