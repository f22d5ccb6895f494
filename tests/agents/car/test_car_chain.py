"""Test a chain of targets without a stop in between: the agent receives the next target while the car moves."""

import gymnasium as gym
import numpy as np
import pytest

from tests.agents.car.test_car_agents import FLOOR, SOLIDS
from tests.helpers.box_rooms import furniture, two_rooms
from tests.helpers.planning_worlds import voxel_map
from vssm_gym.agents.base import AgentContext
from vssm_gym.agents.registry import AGENTS
from vssm_gym.model.transition import Bicycle

ROOMS = two_rooms(pieces=(furniture("crate", (1.5, 1.2, 0.25), (0.6, 0.4, 0.5)),))
TARGETS = 8


@pytest.mark.slow
def test_a_chain_of_targets_is_driven_as_one():
    """After one reset all eight targets are reached without a collision; each starts at the state where one ended."""
    env = gym.make(
        "vssm_gym/CarNav-v0",
        scene=ROOMS,
        chain=True,
        observe_pose=True,
        images=False,
        reward="sparse",
        disable_env_checker=True,
    )
    agent, car = AGENTS["vi_mpc"](), env.unwrapped.car
    observation, info = env.reset(seed=1)
    learned = voxel_map(FLOOR, SOLIDS)
    context = AgentContext(
        K=info["K"],
        camera=(160, 120),
        T_body_cam=car.T_body_cam,
        limits=car.limits,
        dt=car.dt,
        map=learned,
        start_pose=info["start_pose"],
        body_length=car.length,
        success_radius=0.1,
        noise=(0.02, 0.01),
        transition=Bicycle(),
        car=car,
    )
    agent.reset(context, observation, 0)
    moving = []
    for target in range(TARGETS):
        ended = False
        while not ended:
            decision = agent.act(observation)
            assert not decision.gives_up, decision.status
            observation, _, terminated, truncated, info = env.step(decision.action)
            ended = terminated or truncated
        assert info["success"], (target, decision.status)
        assert info["collisions"] == 0
        moving.append(abs(float(decision.action[0])) > 0.1)
        before = np.array(env.unwrapped.planar)
        observation, info = env.reset()
        np.testing.assert_allclose(env.unwrapped.planar, before, atol=1e-6)
    assert any(moving)
    env.close()
