"""Test the car without a map end to end: it parks where it says, and says what is wrong where it cannot."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest

from tests.agents.car.test_car_agents import ROOMS, context, task
from vssm_gym.agents.car.slam_car import SlamCarAgent, SlamCarConfig
from vssm_gym.agents.shared.car.recovery import RESPONSES, Failure, Response
from vssm_gym.agents.shared.trust import LostConfig
from vssm_gym.errors import InputError
from vssm_gym.eval.protocols.agent_context import agent_context
from vssm_gym.eval.protocols.carnav import run_episode
from vssm_gym.planning.value_iteration import sweeps

GOAL = (1.6, 3.2, 0.0)
FROM = 8  # step of the first faulty image


@pytest.fixture(scope="module")
def agent() -> SlamCarAgent:
    return SlamCarAgent()


@pytest.fixture
def env():
    made = gym.make("vssm_gym/CarNav-v1", scene=ROOMS, noise="low", reward="sparse", disable_env_checker=True)
    yield made
    made.close()


@pytest.mark.slow
@pytest.mark.parametrize("goal", [GOAL, (2.2, 0.7, 2.5), (4.6, 2.0, -1.5)])
def test_it_parks_without_a_map_nor_a_collision(agent, env, goal):
    row = run_episode(env, agent, task(goal), seed=3, voxel_map=None)
    assert row["success"] and not row["collided"] and row["end_on"] == "stop"
    assert row["location_error_max"] < 0.05 and row["in_95"] > 0.8
    assert isinstance(row["responses"], dict)
    assert agent.map.table is not None and int(agent.map.table.refused) == 0


@pytest.mark.slow
def test_nothing_is_compiled_between_steps(agent, env):
    """After the first episode no step of another compiles the sweeps again."""
    run_episode(env, agent, task(GOAL), seed=3, voxel_map=None)
    compiled = len(sweeps._iterate.signatures)
    run_episode(env, agent, task((2.2, 0.7, 2.5)), seed=4, voxel_map=None)
    assert len(sweeps._iterate.signatures) == compiled


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "failure"), [("dark", Failure.BLIND), ("frozen", Failure.FROZEN), ("elsewhere", Failure.LOST)]
)
def test_a_car_whose_camera_fails_stops_nowhere_and_gives_up(agent, env, fault, failure):
    """Its responses are those of the table; it claims no arrival, and its status begins as the harness expects."""
    observation, info = env.reset(seed=3, options={"task": task((4.6, 2.0, -1.5))})
    agent.reset(agent_context(env, info), observation, 0)
    noise = np.random.default_rng(0)
    for k in range(120):
        if k >= FROM:
            held = observation if k == FROM else held
            images = {
                "dark": {name: np.zeros_like(observation[name]) for name in ("rgb", "depth")},
                "frozen": {name: held[name] for name in ("rgb", "depth")},
                "elsewhere": {
                    "rgb": noise.integers(0, 255, observation["rgb"].shape).astype(np.uint8),
                    "depth": noise.uniform(0.5, 3.0, observation["depth"].shape).astype(np.float32),
                },
            }[fault]
            observation = {**observation, **images}
        decision = agent.act(observation)
        assert decision.action[2] == 0.0
        if decision.gives_up:
            break
        observation, _, terminated, _, _ = env.step(decision.action)
        assert not terminated
    assert decision.gives_up and decision.status.startswith("gave up: lost")
    # Images that stay dark repeat, too: in the end it is frozen images that the car gives up for.
    assert decision.responses[Response.GIVE_UP.value] == 1
    assert decision.responses[RESPONSES[failure][0][0].value] >= 1


@pytest.mark.slow
def test_it_gives_up_after_the_bound_on_steps_without_a_pose():
    """Whatever the table would try next. Its view is that of the camera that it was given."""
    made = {"noise": "low", "reward": "sparse", "disable_env_checker": True, "camera": {"hfov": 1.4}}
    env = gym.make("vssm_gym/CarNav-v1", scene=ROOMS, **made)
    agent = SlamCarAgent(SlamCarConfig(lost=LostConfig(give_up=5)))
    observation, info = env.reset(seed=3, options={"task": task((4.6, 2.0, -1.5))})
    agent.reset(agent_context(env, info), observation, 0)
    assert agent._half_angle == pytest.approx(0.7)
    dark = {name: np.zeros_like(observation[name]) for name in ("rgb", "depth")}
    given_up = []
    for _ in range(12):
        decision = agent.act(observation)
        given_up.append(decision.gives_up)
        observation = env.step(decision.action)[0] | dark
    env.close()
    assert given_up.index(True) == 6 and decision.status.startswith("gave up: lost for")


def test_a_robot_that_is_no_car_is_refused():
    with pytest.raises(InputError, match="car"):
        SlamCarAgent().reset(dataclasses.replace(context(), car=None), {"goal": np.zeros(3)}, 0)
