"""Test driven episodes of a data set: they are those of a sweep, and can be made again from their metadata."""

import re

import gymnasium as gym
import numpy as np
import pytest

from tests.helpers.paths import CHECKOUT
from vssm_gym.data.datasets.episode import checked
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.tasks.navigation import Task
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.identity import ExploreSettings
from vssm_gym.eval.episodes.log import read_rows
from vssm_gym.eval.sweep import recorded
from vssm_gym.eval.sweep.config import SweepConfig, load_config
from vssm_gym.eval.sweep.recorded import recorded_episodes
from vssm_gym.eval.sweep.runner import run_sweep

TIMES = ("latency", "version", "config_hash")


def config(**changes):
    return SweepConfig(scenes=("oak",), agents=("random",), tasks=(0, 1)).model_copy(update=changes)


def replay(description, episode):
    """Make an episode again from its metadata and actions; return its observations, rewards and infos."""
    [block] = episode.blocks
    keywords = dict(episode.metadata["keywords"])
    env = gym.make(description.env, **keywords)
    reset = episode.metadata["reset"]
    options = {"task": Task.model_validate(reset["options"]["task"])}
    observations, rewards = [env.reset(seed=reset["seed"], options=options)[0]], []
    for action in block.actions:
        observation, reward, terminated, *_ = env.step(action)
        observations.append(observation)
        rewards.append(reward)
    env.close()
    return observations, rewards, terminated


def test_an_episode_can_be_made_again_from_its_metadata(tmp_path):
    description, episodes = recorded_episodes(config(noise=("high",), sensor_noise=("kinect",)), tmp_path)
    for episode in episodes:
        [block] = episode.blocks
        observations, rewards, terminated = replay(description, episode)
        assert len(observations) == block.steps + 1
        for name, values in block.observations.items():
            np.testing.assert_array_equal(values, np.stack([one[name] for one in observations]))
        np.testing.assert_array_equal(block.rewards, rewards)
        assert terminated == block.terminations[-1]
    assert description.keywords["noise"] == "high" and description.max_episode_steps == 500


@pytest.mark.slow
def test_episodes_are_those_of_a_sweep(tmp_path):
    chosen = config(noise=("none", "low"), tasks=(1,))
    log = run_sweep(chosen, tmp_path / "sweep", workers=1)
    description, episodes = recorded_episodes(chosen, tmp_path / "scratch")
    same = lambda row: {name: value for name, value in row.items() if name not in (*TIMES, "format")}
    rows = [episode.metadata["row"] for episode in episodes]
    assert len(rows) == 2
    by_noise = lambda rows: {row["noise"]: same(row) for row in rows}
    assert by_noise(rows) == by_noise(read_rows(log))
    assert "noise" not in description.keywords and description.keywords["scene"] == "oak"


MAZE = {"env": ("vssm_gym/LidarMaze-v0",), "robot": ("disc",), "physics": ("none",), "scenes": ("rooms-v1",)}
CAR = {"env": ("vssm_gym/CarNav-v1",), "robot": ("car",), "scenes": ("depot",)}
IMAGE = {"env": ("vssm_gym/ImageNav-v0",)}
EXPLORE = {"env": ("vssm_gym/Explore-v0",), "explore": ExploreSettings(steps=20)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "agent", "rate"),
    [
        (MAZE, "dist_bug", 5.0),
        (IMAGE, "random", 5.0),
        (EXPLORE, "random_walk", 5.0),
        pytest.param(CAR, "greedy", 10.0, marks=pytest.mark.slow),  # its map is learned first
    ],
)
def test_every_environment_of_a_sweep_can_be_driven(tmp_path, changes, agent, rate):
    description, episodes = recorded_episodes(config(tasks=(0,), agents=(agent,), **changes), tmp_path)
    [episode] = episodes
    [block] = episode.blocks
    assert block.is_last and (block.terminations[-1] or block.truncations[-1])
    assert description.rate == rate
    assert list(checked(description, episode)) == [block]


def test_several_environments_are_refused(tmp_path):
    with pytest.raises(InputError, match="dataset: env: expected one environment"):
        recorded_episodes(config(env=("vssm_gym/CarNav-v0", "vssm_gym/CarNav-v1")), tmp_path)


def test_agents_with_other_observations_are_refused_before_any_is_driven(tmp_path):
    with pytest.raises(InputError, match=r"agents: expected .* found oracle with the true pose, astar, random without"):
        recorded_episodes(config(agents=("astar", "oracle", "random")), tmp_path)
    assert not list(tmp_path.iterdir())
    page = (CHECKOUT / "docs/datasets.md").read_text()
    [(file, agents)] = re.findall(r"dataset export (\S+\.yaml) --agents (.*) --out", page)  # what the page runs
    recorded._check_observations(load_config(CHECKOUT / file, agents=agents.split()))
    with pytest.raises(InputError, match=r"sweep: agents: .*'nobody'|agents: expected .*nobody"):
        load_config(CHECKOUT / file, agents=["nobody"])


def test_a_scene_file_is_named_without_its_folder():
    class Unwrapped:
        class spec:  # noqa: N801
            kwargs = {"scene": object(), "noise": "low"}  # noqa: RUF012

    class Env:
        unwrapped = Unwrapped

    found = recorded._keywords(Env(), "/home/someone/flat.json")
    assert found == {"scene": "flat", "noise": "low"}
    assert recorded._keywords(Env(), "procedural:7:large")["scene"] == "procedural:7:large"
    assert load_scene("oak").name == recorded._keywords(Env(), "oak")["scene"]
