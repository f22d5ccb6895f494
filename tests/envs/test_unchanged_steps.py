"""Test that the environments give the recorded observations and rewards: the first steps of every id, by its defaults.

Change the recording only with a change of the environment that users are told of:
``python -m tests.envs.test_unchanged_steps`` writes it anew. Checksums of numbers are compared and not hashes of bytes,
because the last digits of sines and exponentials depend on the processor.
"""

import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import vssm_gym  # noqa: F401  (registers the ids)

RECORDED = Path(__file__).parent / "data" / "first_steps.json"
IDS = ("PointNav-v0", "ImageNav-v0", "Explore-v0", "LidarMaze-v0", "Flight-v0", "CarNav-v0")  # the first release's
STEPS = 4


def checksum(array: np.ndarray) -> float:
    """``sum_i w_i a_i`` with weights between 1 and 2 that differ everywhere, so that order matters."""
    values = np.asarray(array, np.float64).ravel()
    return float(values @ (1.0 + (np.arange(values.size) * 0.6180339887498949) % 1.0))


def first_steps(name: str) -> dict:
    """Return shapes and types of an environment's spaces, and the checksums of its first steps."""
    small = {} if "LidarMaze" in name else {"camera": {"width": 24, "height": 18}}
    env = gym.make(f"vssm_gym/{name}", **small)
    rng, steps = np.random.default_rng(0), []
    observation, _ = env.reset(seed=7)
    for _ in range(STEPS):
        low, high = env.action_space.low, env.action_space.high
        action = rng.uniform(low, high).astype(np.float32)
        if "Flight" not in name and "CarNav" not in name:
            action[-1] = 0.0  # no stop
        shown = {key: checksum(observation[key]) for key in sorted(observation)}
        observation, reward, terminated, truncated, _ = env.step(action)
        steps.append({**shown, "reward": float(reward), "ended": bool(terminated or truncated)})
    spaces = {key: [list(one.shape), str(one.dtype)] for key, one in sorted(env.observation_space.spaces.items())}
    env.close()
    return {
        "observation": spaces,
        "action": [env.action_space.low.tolist(), env.action_space.high.tolist()],
        "steps": steps,
    }


@pytest.mark.parametrize("name", IDS)
def test_the_first_steps_are_the_recorded_ones(name):
    expected, found = json.loads(RECORDED.read_text())[name], first_steps(name)
    assert found["observation"] == expected["observation"]
    np.testing.assert_allclose(found["action"], expected["action"], rtol=1e-6)
    for step, recorded in zip(found["steps"], expected["steps"], strict=True):
        assert step.keys() == recorded.keys()
        for key, value in recorded.items():
            assert step[key] == pytest.approx(value, rel=1e-4, abs=1e-5), key


if __name__ == "__main__":
    RECORDED.write_text(json.dumps({name: first_steps(name) for name in IDS}, indent=1) + "\n")
