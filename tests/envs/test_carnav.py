"""Test CarNav: spaces, observations and commands, chains, ends of episodes, rewards, and errors."""

import math
import pickle

import gymnasium as gym
import numpy as np
import pytest

from tests.helpers.box_rooms import furniture
from tests.helpers.car_worlds import arc, two_yards, yard
from vssm_gym.envs.carnav import CARNAV_REWARD, CarNavEnv
from vssm_gym.envs.robots.car_noise import NOISE_LEVELS, CarNoise
from vssm_gym.envs.tasks.car import CarTask, CarTaskSampler
from vssm_gym.errors import InputError
from vssm_gym.geometry.car import GOAL_RADIUS, Car

ID = "vssm_gym:vssm_gym/CarNav-v0"
CAR = Car()
SCENE = yard(4.0, 3.0, (furniture("crate", (2.9, 2.2, 0.2), (0.3, 0.5, 0.4), 0.6),))
OPEN = yard(6.0, 6.0)
SAMPLERS = [CarTaskSampler.of(scene, CAR) for scene in (SCENE, OPEN)]  # kept, so that every test finds them made
SMALL = {"width": 32, "height": 24}


@pytest.fixture(params=["mujoco", "bullet"])
def physics(request):
    if request.param == "bullet":
        pytest.importorskip("pybullet", reason="the bullet extra is not installed")
    return request.param


def make(**keywords) -> CarNavEnv:
    fixed = {"scene": SCENE, "noise": "none", "images": False, "observe_pose": True}
    return CarNavEnv(**fixed | keywords)


def act(speed: float = 0.0, steering: float = 0.0) -> np.ndarray:
    return np.array([speed, steering], dtype=np.float32)


def task(env: CarNavEnv, start=(0.6, 1.5, 0.0), goal=(2.0, 1.5, 0.0)) -> CarTask:
    return env.sampler.task(start, goal if env.targets == "poses" else goal[:2])


def rollout(env: gym.Env, seed: int, steps: int = 25) -> bytes:
    observation, info = env.reset(seed=seed)
    rng, said = np.random.default_rng(0), []
    for _ in range(steps):
        said += [observation[key].tobytes() for key in sorted(observation)]
        said += [np.asarray(info[key]).tobytes() for key in ("T_world_cam", "K", "collision", "collisions", "control")]
        action = rng.uniform(env.action_space.low, env.action_space.high).astype(np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        said.append(repr((float(reward), terminated, truncated)).encode())
        if terminated:
            break
    return b"".join(said)


def test_it_is_made_by_its_id_with_a_minute_to_drive():
    env = gym.make(ID, camera=SMALL)
    assert env.spec.max_episode_steps == 600
    default = env.unwrapped
    assert (default.apartment.name, default.noise, default.physics) == ("arena", NOISE_LEVELS["low"], "mujoco")
    assert set(default.observation_space) == {"rgb", "depth", "goal"}
    assert default.observation_space["goal"].shape == (3,)
    np.testing.assert_allclose(default.action_space.high, [CAR.max_speed, CAR.max_steering], rtol=1e-6)
    np.testing.assert_allclose(default.action_space.low, -default.action_space.high)


def test_a_minute_without_arriving_truncates():
    env = gym.make(ID, scene=SCENE, images=False, max_episode_steps=4)
    env.reset(seed=0)
    assert [env.step(act())[3] for _ in range(4)] == [False, False, False, True]


@pytest.mark.parametrize("targets", ["poses", "points"])
@pytest.mark.parametrize("images", [True, False])
def test_observations_are_of_their_space(targets, images):
    env = make(targets=targets, images=images, camera=SMALL, observe_pose=False, noise="high")
    observation, info = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert set(observation) == ({"rgb", "depth", "goal"} if images else {"goal"})  # and so no pose
    task_entries = {"distance_to_goal", "path_length", "success", "spl", "task", "start_pose"}
    assert set(info) == {"T_world_cam", "K", "collision", "collisions", "control"} | task_entries
    np.testing.assert_allclose(observation["goal"], info["task"].goal, rtol=1e-6)
    np.testing.assert_allclose(info["start_pose"], info["task"].start, atol=1e-6)
    observation, *_, info = env.step(act(9.0, -9.0))
    assert env.observation_space.contains(observation)
    np.testing.assert_allclose(info["control"], [CAR.max_speed, -CAR.max_steering])


def test_the_camera_is_where_the_car_carries_it_and_does_not_see_the_car():
    env = make(images=True, camera={"width": 64, "height": 48})
    observation, info = env.reset(options={"task": task(env)})
    np.testing.assert_allclose(info["T_world_cam"][:3, 3], [0.6 + CAR.camera_forward, 1.5, CAR.camera_height])
    np.testing.assert_allclose(info["T_world_cam"][:3, 2], [1.0, 0.0, 0.0], atol=1e-12)
    fx, cy = info["K"][0, 0], info["K"][1, 2]
    # ahead is the wall at x = 3.95; the lowest row is floor, where its ray has fallen by the camera's height
    assert observation["depth"][int(cy), 32] == pytest.approx(3.95 - 0.84, abs=0.01)
    assert observation["depth"][47, 32] == pytest.approx(CAR.camera_height * fx / (47 - cy), abs=0.01)


def test_commands_are_executed_and_poses_are_of_the_rear_axle(physics):
    env = make(physics=physics, targets="points")
    env.reset(options={"task": task(env, goal=(3.5, 0.5))})
    for _ in range(5):
        observation, *_ = env.step(act(0.3, 0.2))
    before = env.planar
    for _ in range(10):
        observation, *_, info = env.step(act(0.3, 0.2))
    expected = arc(before, 0.3, math.tan(0.2) / CAR.wheelbase)
    np.testing.assert_allclose(env.planar, expected, atol=6e-3)
    np.testing.assert_allclose(observation["pose"], env.planar, rtol=1e-6)
    np.testing.assert_allclose(info["control"], [0.3, 0.2], rtol=1e-6)
    assert env.path_length == pytest.approx(0.45, abs=0.03)


def test_acceleration_ramps_the_speed_and_stops_at_the_limits():
    env = make(control="acceleration")
    np.testing.assert_allclose(env.action_space.high, [CAR.max_acceleration, CAR.max_steering], rtol=1e-6)
    env.reset(options={"task": task(env, goal=(3.5, 0.8, 0.0))})
    done = [env.step(act(1.0))[4]["control"][0] for _ in range(8)]
    np.testing.assert_allclose(done, [1.0] * 6 + [0.0] * 2, atol=1e-6)  # 0.6 m/s after 0.6 s
    assert env.body.speed() == pytest.approx(0.6, rel=0.02)
    assert env.planar[0] - 0.6 == pytest.approx(0.5 * 0.6 * 0.6 + 0.12, rel=0.05)
    assert env.step(act(-9.0))[4]["control"][0] == pytest.approx(-CAR.max_acceleration)
    assert env.step(act(0.0))[4]["control"][0] == 0.0
    assert env.body.speed() == pytest.approx(0.4, rel=0.05)


def test_it_terminates_where_it_reaches_the_target(physics):
    for targets in ("poses", "points"):
        env = make(physics=physics, targets=targets)
        env.reset(seed=0, options={"task": task(env)})
        for _ in range(60):
            *_, terminated, truncated, info = env.step(act(0.3))
            away = math.hypot(*(env.planar[:2] - [2.0, 1.5]))
            assert terminated == (away <= GOAL_RADIUS) and not truncated
            if terminated:
                break
        assert info["success"] is True and info["reason"] == "reached" and info["collisions"] == 0
        with pytest.raises(gym.error.ResetNeeded):
            env.step(act())
    with pytest.raises(gym.error.ResetNeeded):
        make().step(act())


def test_a_vector_environment_begins_the_next_episode_with_the_step_after_an_arrival():
    vector = gym.make_vec(ID, num_envs=2, scene=SCENE, noise="none", images=False, observe_pose=True, chain=True)
    vector.reset(seed=0)
    chosen = task(make())
    vector.reset(options={"task": chosen, "reset_mask": np.array([True, False])})
    actions = np.array([act(0.5), act()])
    for _ in range(40):
        observation, _, terminated, _, _ = vector.step(actions)
        if terminated[0]:
            break
    assert terminated.tolist() == [True, False]
    after, reward, terminated, _, infos = vector.step(actions)
    assert reward[0] == 0.0 and not terminated[0] and infos["task"][0].id == chosen.id + 1
    np.testing.assert_array_equal(after["pose"][0], observation["pose"][0])  # the chain's: nothing has moved
    vector.close()


def test_a_pose_with_another_heading_is_not_reached():
    env = make()
    env.reset(options={"task": task(env, goal=(2.0, 1.5, 1.0))})
    assert not any(env.step(act(0.3))[2] for _ in range(70))


def test_collisions_are_counted_when_they_begin(physics):
    env = make(physics=physics)
    env.reset(options={"task": task(env, start=(3.3, 1.0, 0.0), goal=(1.0, 1.0, 0.0))})
    collided, collisions = [], []
    for speed in [0.3] * 20 + [-0.3] * 15 + [0.3] * 30:
        info = env.step(act(speed))[4]
        collided.append(info["collision"])
        collisions.append(info["collisions"])
    assert not collided[0] and collisions[0] == 0
    assert collided[19] and collisions[19] == 1 and env.collided_with == ("wall 1",)
    assert not collided[34] and collisions[34] == 1
    assert collisions[-1] == 2
    assert env.reset(seed=0)[1]["collisions"] == 0


@pytest.mark.parametrize("noise", ["none", "high"])
def test_no_contact_in_the_open(physics, noise):
    env = make(physics=physics, scene=OPEN, noise=noise)
    env.reset(options={"task": env.sampler.task((3.0, 3.0, 0.0), (1.0, 1.0, 0.0))})
    rng = np.random.default_rng(0)
    for _ in range(60):
        assert not env.step(rng.uniform(env.action_space.low, env.action_space.high).astype(np.float32))[4]["collision"]


def test_a_chain_continues_where_it_ended(physics):
    env = make(physics=physics, chain=True, noise="mid")
    env.reset(seed=1, options={"task": task(env)})
    for _ in range(80):
        *_, terminated, _, _ = env.step(act(0.5))
        if terminated:
            break
    assert terminated
    ended, speed = env.planar, env.body.speed()
    assert speed > 0.2
    _, info = env.reset()
    np.testing.assert_array_equal(info["start_pose"], ended)
    np.testing.assert_allclose(info["task"].start, ended)
    assert env.body.speed() == speed and info["task"].id == 1 and env.path_length == 0.0
    env.step(act(0.5))
    assert env.planar[0] > ended[0] + 0.02  # it still rolls

    _, info = env.reset(options={"goal": (0.7, 2.2, 1.0)})
    assert info["task"].goal == (0.7, 2.2, 1.0) and info["start_pose"][0] > 1.8
    _, info = env.reset(options={"restart": True})
    np.testing.assert_allclose(env.planar, info["task"].start, atol=1e-6)
    assert env.body.speed() == 0.0
    _, info = env.reset(seed=1)
    np.testing.assert_allclose(env.planar, info["task"].start, atol=1e-6)


def test_a_chain_continues_at_a_wall():
    env = make(chain=True)
    env.reset(options={"task": task(env, start=(3.3, 1.0, 0.0), goal=(1.0, 1.0, 0.0))})
    for _ in range(20):
        env.step(act(0.3))
    pressed = env.planar
    _, info = env.reset()
    np.testing.assert_array_equal(info["start_pose"], pressed)
    assert env.step(act(0.3))[4]["collisions"] == 0  # that contact began before
    assert env.step(act(-0.3))[4]["control"][0] == pytest.approx(-0.3)


def test_chained_targets_are_reachable():
    env = make(scene=two_yards(), chain=True)
    sides = []
    for seed in range(4):
        _, info = env.reset(seed=seed)
        side = info["task"].start[0] < 3.0
        goals = [env.reset()[1]["task"].goal for _ in range(4)]
        assert all((goal[0] < 3.0) == side for goal in goals)
        sides.append(side)
        with pytest.raises(InputError, match="goal: expected a target that the car can reach"):
            env.reset(options={"goal": (4.5 if side else 1.5, 1.5, 0.0)})


@pytest.mark.parametrize("keywords", [{}, {"control": "acceleration", "chain": True}])
def test_the_same_seed_gives_the_same_bytes(physics, keywords):
    env, other = (make(physics=physics, noise="high", **keywords) for _ in range(2))
    first = rollout(env, 3)
    assert rollout(other, 3) == first
    assert rollout(env, 3) == first
    assert rollout(env, 4) != first


def test_the_dynamics_stream_is_its_own():
    """Tasks do not depend on the length of a run, nor its noise on the number of drawn tasks."""
    env, other = make(noise="high"), make(noise="high")
    env.reset(seed=5)
    for _ in range(7):
        env.step(act(0.2, 0.1))
    other.reset(seed=5)
    assert env.reset()[1]["task"] == other.reset()[1]["task"]


@pytest.mark.parametrize("level", ["low", "high"])
def test_noise_makes_cars_stray_and_differ(level):
    ends = []
    for seed in range(4):
        env = make(scene=OPEN, noise=level)
        env.reset(seed=seed, options={"task": env.sampler.task((3.0, 3.0, 0.0), (1.0, 1.0, 0.0))})
        for _ in range(30):
            env.step(act(0.4, 0.1))
        ends.append(env.planar)
    spread = np.std(ends, axis=0)
    assert (spread[:2] > 1e-3).all() and spread[2] > 1e-3


def test_slip_and_lag_follow_the_noise():
    """With low friction the car hardly starts; a slow servo turns late."""
    runs = {}
    for name, noise in (("exact", CarNoise()), ("ice", CarNoise(friction=0.05)), ("slow", CarNoise(steering_lag=0.5))):
        env = make(scene=OPEN, noise=noise)
        env.reset(options={"task": env.sampler.task((3.0, 3.0, 0.0), (1.0, 1.0, 0.0))})
        for _ in range(10):
            env.step(act(0.5, 0.3))
        runs[name] = env
    assert runs["ice"].path_length < 0.5 * runs["exact"].path_length
    assert 0.2 < runs["slow"].planar[2] / runs["exact"].planar[2] < 0.8


def test_dense_rewards_are_progress_less_costs_plus_the_prize():
    env = make(scene=yard(4.0, 3.0))  # nothing between start and goal: free space is straight
    env.reset(options={"task": env.sampler.task((0.6, 1.5, 0.0), (2.0, 1.5, 0.0))})
    rewards = []
    terminated = False
    while not terminated:
        _, reward, terminated, _, _ = env.step(act(0.3))
        rewards.append(reward)
    gained = env.planar[0] - 0.6
    assert sum(rewards) == pytest.approx(
        gained - CARNAV_REWARD.step_cost * len(rewards) + CARNAV_REWARD.success, abs=0.1
    )
    env.reset(options={"task": env.sampler.task((3.6, 1.5, 0.0), (2.0, 1.5, 0.0))})
    for _ in range(5):
        reward = env.step(act(0.3))[1]
    assert reward == pytest.approx(-CARNAV_REWARD.step_cost - CARNAV_REWARD.collision_cost, abs=2e-3)


def test_sparse_rewards_success_only():
    env = make(reward="sparse")
    env.reset(options={"task": task(env)})
    rewards, terminated = [], False
    while not terminated:
        _, reward, terminated, _, _ = env.step(act(0.5))
        rewards.append(reward)
    assert rewards[-1] == CARNAV_REWARD.success and not any(rewards[:-1])


@pytest.mark.parametrize(
    "state", [(0.3, 0.0, 1.0, 0.0, 0.0), (-0.5, 1.0, 0.0, 0.0, 0.0), (math.nan, 1.0, 0.0, 0.0, 0.0)]
)
def test_an_invalid_state_of_the_car_ends_the_episode(state, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file there
    env = make(chain=True)
    env.reset(seed=0)
    env.body.data.qpos[2:7] = state
    observation, _, terminated, _, info = env.step(act())
    assert env.observation_space.contains(observation)
    assert terminated and info["success"] is False and info["reason"] == "overturned or off the floor"
    _, info = env.reset()
    assert env.body.upright()
    np.testing.assert_allclose(env.planar, info["task"].start, atol=1e-6)


@pytest.mark.parametrize("images", [True, False])
def test_rendering_shows_car_and_target(images):
    env = make(render_mode="rgb_array", images=images, camera=SMALL)
    assert env.render() is None
    env.reset(options={"task": task(env)})
    first = env.render()
    assert first.dtype == np.uint8 and first.shape == (360, 360 + 480 * images, 3)
    plan = first[:, -360:].astype(int)
    is_blue = (plan[..., 2] > 150) & (plan[..., 0] < 80)
    scale = 360 / 4.5  # the plan's pixels a metre: 4.1 m and a margin of 0.2 m on both sides
    assert is_blue.sum() == pytest.approx(0.39 * 0.19 * scale**2, rel=0.35)
    for _ in range(5):
        env.step(act(0.5))
    assert (env.render() != first).any()
    assert make().render() is None


def test_a_pickled_environment_goes_on_to_the_byte():
    env = make(noise="high", chain=True)
    env.reset(seed=2)
    env.step(act(0.4, 0.2))
    copy = pickle.loads(pickle.dumps(env))
    for action in (act(0.4, 0.2), act(-0.3, 0.1)):
        ours, theirs = env.step(action), copy.step(action)
        assert ours[0]["pose"].tobytes() == theirs[0]["pose"].tobytes() and ours[1] == theirs[1]
    assert env.reset()[1]["task"] == copy.reset()[1]["task"]


def test_bullet_passes_gymnasiums_checker():
    pytest.importorskip("pygame", reason="the checker opens a window: the human extra is not installed")
    pytest.importorskip("pybullet", reason="the bullet extra is not installed")
    from gymnasium.utils.env_checker import check_env

    env = make(physics="bullet", images=True, camera=SMALL, render_mode="rgb_array")
    check_env(env, skip_render_check=False)
    env.close()


@pytest.mark.parametrize(
    ("keywords", "field", "expected"),
    [
        ({"noise": "loud"}, "noise", "low"),
        ({"physics": "havok"}, "physics", "'bullet'"),
        ({"targets": "lines"}, "targets", "'poses'"),
        ({"control": "jerk"}, "control", "'acceleration'"),
        ({"chain": 1}, "chain", "True or False"),
        ({"images": "no"}, "images", "rgb, depth, depth_image"),
        ({"observe_pose": None}, "observe_pose", "True or False"),
        ({"reward": "money"}, "reward", "'sparse'"),
        ({"renderer": "oil"}, "renderer", "'raycast'"),
        ({"render_mode": "ansi"}, "render_mode", "'human', 'rgb_array'"),
        ({"captions": 1}, "captions", "True or False"),
        ({"camera": {"width": 1}}, "width", "pixels"),
        ({"scene": "no such place"}, "scene", "arena"),
    ],
)
def test_bad_keywords_are_one_line(keywords, field, expected):
    with pytest.raises(InputError) as caught:
        make(**keywords)
    assert field in str(caught.value) and expected in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tasks": 1}, "no other keys than 'task', 'goal' and 'restart'"),
        ({"task": "go"}, "a CarTask; found str"),
        ({"goal": (1.0, 1.0, 0.0)}, "a chain that continues"),
        ({"task": CarTask(scene="yard", start=(0.6, 0.5, 0.0), goal=(1.5, 1.5))}, "3 finite numbers"),
        ({"task": CarTask(scene="barn", start=(0.6, 0.5, 0.0), goal=(1.5, 1.5, 0.0))}, "scene"),
    ],
)
def test_bad_options_are_one_line_and_change_nothing(options, message):
    env = make()
    env.reset(seed=0)
    before = env.planar
    with pytest.raises(InputError, match=message):
        env.reset(options=options)
    np.testing.assert_array_equal(env.planar, before)


@pytest.mark.parametrize("action", [[0.1], [0.1, math.nan], "ahead", None, [[0.1, 0.1]], [0.1, [2]]])
def test_bad_actions_change_nothing(action):
    env = make()
    env.reset(seed=0)
    before = env.planar
    with pytest.raises(InputError, match="action"):
        env.step(action)
    np.testing.assert_array_equal(env.planar, before)


@pytest.mark.parametrize("goal", [(1.0, 1.0), "there", (1.0, 1.0, math.inf), None])
def test_bad_goals_of_a_chain_are_refused(goal):
    env = make(chain=True)
    env.reset(seed=0)
    if goal is None:
        assert env.reset(options={"goal": None})  # the same as none
        return
    with pytest.raises(InputError, match="goal: expected 3 finite numbers"):
        env.reset(options={"goal": goal})
