"""Test one episode: metrics come from the simulator's ground truth, and each kind of failure has its own reason."""

import json
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import shapely

from tests.helpers.box_rooms import two_rooms
from tests.helpers.planning_worlds import voxel_map
from vssm_gym.agents.base import Decision
from vssm_gym.agents.registry import AGENTS
from vssm_gym.envs.robots import NOISE_LEVELS, ExecutionNoise, HolonomicRobot
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.envs.tasks.navigation import TaskSampler
from vssm_gym.errors import InputError
from vssm_gym.eval.metrics.failure import failure_reason
from vssm_gym.eval.protocols.episode import run_episode
from vssm_gym.inference.status import Status
from vssm_gym.planning.result import PlanStatus

LIMIT = 40


class Scripted:
    """Repeat one command and one status, and estimate the pose as ``pose``, a function of the start pose.

    Every estimate states the same covariance.
    """

    name, needs_pose, needs_map = "scripted", False, False

    def __init__(self, command, stop_after=10**6, pose=None, status="driving", covariance=None):
        self.command, self.stop_after, self.pose, self.status = command, stop_after, pose, status
        self.covariance = covariance
        self.seen = []

    def reset(self, context, observation, seed):
        self.context, self.steps, self.seed = context, 0, seed
        self.seen.append(set(observation))

    def act(self, observation):
        self.steps += 1
        stop = float(self.steps > self.stop_after)
        pose = None if self.pose is None else self.pose(self.context.start_pose, self.steps)
        self.seen.append(set(observation))
        action, latency = np.array([*self.command, stop], np.float32), {"control": 0.002}
        return Decision(action, pose, self.status, latency, covariance=self.covariance)


@pytest.fixture(scope="module")
def sampler():
    return TaskSampler(two_rooms(), HolonomicRobot())


@pytest.fixture(scope="module")
def env():
    made = gym.make("vssm_gym/PointNav-v0", scene=two_rooms(), noise="none", max_episode_steps=LIMIT)
    yield made
    made.close()


def moved(start, x, y):
    return np.add(start, [x, y, 0.0])


def run(env, sampler, agent, start=(1.0, 2.0, 0.0), goal=(5.0, 2.0), seed=0):
    task = sampler.task(start, goal)
    return run_episode(env, sampler, agent, task, seed=seed, voxel_map=None, noise=NOISE_LEVELS["none"])


def test_success_and_its_numbers(env, sampler):
    """Through the open door without noise: 4 m along y = 2 at 0.16 m a step, stopped 0.32 m from the goal."""
    agent = Scripted((0.0, 0.0, 0.16), stop_after=23, pose=lambda start, n: moved(start, 0.16 * (n - 1), 0.03))
    row = run(env, sampler, agent)
    assert row["success"]
    assert row["failure"] is None
    assert row["path_length"] == pytest.approx(23 * 0.16, abs=1e-3)
    assert row["geodesic"] == pytest.approx(3.6, abs=1e-3)
    assert row["spl"] == row["soft_spl"] == pytest.approx(3.6 / 3.68, abs=1e-3)
    assert row["distance_to_goal"] == pytest.approx(0.32, abs=1e-3)
    assert (row["steps"], row["collisions"]) == (24, 0)
    assert row["location_error_mean"] == pytest.approx(0.03, abs=1e-3)
    assert row["location_error_final"] == pytest.approx(0.03, abs=1e-3)
    assert row["latency"]["control"] == {"p50": 0.002, "p95": 0.002}
    assert row["latency"]["total"]["p50"] > 0.0
    true, estimate = np.array(row["trace"]["true"]), np.array(row["trace"]["estimate"])
    np.testing.assert_allclose(estimate - true, np.broadcast_to([0.0, 0.03], true.shape), atol=2e-3)
    assert row["trace"]["contacts"] == []
    json.dumps(row, allow_nan=False)


def test_the_calibration_of_estimates_by_hand(env, sampler):
    """An estimate 3 cm to the left of a robot that drives along -y: two standard deviations, at every step but one.

    The first pose is known; it is wrong here, and does not count.
    """

    def estimate(start, n):
        return moved(start, 0.03 if n > 1 else 9.0, -0.16 * (n - 1))

    covariance = np.diag([0.5**2, 0.015**2, 0.1**2])
    agent = Scripted((0.0, 0.0, 0.16), stop_after=5, pose=estimate, covariance=covariance)
    row = run(env, sampler, agent, start=(1.5, 3.0, -np.pi / 2), goal=(1.5, 1.0))
    assert row["nees"] == pytest.approx(2.0**2 / 3.0, rel=1e-3)
    assert row["in_95"] == 1.0  # 4 is below 7.8
    narrow = Scripted((0.0, 0.0, 0.16), stop_after=5, pose=estimate, covariance=0.25 * covariance)
    row = run(env, sampler, narrow, start=(1.5, 3.0, -np.pi / 2), goal=(1.5, 1.0))
    assert (row["nees"], row["in_95"]) == (pytest.approx(4.0**2 / 3.0, rel=1e-3), 0.0)


def test_an_agent_without_a_covariance_has_no_calibration(env, sampler):
    row = run(env, sampler, Scripted((0.0, 0.0, 0.16), stop_after=2, pose=lambda start, n: start))
    assert row["location_error_mean"] > 0.0
    assert (row["nees"], row["in_95"]) == (None, None)


@pytest.mark.parametrize(
    "covariance",
    [
        np.eye(2),
        np.diag([1.0, 1.0, -1.0]),
        np.eye(3) + 0.5 * np.eye(3, k=1),
        np.diag([1.0, np.nan, 1.0]),
        np.diag([np.inf, 1.0, 1.0]),
    ],
)
def test_a_covariance_that_is_none_is_refused(env, sampler, covariance):
    agent = Scripted((0.0, 0.0, 0.16), stop_after=2, pose=lambda start, n: start, covariance=covariance)
    with pytest.raises(InputError, match=r"agent scripted: covariance: expected of \(forward, left, turn\)"):
        run(env, sampler, agent)


def test_a_covariance_without_a_pose_is_refused(env, sampler):
    with pytest.raises(InputError, match="with a pose"):
        run(env, sampler, Scripted((0.0, 0.0, 0.16), covariance=np.eye(3)))


def test_an_observed_pose_is_no_estimate(env, sampler):
    """Its errors would be those of rounding."""
    agent = Scripted((0.0, 0.0, 0.16), stop_after=2, pose=lambda start, n: start)
    agent.needs_pose = True
    row = run(env, sampler, agent)
    assert row["location_error_mean"] is None
    assert row["trace"]["estimate"] is None


def test_the_agent_sees_observations_and_a_static_context_only(env, sampler):
    agent = Scripted((0.0, 0.0, 0.1), stop_after=3)
    run(env, sampler, agent, seed=3)
    assert all(names == {"rgb", "depth", "goal"} for names in agent.seen)
    assert agent.context.map is None
    np.testing.assert_allclose(agent.context.start_pose, [1.0, 2.0, 0.0])
    assert not any(isinstance(value, gym.Env) for value in vars(agent.context).values())
    first = agent.seed
    run(env, sampler, agent, seed=3)
    assert agent.seed == first
    run(env, sampler, agent, seed=4)
    assert agent.seed != first


def test_an_agent_that_stops_too_early_stopped_outside(env, sampler):
    row = run(env, sampler, Scripted((0.0, 0.0, 0.16), stop_after=5))
    assert row["failure"].startswith("stopped outside: 3.200 m")
    assert row["spl"] == 0.0
    assert row["soft_spl"] == pytest.approx(1.0 - 2.8 / 3.6, abs=1e-2)
    assert row["location_error_mean"] is None
    assert row["trace"]["estimate"] is None


def test_an_agent_with_a_wrong_estimate_lost_track(env, sampler):
    drifting = Scripted((0.0, 0.0, 0.16), stop_after=20, pose=lambda start, n: moved(start, 0.16 * (n - 1), 0.06 * n))
    row = run(env, sampler, drifting)
    assert row["failure"].startswith("lost track: 1.26 m off at the end, more than 0.2 m since step 3")
    assert row["failure"].endswith("unnoticed by the agent")
    assert row["location_error_final"] == row["location_error_max"] == pytest.approx(1.26, abs=1e-3)


def test_an_agent_at_a_wall_collided(env, sampler):
    row = run(env, sampler, Scripted((0.0, 0.0, 0.16)), start=(1.0, 3.0, 0.0))
    assert row["failure"].startswith("collision: stuck")
    assert row["steps"] == LIMIT
    assert row["collisions"] > 20
    assert 1 <= len(row["trace"]["contacts"]) <= 30
    assert row["trace"]["true"][-1] == pytest.approx([2.85, 3.0], abs=0.01)


class GivesUp(Scripted):
    """Ends its task because it does not believe its estimate."""

    def act(self, observation):
        decision = super().act(observation)
        ends = bool(decision.action[3] > 0.5)
        return replace(decision, gives_up=ends, status="gave up: lost for 65 steps" if ends else "driving")


def test_to_give_up_at_the_goal_is_no_success(env, sampler):
    """The robot stands 0.32 m from the goal, but the stop claims nothing."""
    agent = GivesUp((0.0, 0.0, 0.16), stop_after=23, pose=lambda start, n: moved(start, 0.16 * (n - 1), 0.0))
    row = run(env, sampler, agent)
    assert row["distance_to_goal"] < 0.4
    assert not row["success"]
    assert row["spl"] == 0.0
    assert row["failure"].startswith("lost: gave up: lost for 65 steps")


def test_an_agent_that_goes_in_circles_ran_out_of_time(env, sampler):
    row = run(env, sampler, Scripted((0.2, 0.0, 0.05)))
    assert row["failure"].startswith("time out")
    assert row["steps"] == LIMIT


def reason(**changes):
    n = 30
    facts = {
        "stopped": True,
        "statuses": ["driving; localization: ok"] * n,
        "positions": np.zeros((n + 1, 2)),
        "estimates": np.zeros((n + 1, 2)),
        "goal": np.array([2.0, 0.0]),
        "contacts": np.zeros(n, bool),
        "body_length": 0.2,
    }
    return failure_reason(**(facts | changes))


def test_a_failure_is_the_planners_only_with_a_good_estimate():
    gave_up = ["driving"] * 29 + [
        "gave up: no path: everything that is free around the start was searched; localization: ok"
    ]
    assert reason(statuses=gave_up).startswith("planner: gave up: no path")
    lost = np.linspace([0.0, 0.0], [0.0, 1.0], 31)
    assert reason(statuses=gave_up, estimates=lost).startswith("lost track: 1.00 m")


@pytest.mark.parametrize("said", ["gave up", "looking around"])
@pytest.mark.parametrize("status", [s for s in PlanStatus if s is not PlanStatus.FOUND])
def test_every_message_of_the_planner_is_its_failure(said, status):
    assert reason(statuses=[f"{said}: {status.message}; localization: ok"]).startswith(f"planner: {said}")
    driving = reason(statuses=[f"{said}: {status.message}", "driving; localization: ok"])
    assert driving.startswith("stopped outside")


class Scrambled(gym.Wrapper):
    """Replace every value of ``info`` by noise, except the start pose and the camera, which agents receive."""

    def __init__(self, env, seed):
        super().__init__(env)
        self.noise, self.actions = np.random.default_rng(seed), []

    def _scramble(self, info):
        kept = {"K", "start_pose"}
        drawn = {key: self.noise.normal(size=np.shape(value)) for key, value in info.items() if key not in kept}
        return {key: drawn.get(key, value) for key, value in info.items()}

    def reset(self, **keywords):
        observation, info = self.env.reset(**keywords)
        return observation, self._scramble(info)

    def step(self, action):
        self.actions.append(action)
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, self._scramble(info)


# Compiling a tracker takes more than 5 s.
@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow) if name in ("astar", "no_map") else name
        for name, agent in AGENTS.items()
        if agent.robot == "holonomic" and agent.task == "pointgoal"
    ],
)
def test_no_agent_uses_info(name, sampler):
    """Two runs whose infos have nothing in common have the same actions to the last bit."""
    agent, learned = AGENTS[name](), voxel_map(shapely.box(0.05, 0.05, 5.95, 3.95), [])
    camera = CameraConfig(width=64, height=48)
    made = gym.make(
        "vssm_gym/PointNav-v0",
        scene=two_rooms(),
        noise="low",
        max_episode_steps=6,
        camera=camera,
        observe_pose=agent.needs_pose,
    )
    actions = []
    for seed in range(2):
        env, task = Scrambled(made, seed), sampler.task((1.0, 1.0, 0.5), (2.6, 3.0))
        run_episode(env, sampler, agent, task, seed=5, voxel_map=learned, noise=ExecutionNoise(0.05, 0.01))
        actions.append(np.array(env.actions))
    made.close()
    assert len(actions[0]) == 6
    assert np.abs(actions[0]).max() > 0.0
    np.testing.assert_array_equal(*actions)


def test_a_contact_before_the_error_grew_is_named_and_a_later_one_is_not():
    estimates = np.zeros((31, 2))
    estimates[20:] = 0.5
    before, after = np.zeros(30, bool), np.zeros(30, bool)
    before[17], after[25] = True, True
    assert "since step 20, after a contact" in reason(estimates=estimates, contacts=before)
    assert "after a contact" not in reason(estimates=estimates, contacts=after)


def test_a_corrected_error_is_no_lost_track():
    estimates = np.zeros((31, 2))
    estimates[10:15] = 3.0
    assert reason(estimates=estimates).startswith("stopped outside: 2.000 m")


def test_the_reason_states_that_the_tracker_noticed():
    statuses = [f"driving; localization: {Status.LOST}"] * 30
    assert reason(statuses=statuses, estimates=np.ones((31, 2))).endswith("which the agent noticed")
