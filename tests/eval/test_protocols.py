"""Test the table of environments: its rows name existing objects, and environments with a protocol run in sweeps."""

import importlib
import json
import subprocess
import sys

import equinox as eqx
import gymnasium as gym
import numpy as np
import pytest

import vssm_gym  # noqa: F401  (registers the ids)
from tests.helpers.box_rooms import two_rooms
from tests.helpers.paths import CHECKOUT
from vssm_gym.agents.base import ANY_TASK
from vssm_gym.agents.navigation.oracle import OracleAgent
from vssm_gym.agents.registry import AGENTS, make_agent
from vssm_gym.envs.registration import ENVIRONMENTS
from vssm_gym.envs.robots.drive_response import WORN
from vssm_gym.envs.scenes.scene import save_scene
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.identity import Condition
from vssm_gym.eval.episodes.log import FILE, read_rows
from vssm_gym.eval.protocols import shared
from vssm_gym.eval.protocols.agent_context import agent_context
from vssm_gym.eval.protocols.registry import SWEPT_ENVIRONMENTS, EpisodeProtocol, protocol_of, view_of
from vssm_gym.eval.report.view import View
from vssm_gym.eval.sweep.config import load_config
from vssm_gym.eval.sweep.manifest import config_hash
from vssm_gym.planning.planners import PLANNERS

BASELINES = CHECKOUT / "eval" / "baselines"


def imported(name: str):
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_a_row_names_existing_objects(name):
    spec = ENVIRONMENTS[name]
    assert issubclass(imported(spec.env), gym.Env)
    assert callable(imported(spec.vector))
    assert gym.registry[name].max_episode_steps == spec.max_episode_steps
    assert (spec.protocol is None) == (spec.view is None)


@pytest.mark.parametrize("name", SWEPT_ENVIRONMENTS)
def test_every_protocol_has_the_functions_of_the_contract(name):
    """Its environment has agents, so that the protocol can run."""
    spec, protocol = SWEPT_ENVIRONMENTS[name], protocol_of(name)
    offered = {method for method in vars(EpisodeProtocol) if not method.startswith("_")}
    assert {method for method in offered if callable(getattr(protocol, method, None))} == offered
    assert isinstance(view_of(name), View)
    assert {"robot", "noise", "sensor_noise", "renderer", "direction_frame"} == protocol.conditions().keys()
    assert protocol.conditions()["robot"][0] == spec.robot
    assert protocol.scene_names()
    assert any(agent.robot == spec.robot and agent.task in (spec.task, ANY_TASK) for agent in AGENTS.values())


@pytest.mark.parametrize("name", [name for name, spec in SWEPT_ENVIRONMENTS.items() if spec.robot == "holonomic"])
def test_a_condition_names_the_robot_that_drives(name):
    """The agents of the holonomic robot drive the worn one too, and are not told which one it is."""
    fields = {"noise": "none", "sensor_noise": "none", "renderer": "raycast", "physics": "mujoco"}
    contexts = []
    for robot, response in (("holonomic", None), ("worn", WORN)):
        env = shared.world(Condition(name, "fern", robot, **fields))
        _, info = env.reset(seed=0)
        world = getattr(env.unwrapped, "navigation", env.unwrapped)
        assert world.simulation.robot.response == response
        contexts.append(agent_context(env, info))
    assert eqx.tree_equal(contexts[0].transition, contexts[1].transition)
    np.testing.assert_array_equal(contexts[0].limits, contexts[1].limits)


def test_every_agent_has_an_episode_protocol():
    able = [(spec.robot, spec.task) for spec in SWEPT_ENVIRONMENTS.values()]
    for agent in AGENTS.values():
        assert any(agent.robot == robot and agent.task in (task, ANY_TASK) for robot, task in able), agent.name


@pytest.mark.parametrize(("config", "folder"), [("car", "car"), ("car_baselines", "car_baselines")])
def test_configurations_keep_their_hash(config, folder):
    """A sweep that began before a field was added to configurations can still be resumed."""
    manifest = json.loads((BASELINES / folder / "sweep.json").read_text())
    checked = load_config(CHECKOUT / "eval" / "configs" / f"{config}.yaml")
    assert config_hash(checked, manifest["scene_hashes"], manifest["seed"]) == manifest["config_hash"]


def vssm(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run the command line in a process of its own."""
    command = [sys.executable, "-c", "import sys; from vssm_gym.cli.main import main; sys.exit(main())"]
    return subprocess.run(
        [*command, *map(str, arguments)], capture_output=True, text=True, timeout=600, check=False, cwd=CHECKOUT
    )


MAZE = """env: vssm_gym/LidarMaze-v0
robot: disc
physics: none
scenes: [pillars-v1, rooms-v1]
agents: dist_bug
tasks: [0, 7, 30]
sensor_noise: [none, low]
"""
WANDERING = (
    "env: vssm_gym/Explore-v0\nscenes: rooms.json\nagents: [random, random_walk]\ntasks: 1\nexplore: {steps: 30}\n"
)
IMAGES = "env: vssm_gym/ImageNav-v0\nscenes: rooms.json\nagents: random\ntasks: 2\n"


@pytest.mark.slow
@pytest.mark.parametrize(("text", "episodes"), [(MAZE, 12), (IMAGES, 2), (WANDERING, 2)])
def test_a_sweep_runs_and_reports_from_end_to_end(tmp_path, text, episodes):
    save_scene(two_rooms(), tmp_path / "rooms.json")
    (tmp_path / "sweep.yaml").write_text(text)
    swept = vssm("sweep", tmp_path / "sweep.yaml", "--out", tmp_path / "out")
    assert swept.returncode == 0, swept.stderr
    rows = read_rows(tmp_path / "out" / FILE)
    assert len(rows) == episodes
    env = rows[0]["env"]
    assert all(f"{name}" in swept.stdout for name in view_of(env).summary)
    if "Maze" in env:
        assert sum(row["success"] for row in rows) >= 10  # measured: 12
        assert all(row["location_error_mean"] is not None for row in rows)
    else:
        assert all(row["location_error_mean"] is None for row in rows if row["agent"] == "random")
    reported = vssm("report", tmp_path / "out")
    assert reported.returncode == 0, reported.stderr
    assert (tmp_path / "out" / "report.html").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (("pillars-v1", "oak"), r"scenes: expected a built-in scene \(pillars-v1, "),
        (
            ("dist_bug", "random"),
            "agents: expected one of dist_bug, scan_astar, scan_astar_latent, scan_goal, scan_goal_search, "
            "scan_oracle; found 'random'",
        ),
        (("robot: disc", "robot: holonomic"), "robot: expected one of disc; found 'holonomic'"),
        (("[none, low]", "kinect"), "sensor_noise: expected one of none, low, mid, high; found 'kinect'"),
    ],
)
def test_a_maze_is_swept_by_its_own_names(tmp_path, changed, message):
    (tmp_path / "sweep.yaml").write_text(MAZE.replace(*changed))
    with pytest.raises(InputError, match=message):
        load_config(tmp_path / "sweep.yaml")


def test_more_tasks_than_a_maze_has_are_refused(tmp_path):
    protocol = protocol_of("vssm_gym/LidarMaze-v0")
    with pytest.raises(InputError, match=r"tasks: expected numbers below \d+, as many as the maze has"):
        protocol.write_tasks(protocol.load("rooms-v1"), 10_000, tmp_path / "tasks.json")


def test_a_navigating_agent_takes_another_planner_by_name(tmp_path):
    """Rows and tables show it as an agent of its own, and it calls the planner that it names."""
    for planner in PLANNERS:
        agent = make_agent(f"oracle+{planner}")
        navigator = agent.act.__self__
        assert navigator._plan is PLANNERS[planner]
        assert navigator._config.stop_margin == OracleAgent.navigation.stop_margin  # all else is the agent's own
    other = f"astar+{list(PLANNERS)[-1]}"
    text = f"scenes: oak\nagents: [astar, {other}]\ntasks: 1\n"
    (tmp_path / "sweep.yaml").write_text(text)
    assert load_config(tmp_path / "sweep.yaml").agents == ("astar", other)
    for name, message in (
        ("astar+magic", "planner: expected one of"),
        ("random+astar", "a planner after one of astar"),
    ):
        (tmp_path / "sweep.yaml").write_text(text.replace(other, name))
        with pytest.raises(InputError, match=message):
            load_config(tmp_path / "sweep.yaml")
