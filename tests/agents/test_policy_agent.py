"""Test trained policies as agents: their files, the input of their networks, and their actions."""

import json
import os
import pickle
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vssm_gym.agents.base import AgentContext
from vssm_gym.agents.policy import policy_file
from vssm_gym.agents.policy.agent import PolicyAgent, body_std, stop_radius
from vssm_gym.agents.policy.command_history import CommandHistory
from vssm_gym.agents.policy.features import OBSERVED, SIZES, WAVES, features, relative, size_of
from vssm_gym.agents.policy.policy_file import Policy, PolicySpec
from vssm_gym.agents.registry import agent_type, make_agent
from vssm_gym.agents.shared.localization import Localization
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.errors import InputError
from vssm_gym.eval.sweep.config import SweepConfig, check_names, load_config
from vssm_gym.eval.sweep.manifest import config_hash
from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.status import Status
from vssm_gym.model.transition import MotionNoise, Planar
from vssm_gym.training.imagined_episodes import real_return

ROBOT = HolonomicRobot()
SPEC = PolicySpec(
    name="small",
    parts=("scan", "goal", "pose"),
    frames=2,
    hidden=(8, 5),
    activation="tanh",
    squash="clip",
    low=(-ROBOT.max_turn, -ROBOT.max_offset, 0.0),
    high=(ROBOT.max_turn, ROBOT.max_offset, ROBOT.max_step),
    max_depth=8.0,
    hfov=np.pi / 2.0,
    success_radius=0.4,
    trained={"steps": 7},
)


def policy(seed: int = 0, **changes: Any) -> Policy:
    spec, rng = replace(SPEC, **changes), np.random.default_rng(seed)
    draw = lambda *shape: rng.normal(0.0, 0.3, shape).astype(np.float32)
    return Policy(spec, tuple((draw(*shape), draw(shape[0])) for shape in spec.shapes))


class Seen:
    """Localise by poses that are given in advance."""

    def __init__(self, planar: tuple[float, float, float], std: float = 0.0) -> None:
        self.belief, self.commands = Localization(np.array(planar), np.full(3, std), Status.OK), []

    def reset(self, context: AgentContext, observation: Any) -> Localization:
        return self.belief

    def update(self, command: np.ndarray, observation: Any) -> Localization:
        self.commands.append(command)
        return self.belief


def context(width: int = 160, **changes: Any) -> AgentContext:
    camera = Camera.from_hfov(width, 120, np.pi / 2.0)
    fields: dict[str, Any] = {
        "K": camera.K,
        "camera": (width, 120),
        "T_body_cam": ROBOT.T_body_cam,
        "limits": ROBOT.limits,
        "dt": ROBOT.dt,
        "map": None,
        "start_pose": np.zeros(3),
        "body_length": ROBOT.body_length,
        "success_radius": 0.4,
        "noise": (0.0, 0.0),
        "transition": Planar(MotionNoise(0.0, 0.0)),
    }
    return AgentContext(**(fields | changes))


def observation(seed: int = 0, goal: tuple[float, float] = (3.0, 1.0)) -> dict[str, np.ndarray]:
    depth = np.random.default_rng(seed).uniform(0.0, 9.0, (120, 160)).astype(np.float32)
    return {"depth": depth, "rgb": np.zeros((120, 160, 3), np.uint8), "goal": np.array(goal, np.float32)}


def agent_of(p: Policy | str, planar: tuple[float, float, float] = (0.5, 0.2, 0.3), std: float = 0.0) -> PolicyAgent:
    agent = PolicyAgent(p)
    agent._localizer = Seen(planar, std)  # type: ignore[assignment]
    return agent


def actions(agent: PolicyAgent, steps: int = 4) -> np.ndarray:
    agent.reset(context(), observation(0), 0)
    return np.array([agent.act(observation(i)).action for i in range(steps)])


# what a network sees


def test_features_by_hand():
    """A goal at (1, 3) is one metre ahead of (1, 2) facing north."""
    scan = np.zeros(64, np.float32)
    scan[3] = 0.5
    shown = {"scan": scan, "goal": np.array([1.0, 1.0, 0.0]), "pose": np.array([1.0, 2.0, np.pi / 2.0])}
    vector = features(shown, ("pose", "scan", "goal"))  # the order is that of SIZES, not of the argument
    assert vector.dtype == np.float32 and vector.shape == (size_of(("scan", "goal", "pose")),) == (112,)
    assert vector[3] == 0.5 and (np.delete(vector[:64], 3) == 0.0).all()
    np.testing.assert_allclose(vector[64:68], [1.0, 0.0, 0.1, 1.0 / 3.0], atol=1e-6)
    np.testing.assert_allclose(vector[68:72], [0.0, 1.0, 0.0, 1.0], atol=1e-6)
    phase = 2.0 * np.pi * np.array([[1.0], [2.0]]) / WAVES
    np.testing.assert_allclose(vector[72:82], np.sin(phase).ravel(), atol=1e-6)
    np.testing.assert_allclose(vector[102:112], np.cos(phase * [[1.0], [1.5]]).ravel(), atol=1e-6)


def test_the_uncertainty_is_in_the_bodys_frame():
    """A deviation along the map's x is cos 30 forward and sin 30 to the left of a robot at 30 degrees."""
    std = body_std(Localization(np.array([1.0, 2.0, np.pi / 6.0]), np.array([0.04, 0.0, 0.02]), Status.OK))
    np.testing.assert_allclose(std, [0.04 * np.cos(np.pi / 6.0), 0.02, 0.02])
    shown = {"goal": np.array([1.0, 1.0, 0.0]), "pose_std": std}
    np.testing.assert_allclose(features(shown, ("goal", "pose_std"))[4:], 10.0 * std, atol=1e-6)
    assert sum(size for part, size in SIZES.items() if not part.startswith(OBSERVED)) == 127


def test_commands_are_scaled_newest_first():
    history = CommandHistory(2)
    for sent in ([0.2, 0.0, 0.1], [0.1, -0.05, 0.2]):
        history.add(np.array([sent, sent]))
    history.begin(np.array([False, True]))
    shown = {"goal": np.tile([1.0, 1.0, 0.0], (2, 1)), "commands": history.commands}
    found = features(shown, ("goal", "commands"))[:, 4:]
    np.testing.assert_allclose(found[0], [0.5, -0.5, 1.0, 1.0, 0.0, 0.5, *[0.0] * 6], atol=1e-6)
    np.testing.assert_array_equal(found[1], 0.0)


def test_a_policy_of_commands_is_shown_what_it_has_sent():
    p = policy(parts=("goal", "commands"), frames=1)
    agent = agent_of(p)
    for _ in range(2):  # nothing is left of the last episode
        agent.reset(context(), observation(), 0)
        history = CommandHistory(1)
        for i in range(6):
            seen = observation(i)
            rim = stop_radius(0.4, agent._localizer.belief)  # type: ignore[attr-defined]
            goal = relative(np.array([0.5, 0.2, 0.3]), seen["goal"], 0.4 - rim)
            expected = p(features({"goal": goal, "commands": history.commands[0]}, p.spec.parts))
            sent = agent.act(seen).action[:3]
            np.testing.assert_allclose(sent, expected, atol=1e-6)
            history.add(sent[None])


def test_features_of_a_batch_are_those_of_each():
    rng = np.random.default_rng(0)
    shown = {"scan": rng.uniform(0, 8, (5, 64)), "goal": rng.normal(size=(5, 3)), "pose": rng.normal(size=(5, 3))}
    batch = features(shown, ("scan", "goal", "pose"))
    for i in range(5):
        one = features({key: value[i] for key, value in shown.items()}, ("scan", "goal", "pose"))
        np.testing.assert_array_equal(batch[i], one)


def test_relative_goal_is_that_of_the_wrapper():
    from vssm_gym.envs.wrappers import relative_goal

    pose, goal = np.array([1.0, -2.0, 2.5]), np.array([-0.5, 3.0], np.float32)
    theirs = relative_goal({"goal": goal, "pose": pose}, pose)["goal"]
    np.testing.assert_allclose(relative(pose, goal), theirs, atol=1e-6)
    assert relative(pose, goal, 0.25)[0] == pytest.approx(theirs[0] + 0.25)


# files


def test_a_saved_policy_is_the_same_policy(tmp_path):
    p = policy()
    policy_file.save(tmp_path / "policy.npz", p)
    found = policy_file.load(tmp_path / "policy.npz")
    assert found.spec == p.spec
    x = np.random.default_rng(1).normal(size=(6, 224)).astype(np.float32)
    np.testing.assert_array_equal(found(x), p(x))
    assert ((found(x) >= p.spec.low) & (found(x) <= p.spec.high)).all()


def test_labels_follow_the_content(tmp_path):
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        policy_file.save(tmp_path / f"{name}.npz", policy(seed))
    a, b, c = (policy_file.label(tmp_path / f"{name}.npz") for name in "abc")
    assert a == b != c
    assert re.fullmatch(r"small@[0-9a-f]{8}", a)
    assert policy_file.agent_label(f"policy:{tmp_path / 'a.npz'}") == a
    assert policy_file.agent_label("astar") == "astar"


@pytest.mark.parametrize("write", ["save", "copy"])
def test_labels_follow_the_file(tmp_path, write):
    """Saved in this process or by another one; the second sweep of a program is of the second policy."""
    path, other = tmp_path / "mine.npz", tmp_path / "other.npz"
    policy_file.save(path, policy())
    policy_file.save(other, policy(1))
    config = SweepConfig.model_validate({"scenes": "oak", "tasks": 1, "agents": [f"policy:{path}"]})
    before, first = policy_file.label(path), config_hash(config, {"oak": "0"}, 0)
    if write == "save":
        policy_file.save(path, policy(1))
    else:
        os.replace(other, path)
    assert policy_file.label(path) != before and config_hash(config, {"oak": "0"}, 0) != first
    np.testing.assert_array_equal(policy_file.loaded(str(path)).layers[0][0], policy(1).layers[0][0])


def test_rows_name_the_policy_that_was_run(tmp_path):
    """A training writes its policy every minute, also while a worker of a sweep runs the one before."""
    path, other = tmp_path / "policy.npz", tmp_path / "other.npz"
    policy_file.save(path, policy())
    policy_file.save(other, policy(1))
    agent, first = f"policy:{path}", policy_file.label(path)
    make_agent(agent)
    os.replace(other, path)
    assert policy_file.agent_label(agent) == first
    make_agent(agent)
    assert policy_file.agent_label(agent) != first
    make_agent(agent)
    policy_file.save(path, policy())
    assert policy_file.agent_label(agent) == first


def rewritten(path: Path, header: dict[str, Any] | None = None, **arrays: np.ndarray) -> Path:
    """Write a policy file with another header or other arrays."""
    policy_file.save(path, policy())
    with np.load(path) as stored:
        content = {name: stored[name] for name in stored.files}
    was = json.loads(content["header"].tobytes().decode())
    content["header"] = np.frombuffer(json.dumps(was | (header or {})).encode(), np.uint8)
    np.savez(path, **(content | arrays))  # type: ignore[arg-type]
    return path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"header": {"format": "other"}}, "version: expected vssm_gym.Policy version 1 or 2"),
        ({"header": {"version": 3}}, "version: expected"),
        ({"header": {"version": 2}}, "shift: expected float64 of shape"),
        ({"header": {"extra": 1}}, "header: expected the fields"),
        ({"header": {"activation": "os.system"}}, "activation: expected"),
        ({"header": {"activation": []}}, "activation: expected"),
        ({"header": {"parts": ["goal", []]}}, "parts: expected"),
        ({"header": {"hfov": 10**400}}, "header: expected whole numbers below"),
        ({"header": {"parts": ["scan"]}}, "parts: expected"),
        ({"header": {"frames": 1}}, "weight0: expected float32 of shape"),
        ({"header": {"hidden": [9, 5]}}, "weight0: expected"),
        ({"header": {"hfov": -1}}, "hfov: expected"),
        ({"bias1": np.full(5, np.nan, np.float32)}, "bias1: expected finite"),
        ({"weight1": np.zeros((5, 8))}, "weight1: expected"),
    ],
)
def test_a_file_that_does_not_fit_is_refused(tmp_path, changes, message):
    path = rewritten(tmp_path / "policy.npz", **changes)
    with pytest.raises(InputError, match=message) as error:
        policy_file.load(path)
    assert "\n" not in str(error.value)


class Bomb:
    """End the process that unpickles it."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os._exit, (3,)


def test_code_in_a_file_is_not_run(tmp_path):
    """Neither a pickle in place of the file is loaded, nor one as an array in it."""
    (tmp_path / "bare.npz").write_bytes(pickle.dumps(Bomb()))
    policy_file.save(tmp_path / "inside.npz", policy())
    rewritten(tmp_path / "inside.npz", bias0=np.array([Bomb()], dtype=object))
    for name in ("bare", "inside"):
        with pytest.raises(InputError, match="a policy file"):
            policy_file.load(tmp_path / f"{name}.npz")
    with pytest.raises(InputError, match="a policy file"):
        policy_file.load(tmp_path / "missing.npz")


# driving


def test_a_saved_policy_drives_as_before(tmp_path):
    policy_file.save(tmp_path / "policy.npz", policy())
    before = actions(agent_of(policy()))
    again = agent_of(str(tmp_path / "policy.npz"))
    np.testing.assert_array_equal(actions(again), before)
    np.testing.assert_array_equal(actions(again), before)  # nothing is left of the last episode
    assert len(np.unique(before, axis=0)) == len(before)


def test_the_policys_input_is_that_of_its_training():
    """Two frames: zeros before the first; the pose is the estimate; the goal lies farther by the stop's margin."""
    p, planar = policy(), (0.5, 0.2, 0.3)
    agent = agent_of(p, planar, std=0.02)
    agent.reset(context(), observation(0), 0)
    from vssm_gym.geometry.scan import scan_of

    rim = stop_radius(0.4, agent._localizer.belief)  # type: ignore[attr-defined]
    assert rim == pytest.approx(0.4 - 0.01 - 2.5 * 0.02)
    last = np.zeros(112, np.float32)
    for i in range(3):
        seen = observation(i)
        goal = relative(np.array(planar), seen["goal"], 0.4 - rim)
        shown = {"scan": scan_of(seen["depth"], 8.0), "goal": goal, "pose": np.array(planar)}
        now = features(shown, p.spec.parts)
        decision = agent.act(seen)
        np.testing.assert_allclose(decision.action[:3], p(np.concatenate([last, now])), atol=1e-6)
        assert decision.action[3] == 0.0 and decision.status == "driving; localization: ok"
        last = now


@pytest.mark.parametrize(("away", "stops"), [(0.33, True), (0.35, False)])
def test_it_stops_inside_the_success_region_by_a_margin(away, stops):
    agent = agent_of(policy(), (0.0, 0.0, 0.0), std=0.02)
    agent.reset(context(), observation(), 0)
    action = agent.act(observation(goal=(away, 0.0))).action
    assert (action[3] == 1.0) == stops
    assert (action[:3] == 0.0).all() == stops


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"limits": 2.0 * ROBOT.limits}, "limits: expected a robot with"),
        ({"K": Camera.from_hfov(160, 120, 1.0).K}, "camera: expected at least 64 pixels wide, 90.0 degrees"),
        ({"success_radius": 0.2}, "success_radius: expected 0.4 m; found 0.2"),
    ],
)
def test_another_robot_is_refused(changes, message):
    with pytest.raises(InputError, match=message):
        agent_of(policy()).reset(context(**changes), observation(), 0)


# sweeps


def test_a_sweep_names_a_policy_by_its_file(tmp_path):
    """A relative path starts at the YAML; rows have the label; the hash is of the content, not of the path."""
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        policy_file.save(tmp_path / folder / "policy.npz", policy())
        (tmp_path / folder / "sweep.yaml").write_text("scenes: oak\nagents: [astar, 'policy:policy.npz']\ntasks: 1\n")
    one, two = (load_config(tmp_path / folder / "sweep.yaml") for folder in ("one", "two"))
    assert one.agents == ("astar", f"policy:{tmp_path / 'one' / 'policy.npz'}") != two.agents
    assert config_hash(one, {"oak": "0"}, 0) == config_hash(two, {"oak": "0"}, 0)
    assert agent_type(one.agents[1]) is PolicyAgent
    assert make_agent(one.agents[1]).name == "small"


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"agents": ["policy:{0}/missing.npz"]}, "a policy file"),
        ({"agents": ["policy:{0}/a.npz", "policy:{0}/b.npz"]}, "policies that differ"),
        ({"agents": ["policy:{0}/a.npz"], "env": "vssm_gym/CarNav-v0", "robot": "car"}, "agents: expected one of"),
    ],
)
def test_a_sweep_refuses_policies_that_cannot_run(tmp_path, fields, message):
    for name in "ab":
        policy_file.save(tmp_path / f"{name}.npz", policy())
    agents = [agent.format(tmp_path) for agent in fields["agents"]]
    config = SweepConfig.model_validate({"scenes": "oak", "tasks": 1, **fields, "agents": agents})
    with pytest.raises(InputError, match=message):
        check_names(config, "sweep.yaml")


def test_returns_are_computed_from_rows():
    """Two rows by hand: a time-out after 5 of 6 m, and a success after a detour."""
    lost = {"soft_spl": 5.0 / 6.0, "path_length": 5.0, "geodesic": 6.0, "steps": 500, "success": False}
    assert real_return(lost) == pytest.approx(5.0 - 5.0)
    won = {"soft_spl": 0.75, "path_length": 8.0, "geodesic": 6.0, "steps": 60, "success": True}
    assert real_return(won) == pytest.approx(6.0 - 0.6 + 2.5)


def test_imagined_robots_are_commanded_by_the_network_alone():
    rng = np.random.default_rng(0)
    seen = {"scan": rng.uniform(0.3, 4.0, (5, 64)), "goal": rng.normal(size=(5, 3)), "pose": rng.normal(size=(5, 3))}
    seen["pose_std"] = rng.uniform(0.0, 0.1, (5, 3))
    one = policy(frames=1)
    commands = PolicyAgent(one).commands(seen)
    assert commands.shape == (5, 3)
    for k, command in enumerate(commands):
        alone = {name: value[k] for name, value in seen.items()}
        np.testing.assert_allclose(command, one(features(alone, one.spec.parts)), atol=1e-6)
    with pytest.raises(InputError, match="frames: expected a policy of one observation; it reads 4"):
        PolicyAgent(policy(frames=4)).commands(seen)
    with pytest.raises(InputError, match="inputs: expected a policy of one observation; it reads its last commands"):
        PolicyAgent(policy(frames=1, parts=("goal", "commands"))).commands(seen)
