"""Test runs of explorers: the fields of their rows, each kind of ending, and a sweep from start to report."""

import json
import re

import gymnasium as gym
import numpy as np
import pytest

from tests.helpers.box_maps import map_of
from tests.helpers.box_rooms import furniture, two_rooms
from tests.helpers.paths import CHECKOUT
from vssm_gym.agents.base import Decision
from vssm_gym.agents.registry import AGENTS
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.scene import save_scene
from vssm_gym.envs.tasks.navigation import load, task_set
from vssm_gym.envs.tasks.splits import split_of
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.log import FILE, episode_key, read_rows
from vssm_gym.eval.episodes.manifest import MANIFEST
from vssm_gym.eval.protocols import explore as explore_protocol
from vssm_gym.eval.protocols import explore_episode
from vssm_gym.eval.protocols.agent_context import context_in
from vssm_gym.eval.report.page import write_report
from vssm_gym.eval.sweep.config import expand, load_config
from vssm_gym.eval.sweep.manifest import config_hash
from vssm_gym.eval.sweep.runner import run_sweep

CONFIGS = CHECKOUT / "eval" / "configs"
LIMIT = 60
START = np.array([0.6, 1.0, 0.0])
ROOMS = two_rooms(pieces=(furniture("table", (1.0, 3.0, 0.3), (0.6, 0.5, 0.6)),))


class Scripted:
    """Repeat one command and one status, stop after a number of steps, and keep a map where one is given."""

    name, robot, task, needs_pose, needs_map = "scripted", "holonomic", "explore", True, False

    def __init__(self, command, stop_after=10**6, status="exploring", voxel_map=None):
        self.command, self.stop_after, self.status = command, stop_after, status
        if voxel_map is not None:
            self.map = voxel_map

    def reset(self, context, observation, seed):
        self.context, self.steps, self.keys, self.seed = context, 0, set(observation), seed

    def act(self, observation):
        self.steps += 1
        stop = float(self.steps > self.stop_after)
        return Decision(np.array([*self.command, stop], np.float32), observation["pose"].astype(float), self.status)


TURN, FORWARD, STILL = (0.2, 0.0, 0.0), (0.0, 0.0, 0.16), (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def env():
    made = gym.make("vssm_gym/Explore-v0", scene=ROOMS, noise="none", finish=2.0, max_episode_steps=LIMIT)
    yield made
    made.close()


def run(env, agent, start=START, seed=3):
    row = explore_episode.run_episode(env, agent, start, seed=seed)
    json.dumps(row, allow_nan=False)  # rows are plain JSON
    return row


def test_a_run_in_place_takes_time_and_no_path_length(env):
    agent = Scripted(TURN)
    row = run(env, agent)
    assert agent.keys == {"rgb", "depth", "pose"}
    assert (agent.context.map, agent.context.success_radius) == (None, 0.0)
    np.testing.assert_allclose(agent.context.start_pose, START)
    assert (row["path_length"], row["steps"], row["seconds"], row["stopped"]) == (0.0, LIMIT, 12.0, False)
    assert row["budget"] == {"steps": LIMIT, "seconds": 12.0, "metres": pytest.approx(9.6)}
    assert row["curve"]["seconds"] == [0.0, 10.0, 12.0]
    assert row["curve"]["coverage"] == sorted(row["curve"]["coverage"])
    assert row["coverage"] == pytest.approx(row["curve"]["coverage"][-1], abs=1e-4)
    assert row["metres_50"] == 0.0  # the whole room from where it stands
    assert 0.0 < row["seconds_50"] <= 12.0
    assert (row["entropy"], row["completeness"]) == (None, None)  # it keeps no map
    assert "accuracy" not in row
    assert (row["collided"], row["success"]) == (False, False)
    assert row["failure"].startswith("time out: ")
    assert "covered after 60 steps" in row["failure"]


@pytest.mark.parametrize(
    ("status", "reason"),
    [
        ("finished: nothing left to gain", r"stopped early: \d+ % covered, finished: nothing left to gain"),
        ("boxed in: no free place to go", r"boxed in: no free place to go, \d+ % covered"),
        ("gave up: lost for 65 steps; localization: ...", r"lost: gave up: lost for 65 steps; .*, \d+ % covered"),
    ],
)
def test_an_agent_that_stops_below_the_goal_has_failed_for_the_reason_it_gives(env, status, reason):
    row = run(env, Scripted(TURN, stop_after=4, status=status))
    assert row["failure"] is not None
    assert pytest.approx(row["seconds"]) == 0.8  # the stop itself takes no time
    assert row["stopped"]
    assert re.fullmatch(reason, row["failure"])


def test_a_robot_that_pushes_against_a_wall_is_stuck_and_has_collided(env):
    row = run(env, Scripted(FORWARD, status="on the way"), start=np.array([0.6, 1.0, -np.pi / 2]))
    assert row["collided"]
    assert row["collisions"] > 30
    assert row["failure"].startswith("collision: stuck, ")
    assert len(row["trace"]["contacts"]) > 0


def test_coverage_is_counted_with_the_map_that_has_seen_it(env):
    """A map that does not change has one entropy; a sample is taken where the agent has taken up the image."""
    exact = map_of(ROOMS.boxes(), voxel=0.1, low=(-0.5, -0.5, -0.3), high=(6.5, 4.5, 2.8))
    agent = Scripted(STILL, stop_after=3, voxel_map=exact)
    row = run(env, agent)
    assert set(row["curve"]["entropy"]) == {row["entropy"]}
    assert row["entropy"] < 0.0
    assert row["completeness"] > 0.9
    assert row["accuracy"] < 0.02
    assert row["completion"] < 0.03
    assert 0.7 < row["complete_5cm"] <= 1.0  # walls of one cell lose a side


def test_the_same_seed_gives_the_same_row_and_the_seed_reaches_the_agent(env):
    a, b, c = Scripted(TURN), Scripted(TURN), Scripted(TURN)
    rows = [run(env, a, seed=3), run(env, b, seed=3)]
    run(env, c, seed=4)
    for row in rows:
        del row["latency"]
    assert rows[0] == rows[1]
    assert a.seed == b.seed != c.seed


class _AsAgent:
    """Wrap a policy ``observation -> action`` as an agent without map and pose."""

    name, robot, task, needs_pose, needs_map = "policy", "holonomic", "explore", True, False

    def __init__(self, policy):
        self.policy = policy

    def reset(self, context, observation, seed):
        self.policy.reset(context, observation, seed)

    def act(self, observation):
        return Decision(np.asarray(self.policy(observation), np.float32), None, "drives")


class _Random:
    """Sample the action space, without stopping."""

    def reset(self, context, observation, seed):
        self.rng, self.limits = np.random.default_rng(seed), np.array(context.limits)

    def __call__(self, observation):
        return [*self.rng.uniform([-1.0, -1.0, 0.0], 1.0) * self.limits, 0.0]


class _Learned:
    """Apply one layer with fixed weights to the depth image, as a network's ``predict`` does."""

    def reset(self, context, observation, seed):
        self.limits = np.array(context.limits)
        self.weights = np.random.default_rng(5).normal(size=(3, observation["depth"][::20, ::20].size))

    def __call__(self, observation):
        out = np.tanh(self.weights @ observation["depth"][::20, ::20].ravel())
        return [*(out * (1.0, 1.0, 0.5) + (0.0, 0.0, 0.5)) * self.limits, 0.0]


class _Frontier:
    """Run ``frontier_nearest`` without its ``map``."""

    def reset(self, context, observation, seed):
        self.agent = AGENTS["frontier_nearest"]()
        self.agent.reset(context, observation, seed)

    def __call__(self, observation):
        return self.agent.act(observation).action


@pytest.mark.slow
@pytest.mark.parametrize("policy", [_Random, _Learned, _Frontier])
def test_the_environment_and_the_protocol_agree_on_coverage_path_length_and_time(env, policy):
    """A plain Gymnasium loop and the protocol run the same seed."""
    agent = _AsAgent(policy())
    row = run(env, agent, seed=7)
    observation, info = env.reset(seed=7, options={"start": START})
    context = context_in(env.unwrapped, info, None, env.unwrapped.noise)
    agent.reset(context, observation, int(np.random.SeedSequence([7, 1]).generate_state(1)[0]))
    seen, steps = [(0.0, info["coverage"])], 0
    ended = False
    while not ended:
        observation, _, terminated, truncated, info = env.step(agent.act(observation).action)
        steps, ended = steps + 1, terminated or truncated
        seen.append((info["path_length"], info["coverage"]))
    assert row["coverage"] == info["coverage"]
    assert row["path_length"] == pytest.approx(info["path_length"])
    assert row["steps"] == steps
    for share in (50, 90, 99):
        metres = next((metres for metres, coverage in seen if 100.0 * coverage >= share), None)
        assert row[f"metres_{share}"] == (None if metres is None else pytest.approx(metres, abs=1e-3))
    assert (row["entropy"], row["completeness"]) == (None, None)


def test_where_a_share_was_reached_lies_on_the_path():
    path = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0]])
    assert explore_episode._place(path, 1.0) == [1.0, 0.0]
    assert explore_episode._place(path, 2.9) == [1.0, 2.0]


def test_starts_are_those_of_the_frozen_navigation_tasks(tmp_path):
    explore_protocol.write_tasks(ROOMS, 3, tmp_path / "tasks.json")
    tasks = load(tmp_path / "tasks.json", ROOMS)
    assert len(tasks.tasks) == explore_protocol.LEAST_TASKS  # some to navigate, however few starts there are
    assert tasks.split == "test"
    assert tasks == task_set(ROOMS, HolonomicRobot(), "test", explore_protocol.LEAST_TASKS)


def written(folder, text):
    save_scene(ROOMS, folder / "rooms.json")
    (folder / "sweep.yaml").write_text(text)
    return folder / "sweep.yaml"


EXPLORE = "env: vssm_gym/Explore-v0\nscenes: rooms.json\ntasks: 1\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (EXPLORE + "agents: astar\n", r"agents: expected one of frontier_gain, .*; found 'astar'"),
        (EXPLORE + "agents: candidate_random\n", "agents: expected 'random_viewpoint', the present name .*_random'"),
        ("scenes: rooms.json\ntasks: 1\nagents: random_walk\n", r"agents: expected one of astar, .*'random_walk'"),
        ("scenes: rooms.json\ntasks: 1\nagents: astar\nexplore: {}\n", "explore: expected no such field with"),
        (EXPLORE + "agents: random_walk\nexplore: {steps: 0}\n", r"explore\.steps: "),
        (EXPLORE + "agents: random_walk\nexplore: {metres: 3}\n", r"explore\.metres: "),
        (
            EXPLORE.replace("vssm_gym/Explore-v0", "[vssm_gym/Explore-v0, vssm_gym/PointNav-v0]") + "agents: astar\n",
            "env: expected environments of one task",
        ),
    ],
)
def test_incompatible_settings_are_refused(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        load_config(written(tmp_path, text))


def test_settings_of_explorers_reach_episodes_and_change_the_hash(tmp_path):
    config = load_config(written(tmp_path, EXPLORE + "agents: random_walk\nexplore: {steps: 40, navigation: 2}\n"))
    (episode,) = expand(config)
    assert episode.explore is not None
    assert (episode.explore.steps, episode.explore.navigation) == (40, 2)
    hashes = {config.scenes[0]: "abc"}
    without = config.model_copy(update={"explore": None})
    assert config_hash(config, hashes, 0) != config_hash(without, hashes, 0)


@pytest.mark.parametrize("name", ["exploration", "exploration_short", "exploration_estimated_pose"])
def test_the_configurations_are_of_explorers_in_scenes_of_the_test_split(name):
    config = load_config(CONFIGS / f"{name}.yaml")
    assert {AGENTS[agent].task for agent in config.agents} == {"explore"}
    assert {split_of(scene) for scene in config.scenes} == {"test"}
    if name == "exploration":
        assert config.agents[0] == "mi_explorer"  # whom the report compares with the others
        assert len(config.agents) == 6
        assert len([scene for scene in config.scenes if ":" not in scene]) == 6


@pytest.mark.slow
def test_explorers_from_start_to_report(tmp_path):
    """Three explorers are interrupted, resumed to the same rows, their maps used for navigation, and reported."""
    config = load_config(CONFIGS / "exploration_short.yaml")
    log = run_sweep(config, tmp_path / "whole", workers=1)
    rows = read_rows(log)
    assert len(rows) == 6
    for row in rows:
        assert row["steps"] <= config.explore.steps
        assert row["entropy"] < 0.0 < row["completeness"] < 1.0
        assert row["navigation"]["tasks"] == 1
        assert row["map_hash"] is None
    assert len({(row["task"], *row["trace"]["true"][0]) for row in rows}) == 2  # all agents from the same starts
    kept = {row["agent"]: row.get("explored") for row in rows if row["task"] == 0}
    assert set(kept.values()) == {f"{rows[0]['scene']}-low-none-raycast-{agent}.npz" for agent in config.agents}
    assert {path.name for path in (tmp_path / "whole" / "explored").iterdir()} == set(kept.values())

    lines = log.read_bytes().splitlines(keepends=True)
    (tmp_path / "cut").mkdir()
    (tmp_path / "cut" / FILE).write_bytes(b"".join(lines[:5]) + lines[5][: len(lines[5]) // 2])
    (tmp_path / "cut" / MANIFEST).write_bytes((tmp_path / "whole" / MANIFEST).read_bytes())
    resumed = run_sweep(config, tmp_path / "cut", resume=True, workers=1)
    first, second = (
        {episode_key(row): {k: v for k, v in row.items() if k not in ("latency", "version")} for row in read_rows(path)}
        for path in (log, resumed)
    )
    assert first == second

    text = write_report(tmp_path / "whole").read_text()
    for heading in (
        "ratio of path lengths",
        "strongest other agent",
        "m to 90 %",
        "navigation success %",
        "Final maps",
    ):
        assert heading in text
