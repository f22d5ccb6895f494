"""Test LidarMaze's tasks: ends, rewards, exploration, and which tasks are drawn."""

import math

import numpy as np
import pytest

from tests.helpers.plane.maze_episodes import MAZE, TASK, act, make
from vssm_gym.envs.lidar_maze import MAZE_REWARD
from vssm_gym.envs.tasks.goal_progress import GoalDistance
from vssm_gym.envs.tasks.maze_objectives import TILE
from vssm_gym.errors import InputError


def test_stop_ends_the_episode_and_decides_success():
    env = make()
    env.reset(options={"task": TASK})
    *_, terminated, _, info = env.step(act(turn=0.1, step=0.02, stop=1.0))
    assert terminated and info["success"] is False
    np.testing.assert_array_equal(info["pose"], TASK.start)  # a stop carries out nothing else
    np.testing.assert_array_equal(info["control"], np.zeros(2))
    env.reset(options={"task": TASK})
    assert not any(env.step(act(step=0.02, stop=0.5))[2] for _ in range(8))
    *_, terminated, _, info = env.step(act(stop=0.51))
    assert terminated and info["success"] is True
    assert env.path_length == pytest.approx(0.16)


def test_reach_ends_within_a_twentieth_for_every_stop_value():
    env = make(end_on="reach")
    env.reset(options={"task": TASK})
    ended = [env.step(act(step=0.02, stop=1.0)) for _ in range(8)]
    assert [done[2] for done in ended] == [False] * 7 + [True]  # 0.02 x 7 = 0.14 is not within 0.05 of 0.2
    assert ended[-1][4]["success"] is True and "success" not in ended[0][4]


def test_dense_rewards_add_up_to_progress_costs_and_prize():
    env = make()
    env.reset(options={"task": TASK})
    rewards = [env.step(act(turn=0.05, step=0.02))[1] for _ in range(5)] + [env.step(act(stop=1.0))[1]]
    distance = GoalDistance(MAZE.space, 0.01)
    distance.aim(np.array(TASK.goal))
    gained = distance(np.array(TASK.start[:2])) - distance(env.planar[:2])
    assert sum(rewards) == pytest.approx(gained - 6 * MAZE_REWARD.step_cost)
    assert gained > 0.05
    env.reset(options={"task": MAZE.sampler.task((0.27, 0.1, 0.0), TASK.goal)})
    assert env.step(act(stop=1.0))[1] == pytest.approx(MAZE_REWARD.success - MAZE_REWARD.step_cost)


def test_the_grid_behind_the_reward_follows_the_exact_geodesic():
    distance, exact = GoalDistance(MAZE.space, 0.01), MAZE.sampler.geodesics
    points = MAZE.space.sample(np.random.default_rng(0), 40, 0.002)
    distance.aim(points[0])
    for point in points[1:]:
        true = exact.length(point, points[0])
        assert true - 0.01 <= distance(point) <= 1.03 * true + 0.02


def test_sparse_rewards_success_only():
    env = make(reward="sparse")
    env.reset(options={"task": TASK})
    assert env.step(act(step=0.02))[1] == 0.0 and env.step(act(stop=1.0))[1] == 0.0
    env.reset(options={"task": MAZE.sampler.task((0.27, 0.1, 0.0), TASK.goal)})
    assert env.step(act(stop=1.0))[1] == MAZE_REWARD.success


def test_exploration_pays_for_new_tiles_and_ends_when_all_are_visited():
    env = make(task="explore", end_on="reach", scene="pillars-v1", tasks=None)
    observation, info = env.reset(options={"task": env.maze.sampler.task((0.05, 0.05, 0.0), (0.9, 0.9))})
    assert set(observation) == {"scan"} and set(info) == {
        *("pose", "collision", "control", "coverage", "task", "start_pose")
    }
    counted = int(env.objective.counted.sum())
    assert info["coverage"] == pytest.approx(1.0 / counted)
    steps = [env.step(act(step=0.02)) for _ in range(6)]  # crosses x = 0.1 and stays below 0.2
    assert sum(step[1] for step in steps) == pytest.approx(TILE - 6 * MAZE_REWARD.step_cost)
    assert steps[-1][4]["coverage"] == pytest.approx(2.0 / counted)
    env.objective.visited[:] = env.objective.counted
    env.objective.visited[1, 0] = False
    _, reward, terminated, _, info = env.step(act(step=0.02))
    assert terminated and info["success"] is True and info["coverage"] == 1.0
    assert reward == pytest.approx(TILE + MAZE_REWARD.success - MAZE_REWARD.step_cost)
    env.reset(seed=0)
    assert env.objective.visited.sum() == 1


def test_exploration_can_be_stopped_short():
    env = make(task="explore")
    env.reset(seed=0)
    *_, terminated, _, info = env.step(act(stop=1.0))
    assert terminated and info["success"] is False


def test_tasks_are_drawn_from_the_given_set_and_from_options_first():
    few = MAZE.tasks.model_copy(update={"tasks": MAZE.tasks.tasks[:3]})
    env = make(tasks=few)
    assert {env.reset(seed=seed)[1]["task"].id for seed in range(20)} == {0, 1, 2}
    assert env.reset(options={"task": TASK})[1]["task"] == TASK


def test_a_chained_task_may_begin_where_contacts_left_the_robot():
    env = make()
    env.reset(options={"task": MAZE.sampler.task((0.1, 0.1, math.pi), TASK.goal)})
    for _ in range(8):
        *_, info = env.step(act(step=0.02))
    assert info["collision"]
    chained = MAZE.sampler.task(tuple(info["pose"]), (0.9, 0.9))
    np.testing.assert_array_equal(env.reset(options={"task": chained})[1]["start_pose"], info["pose"])


@pytest.mark.parametrize(
    ("task", "field", "expected"),
    [
        (TASK.model_copy(update={"goal": (0.4, 0.3)}), "goal", "wall"),
        (TASK.model_copy(update={"start": (0.4, 0.3, 0.0)}), "start", "wall"),
        (
            MAZE.sampler.task((0.365, 0.3, 0.0), (0.3, 0.1)),
            "start",
            "collides with no wall",
        ),  # 7 mm: fine for a flat
        (TASK.model_copy(update={"scene": "elsewhere"}), "scene", "rooms-v1"),
        ({"goal": (0.5, 0.5)}, "options['task']", "dict"),
    ],
)
def test_impossible_tasks_are_named(task, field, expected):
    with pytest.raises(InputError) as error:
        make().reset(options={"task": task})
    assert error.value.field == field and expected in str(error.value)
