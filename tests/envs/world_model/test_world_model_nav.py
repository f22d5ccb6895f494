"""Test WorldModelNav as an environment: checkers, seeds, resets, ends of episodes, spaces, errors."""

import pickle
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from tests.helpers.imagined_room import half_seen, make, make_vec, random_actions, task
from vssm_gym.envs.pointnav import POINTNAV_REWARD
from vssm_gym.envs.scan_wrapper import ScanObservation
from vssm_gym.envs.world_model import batch_slices
from vssm_gym.envs.wrappers import DepthOnly, RelativeGoal
from vssm_gym.errors import InputError
from vssm_gym.geometry.car import Car
from vssm_gym.geometry.transforms import wrap_angle

STRAIGHT = np.array([0.0, 0.0, 0.16, 0.0], np.float32)
EXACT: dict[str, Any] = {"noise": "none", "pose_std": (0.0, 0.0, 0.0)}


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["holonomic", "car"])
def test_both_checkers_accept_it(robot):
    pytest.importorskip("pygame", reason="the checker opens a window: the human extra is not installed")
    theirs = pytest.importorskip("stable_baselines3.common.env_checker", reason="the rl extra is not installed")
    env = make(robot=robot, render_mode="rgb_array").unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*")  # SI units are not in [-1, 1]
        check_env(env, skip_render_check=False)
        warnings.filterwarnings("ignore", category=UserWarning)  # its advice for its own networks
        theirs.check_env(env)


@pytest.mark.slow
def test_captions_count_the_episode_and_keep_the_picture():
    env, plain = (make(render_mode="rgb_array", captions=captions, **EXACT).unwrapped for captions in (True, False))
    assert env.render() is None
    env.reset(seed=0)
    plain.reset(seed=0)
    for _ in range(2):
        reward = env.step(STRAIGHT)[1]
        plain.step(STRAIGHT)
    picture = plain.render()
    np.testing.assert_array_equal(env.render()[: len(picture)], picture)
    assert len(env.render()) > len(picture) == 360
    (_, captions), *none = env.vector.plans()
    shown = {caption.label: caption.value for caption in captions}
    away = np.hypot(*(env.planar[:2] - env.vector.goals[0]))
    assert (
        not none and shown["step"] == "2" and shown["reward"] == f"{reward:+.3f}" and shown["goal"] == f"{away:.2f} m"
    )
    env.reset(seed=1)
    assert env.vector.plans()[0][1][0].value == "0"


def test_spaces_are_those_of_the_real_task():
    """Wrappers convert the real task's images to a scan and its goal to the robot's frame."""
    camera = {"width": 64, "height": 48}
    real = RelativeGoal(gym.make("vssm_gym/PointNav-v0", camera=camera, observe_pose=True))
    for observation, wrapped in (("scan", ScanObservation(real)), ("depth", DepthOnly(real)), ("rgbd", real)):
        env = make(observation=observation)
        assert env.observation_space == wrapped.observation_space
        assert env.action_space == wrapped.action_space
    assert env.unwrapped.success_radius == real.unwrapped.success_radius
    real.close()


def test_a_cars_spaces_are_those_of_the_real_task():
    """Spaces equal CarNav's, except that the real observation holds images and the imagined one a scan."""
    real = RelativeGoal(gym.make("vssm_gym/CarNav-v0", targets="points", observe_pose=True))
    env = make(robot="car")
    assert env.action_space == real.action_space
    for key in ("goal", "pose"):
        assert env.observation_space[key] == real.observation_space[key]
    real.close()


def test_streams_without_a_seed_differ_from_all_others():
    """They also differ from those of an equal call before."""
    keys = []
    for _ in range(2):
        env = make_vec(3)
        env.reset(seed=[5, None, None])
        keys.append(np.asarray(env._batch.state.key))
        env.close()
    np.testing.assert_array_equal(keys[0][0], keys[1][0])
    assert len(np.unique(np.concatenate(keys), axis=0)) == 5


def test_an_episode_by_hand():
    """A goal 1.95 m straight ahead is reached to within 0.4 m in ten exact steps of 16 cm."""
    env = make(**EXACT, end_on="reach", tasks=[task((1.0, 1.2, 0.0), (2.95, 1.2))])
    observation, info = env.reset(seed=0)
    np.testing.assert_allclose(observation["goal"], [1.95, 1.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(observation["pose"], [1.0, 1.2, 0.0], atol=1e-6)
    np.testing.assert_allclose(info["start_pose"], [1.0, 1.2, 0.0], atol=1e-6)
    total = 0.0
    for i in range(1, 11):
        observation, reward, terminated, truncated, info = env.step(STRAIGHT)
        np.testing.assert_allclose(observation["pose"], [1.0 + 0.16 * i, 1.2, 0.0], atol=1e-4)
        assert terminated == (i == 10) and not truncated and not info["collision"]
        total += reward
    assert info["success"]
    assert total == pytest.approx(
        1.6 - 10 * POINTNAV_REWARD.step_cost + POINTNAV_REWARD.success, abs=0.05
    )  # a grid's paths are up to 3 % longer


def test_a_stop_is_evaluated_where_the_robot_stands():
    env = make(**EXACT, tasks=[task((1.0, 1.2, 0.0), (3.0, 1.2))])
    env.reset(seed=0)
    observation, reward, terminated, _, info = env.step(np.array([0.1, 0.0, 0.16, 1.0], np.float32))
    assert terminated and not info["success"]
    assert reward == pytest.approx(-POINTNAV_REWARD.step_cost, abs=1e-4)
    np.testing.assert_allclose(observation["pose"], [1.0, 1.2, 0.0], atol=1e-5)  # nothing else is carried out
    with pytest.raises(gym.error.ResetNeeded):
        env.step(STRAIGHT)


def test_a_wall_is_a_collision_and_stops_it():
    env = make(**EXACT, tasks=[task((4.6, 1.2, 0.0), (1.0, 1.2))])
    env.reset(seed=0)
    for _ in range(4):
        observation, *_, info = env.step(STRAIGHT)
    assert info["collision"]
    assert observation["pose"][0] == pytest.approx(4.9, abs=0.02)


def test_next_step_autoreset_and_truncation():
    env = make_vec(3, max_episode_steps=4)
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    env.reset(seed=0)
    actions = random_actions(env, 0, 12)
    for i, batch in enumerate(actions):
        observation, reward, terminated, truncated, infos = env.step(batch)
        fresh = i % 5 == 4
        assert truncated.all() == (i % 5 == 3) and not terminated.any()
        assert ("start_pose" in infos) == fresh
        if fresh:
            assert (reward == 0.0).all() and not infos["collision"].any()
            start = infos["start_pose"]
            assert np.hypot(*(observation["pose"][:, :2] - start[:, :2]).T).max() < 1e-4  # it knows its start


def test_a_partial_reset_leaves_the_others_unchanged():
    env = make_vec(3)
    env.reset(seed=0)
    before, *_ = env.step(random_actions(env, 1, 1)[0])
    mask = np.array([False, True, False])
    after, infos = env.reset(options={"reset_mask": mask})
    for key in before:
        np.testing.assert_array_equal(after[key][~mask], before[key][~mask])
        assert not np.array_equal(after[key][1], before[key][1])
    assert infos["_start_pose"].tolist() == mask.tolist()


def test_a_reset_by_mask_begins_the_episode_that_autoreset_would():
    ours, theirs = make_vec(2, max_episode_steps=2), make_vec(2, max_episode_steps=2)
    actions = random_actions(ours, 2, 3)
    for env in (ours, theirs):
        env.reset(seed=4)
        env.step(actions[0])
        *_, truncated, _ = env.step(actions[1])
        assert truncated.all()
    one, *_ = ours.step(actions[2])
    other, _ = theirs.reset(options={"reset_mask": np.ones(2, bool)})
    for key in one:
        np.testing.assert_allclose(one[key], other[key], atol=1e-5)


def test_terminal_observations_reach_stable_baselines3():
    sb3 = pytest.importorskip("vssm_gym.training.sb3", reason="the rl extra is not installed")
    tasks = [task((1.0, 1.2, 0.0), (1.95, 1.2))]
    env = sb3.SB3VecEnv(make_vec(2, **EXACT, end_on="reach", tasks=tasks, max_episode_steps=6))
    env.reset()
    still = np.zeros(4, np.float32)
    for i in range(1, 7):
        observation, _, done, infos = env.step(np.stack([STRAIGHT, still]))
        assert done.tolist() == [i == 4, i == 6]  # 0.95 m, less 0.4 m, at 0.16 m a step; the other is cut off
        for robot in np.flatnonzero(done):
            last = infos[robot]["terminal_observation"]
            assert last["pose"][0] == pytest.approx(1.64 if robot == 0 else 1.0, abs=1e-4)
            assert infos[robot]["TimeLimit.truncated"] == (robot == 1)
            assert observation["pose"][robot][0] == pytest.approx(1.0, abs=1e-4)  # the next episode's first


def rollout(env: Any, seed: int) -> list[bytes]:
    observation, _ = env.reset(seed=seed)
    said = []
    for action in random_actions(env, 0, 6):
        said += [np.asarray(observation[key]).tobytes() for key in sorted(observation)]
        observation, reward, *_ = env.step(action)
        said.append(np.asarray(reward).tobytes())
    return said


def test_the_same_seed_gives_the_same_bytes():
    keywords: dict[str, Any] = {"noise": ("low", "high"), "start_std": (0.05, 0.05, 0.05), "show_uncertainty": True}
    one, other = make_vec(3, **keywords), make_vec(3, **keywords)
    first = rollout(one, 3)
    assert rollout(other, 3) == first
    assert rollout(one, 3) == first
    assert rollout(one, 4) != first


@pytest.mark.slow
def test_robot_i_has_the_stream_of_seed_plus_i_however_many_there_are():
    many = make_vec(3)
    observations, infos = many.reset(seed=5)
    for i in range(3):
        alone, info = make().reset(seed=5 + i)
        assert info["task"] == infos["task"][i]
        np.testing.assert_allclose(observations["scan"][i], alone["scan"], atol=1e-4)


@pytest.mark.slow
def test_slices_of_robots_are_stepped_as_one(monkeypatch):
    """Two slices give the observations, rewards and tasks of one, restarts by mask included."""
    seen = []
    for fewest in (1, 1000):
        monkeypatch.setattr(batch_slices, "MIN_SLICE", fewest)
        monkeypatch.setattr(batch_slices.os, "sched_getaffinity", lambda _: {0, 1}, raising=False)
        env = make_vec(6, observation="depth", max_episode_steps=3)
        assert len(env._batch._states) == (2 if fewest == 1 else 1)
        rows = [env.reset(seed=3)[0]]
        for batch in random_actions(env, 3, 5):
            observation, reward, terminated, truncated, infos = env.step(batch)
            rows.append({**observation, "reward": reward, "over": terminated | truncated, "task": infos.get("task", 0)})
            rows.append(env.reset(options={"reset_mask": np.array([0, 0, 0, 0, 1, 0], bool)})[0])
        seen.append(rows)
        env.close()
    for ours, theirs in zip(*seen, strict=True):
        for key, value in ours.items():
            np.testing.assert_allclose(value, theirs[key], atol=1e-4, err_msg=key)


def test_nothing_recompiles():
    env = make_vec(24, max_episode_steps=5)
    env.reset(seed=0)
    actions = random_actions(env, 3, 12)
    env.step(actions[0])
    compiled = [program._cache_size() for program in env._batch.programs]
    for batch in actions:
        env.step(batch)
        env.reset(options={"reset_mask": np.arange(24) == 3})
    assert [program._cache_size() for program in env._batch.programs] == compiled


@pytest.mark.slow
def test_maps_and_noise_are_drawn_for_each_episode():
    env = make_vec(16, noise=("none", "high"), map_samples=3)
    env.reset(seed=0)
    assert set(np.asarray(env._batch.state.which).tolist()) == {0, 1, 2}
    noise = np.asarray(env._batch.state.noise)[:, 1]
    assert len(set(noise.tolist())) == 16 and noise.min() >= 0.0 and noise.max() <= 0.06
    ratio = np.asarray(env._batch.state.noise)[:, 0] / noise  # all of a robot's noise by one share
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-4)


def test_the_estimates_error_follows_its_std():
    """The std begins at that of the start and converges to the tracker's; the true error follows it."""
    start, settled = (0.1, 0.1, 0.05), (0.02, 0.02, 0.01)
    env = make_vec(512, start_std=start, pose_std=settled, pose_memory=0.5, show_uncertainty=True, noise="none")
    observation, infos = env.reset(seed=0)
    np.testing.assert_allclose(observation["pose"], infos["start_pose"], atol=1e-4)  # it believes the task's start
    np.testing.assert_allclose(observation["pose_std"], np.tile(start, (512, 1)), rtol=1e-4)
    for std in (start, settled):
        off = observation["pose"] - env.planar
        spread = np.sqrt(np.mean(off[:, :2] ** 2))
        assert spread == pytest.approx(std[0], rel=0.12)
        assert np.std(wrap_angle(off[:, 2])) == pytest.approx(std[2], rel=0.15)
        for _ in range(12):
            observation, *_ = env.step(np.zeros((512, 4), np.float32))
    np.testing.assert_allclose(observation["pose_std"], np.tile(settled, (512, 1)), rtol=1e-2)


def test_unknown_space_costs_reward():
    tasks = [task((3.0, 1.6, 0.0), (1.0, 1.0))]
    env = make(half_seen(), **EXACT, unknown="penalised", reward="sparse", tasks=tasks)
    env.reset(seed=0)
    rewards = [env.step(STRAIGHT)[1] for _ in range(5)]
    assert rewards[0] == 0.0 and rewards[-1] == pytest.approx(-0.05)


def test_a_car_drives_arcs_and_stops_at_walls():
    car = Car()
    env = make(robot="car", **EXACT, tasks=[task((1.0, 1.2, 0.0), (4.0, 1.2))])
    env.reset(seed=0)
    for _ in range(10):
        observation, *_ = env.step(np.array([0.6, 0.3], np.float32))
    turned = 0.6 * np.tan(0.3) / car.wheelbase
    expected = [1.0 + 0.6 * np.sin(turned) / turned, 1.2 + 0.6 * (1.0 - np.cos(turned)) / turned, turned]
    np.testing.assert_allclose(observation["pose"], expected, atol=2e-3)
    for _ in range(40):
        *_, info = env.step(np.array([0.6, -0.1], np.float32))
    assert info["collision"]
    env.step(np.array([-0.6, 0.0], np.float32))
    assert not env.step(np.array([-0.6, 0.0], np.float32))[-1]["collision"]  # it backs out


def test_a_pickled_environment_goes_on():
    env = make().unwrapped
    env.reset(seed=1)
    env.step(STRAIGHT)
    copy = pickle.loads(pickle.dumps(env))
    ours, theirs = env.step(STRAIGHT), copy.step(STRAIGHT)
    for key in ours[0]:
        np.testing.assert_array_equal(ours[0][key], theirs[0][key])


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"foo": 1}, "foo: expected one of its keywords: map, robot"),
        ({"robot": "tank"}, "robot: expected one of 'holonomic', 'car'"),
        ({"noise": ("low", "mid", "high")}, "noise: expected one level, or a pair"),
        ({"noise": "huge"}, "noise: expected one of none"),
        ({"start_std": (1.0, -1.0, 0.0)}, "start_std: expected three standard deviations"),
        ({"map_samples": -1}, "map_samples: expected a whole number"),
        ({"map": 3}, "map: expected a map file"),
        ({"tasks": []}, "tasks: expected at least one task"),
        ({"tasks": [task((2.5, 2.5, 0.0), (1.0, 1.0))]}, "tasks.start: expected a free position"),
    ],
)
def test_errors_of_keywords_state_what_is_expected(keywords, message):
    with pytest.raises(InputError, match=message) as error:
        make(**keywords) if "map" not in keywords else gym.make("vssm_gym/WorldModelNav-v0", **keywords)
    assert "\n" not in str(error.value)


def test_bad_actions_and_options_change_nothing():
    env = make_vec(2)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros((2, 4), np.float32))
    env.reset(seed=0)
    for actions in (np.full((2, 4), np.nan), np.zeros((3, 4)), np.zeros((2, 4), dtype=object)):
        with pytest.raises(InputError, match="finite numbers"):
            env.step(actions)
    for options in ({"foo": 1}, {"task": 64}, {"reset_mask": np.zeros(2, bool)}):
        with pytest.raises(InputError):
            env.reset(options=options)
